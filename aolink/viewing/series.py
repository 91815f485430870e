"""Lines over time, and the stream on which they are drawn: a column of numbers becomes a named, coloured Rerun
entity."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from aolink.colours import Colour
from aolink.numerics.arrays import IntArray
from aolink.rig import Rig
from aolink.viewing.entities import percentiles
from aolink.viewing.palette import STATUS_COLOURS
from aolink.viewing.timebase import Timebase

PERCENTILES = (5, 50, 95)
"""Percentiles that represent many axes."""
POINTS = 32
"""Points that a path is drawn with in a long session: more than its exposure has columns on a screen."""
_SECOND = 0.55
"""Opacity of the second of two lines that belong together, and of the lines of a recording that is compared."""


@dataclass(frozen=True)
class Chosen:
    """The spot, of many, that is drawn as lines."""

    outputs: tuple[int, ...]
    """Rows of a path."""
    axes: tuple[int, ...]
    """Axes whose states and NIS belong to it."""
    labels: tuple[str, ...] = ("",)
    """The text that the legend adds for each output."""

    @classmethod
    def of(cls, rig: Rig, spot: int = 0) -> Chosen:
        """x and y of a spot on a plane, or the one position of a spot on a line."""
        n = rig.sensor.directions
        outputs = tuple(range(n * spot, n * spot + n))
        axes = tuple(dict.fromkeys(k // rig.plant.n_outputs for k in outputs))
        return cls(outputs, axes, (" x", " y") if n == 2 else ("",))


@dataclass(kw_only=True)
class Drawing:
    """A stream into a file or a viewer, the options of the drawing, and facts about the lines drawn so far."""

    stream: rr.RecordingStream
    chosen: Chosen
    root: str = ""
    """Prefix of every entity's name, with its slash, where a recording is shown beside another."""
    points: int | None = POINTS
    """Points with which a path of one exposure is drawn; None: every fast step."""
    near: tuple[float, float] | None = None
    """The part of the field that is drawn of one exposure's intensity profile, where the layout is about that exposure:
    its path and histogram are then not drawn beside it."""
    extents: dict[str, tuple[float, float]] = field(default_factory=dict)
    """The least and the largest value of each entity's lines."""
    swinging: dict[str, bool] = field(default_factory=dict)
    """Whether a path swings more than its points show, so that its range is drawn; by its name."""
    states: dict[str, str] = field(default_factory=dict)
    """The last state of each lane."""

    def log(self, path: str, what: Any) -> None:
        """Log data that is valid for the whole session."""
        self.stream.log(self.root + path, what, static=True)

    def send_columns(self, path: str, times: Sequence[rr.TimeColumn], columns: Iterable[Any]) -> None:
        """Send rows of an entity."""
        self.stream.send_columns(self.root + path, times, columns)


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
    alpha = round(style.alpha * (_SECOND if drawing.root else 1.0))
    faint = [alpha if k == 0 or not labels else round(_SECOND * alpha) for k in range(lines)]
    look = rr.SeriesLines(
        names=[style.name + label for label in (labels or [""] * lines)],
        colors=[(*style.colour, each) for each in faint],
        widths=[style.width] * lines,
        interpolation_mode="StepAfter" if style.steps else None,  # without a style a line is linear
    )
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
        send_line(drawing, percentiles(path), times, np.percentile(columns, PERCENTILES, axis=1).T, spread)


def send_states(drawing: Drawing, path: str, timebase: Timebase, steps: ArrayLike, states: Sequence[str]) -> None:
    """Send a lane of named states from fast steps on, coloured by `STATUS_COLOURS`, where they change."""
    before = [drawing.states.get(path, ""), *states]
    changed = [k for k, state in enumerate(states) if state != before[k]]
    if not changed:
        return
    drawing.states[path] = states[-1]
    names = list(STATUS_COLOURS)
    drawing.log(path, rr.StateConfiguration(values=names, labels=names, colors=list(STATUS_COLOURS.values())))
    times = timebase.at_steps(np.asarray(steps)[changed])
    drawing.send_columns(path, times, rr.StateChange.columns(state=[states[k] for k in changed]))


def some_rows(values: NDArray[np.float64], count: int) -> IntArray:
    """The rows to keep of lines with more than ``count`` rows: those of the extremes of each part, and the ends.

    Parameters
    ----------
    values:
        (rows, lines).
    """
    rows, lines = values.shape
    if rows <= count:
        return np.arange(rows)
    parts = max(1, count // (2 * lines))
    length, longer = divmod(rows, parts)
    kept = [np.array([0, rows - 1])]
    # All parts of one length at once: the first ones have a row more.
    for first, of, size in ((0, longer, length + 1), (longer * (length + 1), parts - longer, length)):
        if of:
            some = values[first : first + of * size].reshape(of, size, lines)
            starts = first + size * np.arange(of)[:, None]
            kept += [(starts + find(some, axis=1)).ravel() for find in (np.argmin, np.argmax)]
    return np.unique(np.concatenate(kept))
