"""The page of `aolink look`: a film's spots, exposures with the path in the blur, spectra with the sets, and what it
means in words."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from aolink.errors import ExportError
from aolink.files import writing
from aolink.jobs.look import Direction, Looked
from aolink.jobs.look_words import in_set, paragraph
from aolink.numerics.arrays import FloatArray
from aolink.optics.kernel import pixel_masses
from aolink.plotting.report import facts_table, html_page, picture_in_page
from aolink.plotting.style import new_figure, paper

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHOWN = (0.98, 0.5, 0.02)
"""Exposures that are shown, by how blurred they are among all."""
_POINTS = 2000
"""Frequencies of a spectrum."""
_HIGHEST = 1.6
"""Highest frequency of a spectrum, in those of the sets."""


def write_page(looked: Looked, path: Path, name: str, commands: Sequence[str], *, overwrite: bool = False) -> None:
    """Write the page. Raises ExportError where it exists and not ``overwrite``, or without matplotlib."""
    with paper(), writing(path, overwrite=overwrite, suffix=".html", error=ExportError) as partial:
        parts = [f"<h1>{escape(name)}</h1>", f"<p>{escape(paragraph(looked))}</p>"]
        parts += [f'<p class="note">{escape(each)}.</p>' for each in looked.caveats]
        figures = [picture_in_page(_whole(looked), "The mean of the frames, and the windows of the spots.")]
        if looked.moves:
            caption = "Three exposures, from much to little blur, with the path of the spot in them."
            figures.append(picture_in_page(_exposures(looked), caption))
            caption = "The light summed along one direction: as measured, and as the kernel on that path makes it."
            figures.append(picture_in_page(_profile(looked), caption))
            caption = "The spectrum of the path; in grey the sets of its frequencies."
            figures.append(picture_in_page(_spectra(looked), caption))
        parts += [
            "<h2>Pictures</h2>",
            f'<div class="row pairs">{"".join(f"<div>{each}</div>" for each in figures)}</div>',
        ]
        parts += ["<h2>Numbers</h2>", facts_table(_numbers(looked))]
        parts += ["<h2>What was assumed</h2>", *(f"<p>{escape(each)}.</p>" for each in looked.assumed)]
        parts += ["<h2>To go on</h2>", f"<pre>{escape(chr(10).join(commands))}</pre>"]
        partial.write_text(html_page(name, parts), encoding="utf-8")


def _numbers(looked: Looked) -> dict[str, str]:
    """The table of the paragraph."""
    rows = {
        "frames": f"{len(looked.spots.light)}, {looked.rate_hz:.6g} a second, {looked.exposure_s:.4g} s each",
        "spots": ", ".join(f"at {x},{y}" for x, y in looked.spots.corners + looked.spots.light.shape[-1] // 2),
        "kernel": f"{looked.sd:.3g} pixels (standard deviation)",
    }
    for each in looked.directions:
        if each.found is None:
            rows[f"along {each.name}"] = f"nothing moves by more than {each.least:.2g} pixels rms"
            continue
        rows[f"along {each.name}"] = f"{each.size:.3g} pixels rms, {each.found.model.name}"
        for one in each.found.parameters:
            if one.name.endswith("frequency_hz"):
                rows[f"{one.name} along {each.name}"] = in_set(one, 12)
        rows[f"path along {each.name}"] = (
            f"known to {each.known:.2g} pixels rms inside an exposure; by the centroid alone {each.held:.2g}"
        )
    return rows


def _whole(looked: Looked) -> Figure:
    figure = new_figure(100, 75)
    axes = figure.subplots()
    shown = looked.spots.mean
    axes.imshow(shown, cmap="gray", vmin=0, vmax=float(np.quantile(shown, 0.999)))
    side = looked.spots.light.shape[-1]
    for number, (x, y) in enumerate(looked.spots.corners, 1):
        across, along = (np.array(corners) * side - 0.5 for corners in ((0, 1, 1, 0, 0), (0, 0, 1, 1, 0)))
        axes.plot(x + across, y + along, color="tab:orange", linewidth=0.8)
        axes.annotate(str(number), (x, y), color="tab:orange", fontsize=7, ha="right", va="bottom")
    axes.set(
        xlabel="x, pixels", ylabel="y, pixels", xlim=(-0.5, shown.shape[1] - 0.5), ylim=(shown.shape[0] - 0.5, -0.5)
    )
    return figure


def _chosen(looked: Looked) -> list[int]:
    """Exposures of much, of middling and of little blur."""
    moved = sum(each.path[:, 0].var(axis=1) for each in looked.directions if each.path is not None)
    order = np.argsort(moved)
    return [int(order[round(share * (len(order) - 1))]) for share in _SHOWN]


def _path(looked: Looked, direction: int, number: int) -> FloatArray:
    """The path of the first spot in an exposure along a direction, pixels of its window, (steps,)."""
    path = looked.directions[direction].path
    if path is not None:
        return np.asarray(path[number, 0])
    light = np.nan_to_num(looked.spots.light[:, 0].mean(axis=0)).sum(axis=direction)
    steps = next(each.path.shape[-1] for each in looked.directions if each.path is not None)
    return np.full(steps, float(light @ np.arange(len(light)) / light.sum()))


def summary(looked: Looked) -> Figure:
    """Three exposures with the path in them, and the spectrum along the direction of more motion: in a paper's size."""
    figure = new_figure(180, 48)
    *three, last = figure.subplots(1, len(_SHOWN) + 1, width_ratios=[1, 1, 1, 2.2])
    _show_exposures(looked, three)
    _spectrum(looked, looked.directions[_main(looked)], last)
    return figure


