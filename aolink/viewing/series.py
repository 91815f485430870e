"""Lines over time, and the stream on which they are drawn: a column of numbers becomes a named, coloured Rerun
entity."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from aolink.colours import Colour
from aolink.gathered import Blur
from aolink.rig import Rig
from aolink.viewing.palette import STATUS_COLOURS
from aolink.viewing.timebase import Timebase

PERCENTILES = (5, 50, 95)
"""Percentiles that represent many axes."""
POINTS = 32
"""Points that a path is drawn with in a long session: more than its exposure has columns on a screen."""
_SECOND = 0.55
"""Opacity of the second of two lines that belong together."""


@dataclass(kw_only=True)
class Drawing:
    """A stream into a file or a viewer, the options of the drawing, and what has been drawn so far, which the layout
    depends on."""

    stream: rr.RecordingStream
    rig: Rig
    estimators: list[str] = field(default_factory=list)
    """The estimators in rank order; the band of the last one is shown first."""
    spot: int = 0
    """Number of the spot, of many, that is drawn as lines."""
    live: bool = False
    """Whether it is drawn while it happens: a page of exposures then grows."""
    page: list[Blur] = field(default_factory=list)
    """In a live session, the exposures of the newest page."""
    points: int | None = POINTS
    """Points with which a path of one exposure is drawn; None: every fast step."""
    sent: set[str] = field(default_factory=set)
    """The entities that have data."""
    top: float | None = None
    """Density at the top of the intensity profile's plot, one over slope units; None before the first exposure."""
    scales: dict[str, float] = field(default_factory=dict)
    """Maps over the lenslets, and the value at the end of each one's colours."""
    extents: dict[str, tuple[float, float]] = field(default_factory=dict)
    """The least and the largest value of each entity's lines."""
    styles: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    """The style of each line, and what the legend adds."""
    swinging: dict[str, bool] = field(default_factory=dict)
    """Whether a path swings more than its points show, so that its range is drawn; by its name."""
    ends: dict[str, int] = field(default_factory=dict)
    """The fast step after the last one of each path."""
    states: dict[str, str] = field(default_factory=dict)
    """The last state of each lane."""
    before: dict[str, tuple[int, float]] = field(default_factory=dict)
    """Host time, ns, and value of what a curve goes on from."""
    names: dict[str, int] = field(default_factory=dict)
    """Numbers of the devices and estimators that curves are of, in the order in which they came."""

    @cached_property
    def outputs(self) -> list[int]:
        """Rows of a path that are drawn as lines: x and y of a spot on a plane, or the one position on a line."""
        n = self.rig.sensor.directions
        return list(range(n * self.spot, n * self.spot + n))

    @cached_property
    def axes(self) -> list[int]:
        """Axes whose states and NIS belong to the spot."""
        return list(dict.fromkeys(k // self.rig.plant.n_outputs for k in self.outputs))

    @property
    def labels(self) -> tuple[str, ...]:
        """The text that the legend adds for each output."""
        return (" x", " y") if len(self.outputs) == 2 else ("",)

    def log(self, path: str, what: Any) -> None:
        """Log data that is valid for the whole session."""
        self.stream.log(path, what, static=True)
        self.sent.add(path)

    def send_columns(self, path: str, times: Sequence[rr.TimeColumn], columns: Iterable[Any]) -> None:
        """Send rows of an entity."""
        self.stream.send_columns(path, times, columns)
        self.sent.add(path)

    def has(self, entity: str) -> bool:
        """Whether an entity, or one below it, has data."""
        return any(each == entity or each.startswith(f"{entity}/") for each in self.sent)


@dataclass(frozen=True)
class Style:
    """The style of a line."""

    name: str
    """The line's name in the legend."""
    colour: Colour
    width: float = 1.5
    """Width of the line, points."""
    alpha: int = 255
    steps: bool = False
    """Whether a value holds until the next one, rather than being joined to it."""


def send_line(
    drawing: Drawing, path: str, times: Sequence[rr.TimeColumn], values: ArrayLike, style: Style,
    labels: Sequence[str] = (),
) -> None:  # fmt: skip
    """Send one entity of one or more lines; NaN breaks a line.

    Parameters
    ----------
    values:
        (rows,) or (rows, lines).
    labels:
        Texts that the legend adds to the name of each line; lines after the first are then fainter.
    """
    columns: NDArray[np.float64] = np.asarray(values, dtype=np.float64)
    if not len(columns):
        return
    lines = 1 if columns.ndim == 1 else columns.shape[1]
    faint = [style.alpha if k == 0 or not labels else round(_SECOND * style.alpha) for k in range(lines)]
    look = rr.SeriesLines(
        names=[style.name + label for label in (labels or [""] * lines)],
        colors=[(*style.colour, each) for each in faint],
        widths=[style.width] * lines,
        interpolation_mode="StepAfter" if style.steps else None,  # without a style a line is linear
    )
    if drawing.styles.get(path) != (style, *labels):  # Rerun keeps the place of all that it is sent
        drawing.styles[path] = (style, *labels)
        drawing.log(path, look)
    drawing.send_columns(path, times, rr.Scalars.columns(scalars=columns))
    if np.isfinite(columns).any():
        low, high = drawing.extents.get(path, (np.inf, -np.inf))
        drawing.extents[path] = (min(low, float(np.nanmin(columns))), max(high, float(np.nanmax(columns))))


def send_axes(
    drawing: Drawing, path: str, times: Sequence[rr.TimeColumn], values: ArrayLike, style: Style,
    shown: Sequence[int], labels: Sequence[str],
) -> None:  # fmt: skip
    """Send some of many axes as lines at ``path``, and percentiles over all of them at ``path``/axes.

    Parameters
    ----------
    values:
        (rows, axes); where all of them are shown there are no percentiles.
    shown:
        The axes that are lines of their own.
    labels:
        Texts that the legend adds to the names of these axes.
    """
    columns = np.asarray(values, dtype=np.float64)
    send_line(drawing, path, times, columns[:, list(shown)], style, labels if len(shown) > 1 else ())
    if columns.shape[1] > len(shown):
        words = f"{style.name}, {'/'.join(map(str, PERCENTILES))} % of {columns.shape[1]}"
        spread = Style(words, style.colour, 0.8, 130, style.steps)
        send_line(drawing, f"{path}/axes", times, np.percentile(columns, PERCENTILES, axis=1).T, spread)


def send_states(drawing: Drawing, path: str, timebase: Timebase, states: Sequence[tuple[int, str]]) -> None:
    """Send a lane of named states from fast steps on, coloured by `STATUS_COLOURS`, where they change."""
    before = [drawing.states.get(path, ""), *(state for _, state in states)]
    changed = [each for last, each in zip(before, states, strict=False) if each[1] != last]
    if not changed:
        return
    drawing.states[path] = before[-1]
    names = list(STATUS_COLOURS)
    drawing.log(path, rr.StateConfiguration(values=names, labels=names, colors=list(STATUS_COLOURS.values())))
    columns = rr.StateChange.columns(state=[state for _, state in changed])
    drawing.send_columns(path, timebase.at_steps([step for step, _ in changed]), columns)


def send_pictures(
    drawing: Drawing, path: str, times: Sequence[rr.TimeColumn], pictures: Sequence[NDArray[np.uint8 | np.uint16]]
) -> None:
    """Send pictures of one shape, (rows, columns) or (rows, columns, 3)."""
    if not pictures:
        return
    (height, width), first = pictures[0].shape[:2], pictures[0]
    model = rr.ColorModel.RGB if first.ndim == 3 else rr.ColorModel.L
    datatype = rr.ChannelDatatype.from_np_dtype(first.dtype)
    layout = rr.components.ImageFormat(width=width, height=height, color_model=model, channel_datatype=datatype)
    drawing.log(path, rr.Image.from_fields(format=layout))
    buffers = np.stack([np.ascontiguousarray(each).ravel().view(np.uint8) for each in pictures])
    drawing.send_columns(path, times, rr.Image.columns(buffer=buffers))
