"""Pictures of a target that is exposed row by row: its bands against time with the vibrations through them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from aolink.plotting.style import legend_above, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from aolink.identification.bands import BandsFound
    from aolink.jobs.look import Looked

_FRAMES = 3
"""Frames that are drawn."""
_POINTS = 6000


def rows_figures(looked: Looked, rows: BandsFound) -> list[tuple[Figure, str]]:
    """The figures of the page, with what they show."""
    pictures = []
    for draw, height, caption in (
        (draw_rows, 75, "One frame: how far each row is from its place at rest, and the vibrations through it."),
        (draw_bands, 60, "Bands of rows against the time of each, and the vibrations through them, frame by frame."),
        (draw_scan, 60, "How much a vibration of each frequency explains of the bands; dotted: the frame rate alone."),
    ):
        figure = new_figure(140, height)
        draw(looked, rows, figure.subplots())
        pictures.append((figure, caption))
    return pictures


def draw_rows(looked: Looked, rows: BandsFound, axes: Axes) -> None:
    """Place of each band of the frame in which they go farthest, the first row at the top."""
    k = int(rows.places.std(axis=1).argmax())
    region = looked.regions[0]
    at = region.y + (np.arange(rows.places.shape[1]) + 0.5) * region.rows / rows.places.shape[1]
    axes.plot(rows.places[k] + rows.left[k], at, ".", markersize=3, color="black", label=f"bands of frame {k}")
    axes.plot(rows.places[k], at, color="tab:orange", label="vibrations, as the exposure leaves them")
    axes.set(xlabel="place, pixels", ylabel="row", ylim=(at[-1], at[0]))
    legend_above(axes)


def draw_bands(looked: Looked, rows: BandsFound, axes: Axes) -> None:
    """Places of the bands of some frames against time."""
    first = max(0, len(rows.places) // 2 - _FRAMES)
    k = slice(first, first + _FRAMES)
    times = rows.times_s[k]
    fine = np.linspace(times.min(), times.max(), _POINTS)
    axes.plot(times.ravel(), (rows.places + rows.left)[k].ravel(), ".", markersize=2, color="black", label="bands")
    if rows.tones:
        middle = float(rows.times_s.mean())
        path = np.sum(
            [(np.sinc(hz * looked.exposure_s) * a * np.exp(2j * np.pi * hz * (fine - middle))).real
             for a, hz in rows.tones], axis=0,
        )  # fmt: skip
        axes.plot(fine, path, color="tab:orange", linewidth=0.6, label="vibrations, as the exposure leaves them")
    axes.set(xlabel="time, s", ylabel="place, pixels")
    legend_above(axes)


def draw_scan(looked: Looked, rows: BandsFound, axes: Axes) -> None:
    """What each frequency explains, in standard deviations."""
    axes.plot(rows.hz, np.sqrt(np.maximum(rows.gain, 0.0)), color="black", linewidth=0.5)
    for _, hz in rows.tones:
        axes.axvline(hz, color="tab:orange", linewidth=2.5, alpha=0.35, zorder=0)
    axes.axvline(looked.rate_hz / 2, color="tab:gray", linewidth=0.6, linestyle=":")
    axes.set(xlabel="frequency, Hz", ylabel="evidence", xlim=(0, rows.hz[-1]), ylim=(0, None))
