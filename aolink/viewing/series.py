"""Lines over time: how a column of numbers becomes a named, coloured Rerun entity."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from aolink.colours import Colour
from aolink.viewing.palette import STATUS_COLOURS

PERCENTILES = (5, 50, 95)
"""What stands for many axes."""


@dataclass(frozen=True)
class Style:
    """How a line looks."""

    name: str
    """In the legend."""
    colour: Colour
    width: float = 1.5
    """Points."""
    alpha: int = 255
    steps: bool = False
    """Whether a value holds until the next one, rather than being joined to it."""


def send_line(
    stream: rr.RecordingStream, path: str, times: Sequence[rr.TimeColumn], values: ArrayLike, style: Style
) -> None:
    """Send one entity of one or more lines that look the same; NaN breaks a line.

    Parameters
    ----------
    values:
        (rows,) or (rows, lines).
    """
    columns: NDArray[np.float64] = np.asarray(values, dtype=np.float64)
    if not len(columns):
        return
    lines = 1 if columns.ndim == 1 else columns.shape[1]
    look = rr.SeriesLines(
        names=[style.name] * lines,
        colors=[(*style.colour, style.alpha)] * lines,
        widths=[style.width] * lines,
        interpolation_mode="StepAfter" if style.steps else "Linear",
    )
    stream.log(path, look, static=True)
    stream.send_columns(path, times, rr.Scalars.columns(scalars=columns))


def send_axes(
    stream: rr.RecordingStream, path: str, times: Sequence[rr.TimeColumn], values: ArrayLike, style: Style
) -> None:
    """Send the first of many axes as a line at ``path``, and percentiles over all of them at ``path``/axes.

    Parameters
    ----------
    values:
        (rows, axes); with one axis there are no percentiles.
    """
    columns = np.asarray(values, dtype=np.float64)
    n = columns.shape[1]
    if n == 1:
        send_line(stream, path, times, columns[:, 0], style)
        return
    send_line(
        stream,
        path,
        times,
        columns[:, 0],
        Style(f"{style.name}, 1st of {n}", style.colour, style.width, style.alpha, style.steps),
    )
    spread = Style(f"{style.name}, {'/'.join(map(str, PERCENTILES))} % of {n}", style.colour, 0.8, 130, style.steps)
    send_line(stream, f"{path}/axes", times, np.percentile(columns, PERCENTILES, axis=1).T, spread)


def send_states(stream: rr.RecordingStream, path: str, times: Sequence[rr.TimeColumn], states: Iterable[str]) -> None:
    """Send a lane of named states, coloured by `STATUS_COLOURS`."""
    names = list(STATUS_COLOURS)
    stream.log(
        path, rr.StateConfiguration(values=names, labels=names, colors=list(STATUS_COLOURS.values())), static=True
    )
    stream.send_columns(path, times, rr.StateChange.columns(state=list(states)))