def _exposures(looked: Looked) -> Figure:
    figure = new_figure(140, 55)
    _show_exposures(looked, figure.subplots(1, len(_SHOWN)))
    return figure


def _show_exposures(looked: Looked, each_axes: Sequence[Axes]) -> None:
    for axes, number in zip(each_axes, _chosen(looked), strict=True):
        axes.imshow(looked.spots.light[number, 0], cmap="gray")
        axes.plot(_path(looked, 0, number), _path(looked, 1, number), color="tab:orange", linewidth=1.0)
        axes.set(title=f"exposure {number}", xticks=[], yticks=[])


def _main(looked: Looked) -> int:
    """The direction of more motion."""
    return int(np.argmax([each.size for each in looked.directions]))


def _profile(looked: Looked) -> Figure:
    figure = new_figure(100, 60)
    axes = figure.subplots()
    number, d = _chosen(looked)[0], _main(looked)
    light = looked.spots.light[number, 0].sum(axis=d)
    at = np.arange(len(light))
    masses = pixel_masses(looked.sd**2, np.arange(-0.5, len(light)), _path(looked, d, number), 0)[0]
    axes.plot(at, light, "o", markersize=3, color="black", label="measured")
    axes.plot(at, masses.mean(axis=0), color="tab:orange", label="predicted")
    axes.set(xlabel=f"{looked.directions[d].name}, pixels of the window", ylabel="share of the light")
    axes.legend()
    return figure


def _spectra(looked: Looked) -> Figure:
    moving = [each for each in looked.directions if each.path is not None]
    figure = new_figure(100, 45 * len(moving))
    for axes, each in zip(np.atleast_1d(figure.subplots(len(moving), 1)), moving, strict=True):
        _spectrum(looked, each, axes)
    return figure


def _spectrum(looked: Looked, direction: Direction, axes: Axes) -> None:
    """The amplitude of the path over frequency: exposures stand at their times, with the gaps between them."""
    assert direction.path is not None
    assert direction.found is not None
    frames, _, steps = direction.path.shape
    inside = (np.arange(steps) + 0.5) / steps * looked.exposure_s
    times = (np.arange(frames)[:, None] / looked.rate_hz + inside).ravel()
    path = direction.path[:, 0].ravel()
    sets = [one for one in direction.found.parameters if one.name.endswith("frequency_hz")]
    bands = [(piece.low, piece.high) for one in sets for piece in one.pieces]
    top = max([_HIGHEST * one.best for one in sets] + [looked.rate_hz])
    hz = np.linspace(top / _POINTS, top, _POINTS)
    turned = np.exp(-2j * np.pi * hz[:, None] * times)
    axes.plot(hz, 2 * np.abs(turned @ (path - path.mean())) / len(path), color="black", linewidth=0.7)
    for low, high in bands:
        if low < top:
            axes.axvspan(low, min(high, top), color="tab:gray", alpha=0.4, linewidth=0.8)
    axes.set(xlabel="frequency, Hz", ylabel=f"amplitude along {direction.name}, pixels", xlim=(0, top), ylim=(0, None))
