"""What `aolink look` writes beside its rig file: the page, the path as numbers, and the motion as a tone."""

from __future__ import annotations

import base64
import csv
import io
import math
import wave
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from aolink.errors import ExportError
from aolink.files import writing
from aolink.identification.vibration import Vibration
from aolink.jobs.look import Looked
from aolink.jobs.look_rows_page import draw_bands, draw_scan, rows_figures
from aolink.jobs.look_texture import Region
from aolink.jobs.look_words import in_set, paragraph, size_of
from aolink.numerics.arrays import FloatArray
from aolink.optics.sensor import PIXEL
from aolink.optics.texture import MARGIN
from aolink.plotting.report import facts_table, html_page, picture_in_page
from aolink.plotting.style import legend_above, new_figure, paper
from aolink.restoration.psf import motion_psf
from aolink.restoration.restore import restore

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STEPS = 16
"""Instants of an exposure in the path's table, and in the film of one exposure."""
_POINTS = 4000
_SHOWN = 15
"""Exposures whose path is drawn."""
_TONE_S, _TONE_HZ, _LOUD = 2.0, 44_100, 0.7
_AUDIBLE = (20.0, 20_000.0)
_BAND = 1.96
"""Standard deviations to each side of a path."""
_LARGE = 200
"""Pixels along a side of a picture that is played."""


def write_page(looked: Looked, path: Path, name: str, commands: Sequence[str], *, overwrite: bool = False) -> None:
    """Write the page. Raises ExportError where it exists and not ``overwrite``, or without matplotlib."""
    with paper(), writing(path, overwrite=overwrite, suffix=".html", error=ExportError) as partial:
        parts = [f"<h1>{escape(name)}</h1>", f"<p>{escape(paragraph(looked))}</p>"]
        if looked.doubts:
            parts += ["<h2>Also</h2>", *(f"<p>{escape(each)}.</p>" for each in looked.doubts)]
        figures = [picture_in_page(_whole(looked), "The mean of the frames, and where it was looked at.")]
        if looked.rows is not None:
            figures += [picture_in_page(figure, caption) for figure, caption in rows_figures(looked, looked.rows)]
        elif looked.found.lines:
            figures.append(_played(looked))
        if looked.moves and looked.rows is None:
            figures.append(picture_in_page(_places(looked), "The mean place in each frame, and the vibrations in it."))
            figures.append(picture_in_page(_spectrum(looked), "Spectrum of the places, which aliases share, and what"
                                           " the blur says of each frequency, each over its highest."))  # fmt: skip
        parts += [
            "<h2>Pictures</h2>",
            f'<div class="row pairs">{"".join(f"<div>{each}</div>" for each in figures)}</div>',
        ]
        parts += ["<h2>Numbers</h2>", facts_table(_numbers(looked))]
        parts += ["<h2>What was assumed</h2>", *(f"<p>{escape(each)}.</p>" for each in looked.assumed)]
        parts += ["<h2>To go on</h2>", f"<pre>{escape(chr(10).join(commands))}</pre>"] if commands else []
        partial.write_text(html_page(name, parts), encoding="utf-8")


def write_path(looked: Looked, path: Path, *, overwrite: bool = False) -> None:
    """Write the path by the vibrations and the drift: time, x and y, and their standard deviation, pixels."""
    steps = STEPS if looked.rows is None else 1  # bands of rows are as near to each other
    inside = (np.arange(steps) + 0.5) / steps - 0.5
    times = looked.seen.times_s[:, None] + inside * looked.exposure_s
    moved = looked.path(times) + (looked.found.drift[:, :1] @ looked.seen.axes[0])
    sd = looked.rest / math.sqrt(2)
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("time_s", "x_pixels", "y_pixels", "sd_pixels"))
    for t, (x, y) in zip(times.ravel(), moved.reshape(-1, 2), strict=True):
        rows.writerow((f"{t:.9g}", f"{x:.6g}", f"{y:.6g}", f"{sd:.3g}"))
    with writing(path, overwrite=overwrite, suffix=".csv", error=ExportError) as partial:
        partial.write_text(text.getvalue(), encoding="utf-8")


def write_tone(looked: Looked, path: Path, *, overwrite: bool = False) -> bool:
    """Write two seconds of the motion as sound; False where nothing of it can be heard."""
    heard = [line for line in looked.found.lines if _AUDIBLE[0] <= line.hz <= _AUDIBLE[1]]
    if not heard:
        return False
    t = np.arange(round(_TONE_S * _TONE_HZ)) / _TONE_HZ
    sound = sum(line.ellipse[0] * np.sin(2 * np.pi * line.hz * t) for line in heard)
    sound = np.asarray(sound) / max(float(np.abs(sound).max()), 1e-12) * _LOUD
    with (
        writing(path, overwrite=overwrite, suffix=".wav", error=ExportError) as partial,
        wave.open(str(partial), "wb") as file,
    ):
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(_TONE_HZ)
        file.writeframes((sound * 32767).astype("<i2").tobytes())
    return True


def summary(looked: Looked) -> Figure:
    """Where it was looked at, the places, and the spectra, in a paper's size."""
    figure = new_figure(180, 60)
    whole, places, spectra = figure.subplots(1, 3, width_ratios=[1, 1.3, 1.3])
    _draw_whole(looked, whole)
    if looked.rows is None:
        _draw_places(looked, places)
        _draw_evidence(looked, spectra)
    else:
        draw_bands(looked, looked.rows, places)
        draw_scan(looked, looked.rows, spectra)
    return figure


def _numbers(looked: Looked) -> dict[str, str]:
    rows = {"frames": f"{looked.frames}, {looked.rate_hz:.6g} a second, {looked.exposure_s:.4g} s each"}
    if looked.spots is not None:
        half = looked.spots.light.shape[-1] // 2
        rows["spots"] = ", ".join(f"at {x},{y}" for x, y in looked.spots.corners + half)
        rows["kernel"] = f"{looked.sd:.3g} pixels (standard deviation)"
    else:
        rows["region"] = ", ".join(_about(each) for each in looked.regions[:1])
    for line, parts, n in zip(looked.found.lines, looked.found.sets, looked.harmonics, strict=True):
        rows[f"{line.hz:.4g} Hz"] = f"{in_set(parts)}; {size_of(line, looked)}{'' if n == 1 else f'; harmonic {n}'}"
    rows["places"] = f"move by {looked.moved:.3g} pixels rms from frame to frame; {looked.rest:.2g} are not explained"
    return rows


def _about(region: Region) -> str:
    x, y = region.x + region.columns // 2, region.y + region.rows // 2
    return f"{region.columns} x {region.rows} pixels about {x},{y}"


def _whole(looked: Looked) -> Figure:
    figure = new_figure(100, 75)
    _draw_whole(looked, figure.subplots())
    return figure


def _draw_whole(looked: Looked, axes: Axes) -> None:
    shown = looked.picture
    low, high = np.quantile(shown, [0.001, 0.999])
    axes.imshow(shown, cmap="gray", vmin=float(low), vmax=float(max(high, low + 1e-9)))
    boxes = [(each.x, each.y, each.columns, each.rows) for each in looked.regions[:1]]
    if looked.spots is not None:
        side = looked.spots.light.shape[-1]
        boxes = [(int(x), int(y), side, side) for x, y in looked.spots.corners]
    for number, (x, y, columns, rows) in enumerate(boxes, 1):
        across, down = (np.array(corners) for corners in ((0, 1, 1, 0, 0), (0, 0, 1, 1, 0)))
        axes.plot(x - 0.5 + columns * across, y - 0.5 + rows * down, color="tab:orange", linewidth=0.8)
        axes.annotate(str(number), (x, y), color="tab:orange", fontsize=7, ha="right", va="bottom")
    axes.set(
        xlabel="x, pixels", ylabel="y, pixels", xlim=(-0.5, shown.shape[1] - 0.5), ylim=(shown.shape[0] - 0.5, -0.5)
    )


def _places(looked: Looked) -> Figure:
    figure = new_figure(140, 60)
    _draw_places(looked, figure.subplots())
    return figure


def _draw_places(looked: Looked, axes: Axes) -> None:
    """Place against time along the direction of the first vibration, or along x."""
    places = np.nan_to_num(looked.places - np.nanmean(looked.places, axis=0))
    along = np.array([1.0, 0.0])
    if looked.found.lines:
        angle = looked.found.lines[0].ellipse[2]
        along = np.array([math.cos(angle), math.sin(angle)])
    times = looked.seen.times_s
    axes.plot(times, places @ along, ".", markersize=3, color="black", label="mean of a frame")
    if looked.found.lines:
        inside = (np.arange(STEPS) + 0.5) / STEPS - 0.5
        fine = times[:, None] + inside * looked.exposure_s
        drift = looked.found.drift[:, 0] @ looked.seen.axes[0]
        path = (looked.path(fine) + (drift - drift.mean(axis=0))[:, None]) @ along
        joined = np.concatenate([path, np.full((len(path), 1), np.nan)], axis=1)
        at = np.concatenate([fine, fine[:, -1:]], axis=1)
        axes.plot(at.ravel(), joined.ravel(), color="tab:orange", linewidth=0.8, label="path, 95 %")
        band = _BAND * looked.rest / math.sqrt(2)
        axes.fill_between(
            at.ravel(), joined.ravel() - band, joined.ravel() + band, color="tab:orange", alpha=0.25, linewidth=0
        )
    last = min(len(times) - 1, _SHOWN)
    axes.set(xlabel="time, s", ylabel="place, pixels", xlim=(times[0] - looked.exposure_s, times[last]))
    legend_above(axes)


def _spectrum(looked: Looked) -> Figure:
    figure = new_figure(140, 70)
    first, second = figure.subplots(2, 1)
    places = np.nan_to_num(looked.places - np.nanmean(looked.places, axis=0))
    hz = np.linspace(0, looked.rate_hz / 2, _POINTS // 4)
    turned = np.exp(-2j * np.pi * hz[:, None] * looked.seen.times_s) @ places
    first.plot(hz, 2 / len(places) * np.sqrt((np.abs(turned) ** 2).sum(axis=1)), color="black", linewidth=0.7)
    first.set(xlabel="frequency, Hz (a plain spectrum)", ylabel="pixels", xlim=(0, looked.rate_hz / 2), ylim=(0, None))
    _draw_evidence(looked, second)
    return figure


def _draw_evidence(looked: Looked, axes: Axes) -> None:
    """How much each frequency explains of the places and of the blur, over what the best one does."""
    of = Vibration(looked.seen)
    means, spreads, constants, _ = of.scan(())
    none, off, constant = of.chi_squares(())
    parts = [part for each in looked.found.sets for part in each]
    top = max([1.2 * part.high for part in parts] + [2 * looked.rate_hz])
    shown = of.hz < top
    places, blur = none - means, off + constant - spreads - constants
    for name, gained, color, width in (("places", places, "0.6", 0.5), ("blur", blur, "tab:blue", 1.2)):
        found = np.sqrt(np.maximum(gained[shown], 0.0))
        axes.plot(of.hz[shown], found / max(float(found.max()), 1e-12), color=color, linewidth=width, label=name)
    for part in parts:
        axes.axvline(part.best, color="tab:orange", linewidth=2.5, alpha=0.35, zorder=0)
    for k in range(1, math.ceil(2 * top / looked.rate_hz)):
        axes.axvline(k * looked.rate_hz / 2, color="tab:gray", linewidth=0.4, linestyle=":")
    axes.set(xlabel="frequency, Hz", xlim=(0, top), ylim=(0, 1.05), ylabel="evidence / highest")
    legend_above(axes)


def _played(looked: Looked) -> str:
    """One blurred frame, restored, and played in slow motion inside its exposure: its sharpest like along the path."""
    from PIL import Image
    from scipy import ndimage

    inside = (np.arange(2 * STEPS) + 0.5) / (2 * STEPS) - 0.5
    times = looked.seen.times_s[:, None] + inside * looked.exposure_s
    path = looked.path(times)
    blurs = path.var(axis=1).sum(axis=1)
    number, sharp = int(blurs.argmax()), int(blurs.argmin())
    cut = np.nan_to_num(looked.cut)
    if not looked.regions:
        y, x = np.indices(cut.shape[1:])
        middle = [float((cut[sharp] * each).sum() / cut[sharp].sum()) for each in (y, x)]
        still = np.exp(-((y - middle[0]) ** 2 + (x - middle[1]) ** 2) / (2 * looked.sd**2)) * cut.max()
    else:
        still = cut[sharp]
    moves = path[number] - path[sharp].mean(axis=0)
    frames = [ndimage.shift(still, move[::-1], order=1, mode="nearest") for move in moves]
    edge = MARGIN if looked.regions else 0
    shown = [each[edge : each.shape[0] - edge, edge : each.shape[1] - edge] for each in (cut[number], *frames)]
    psf = motion_psf((path[number] - path[number].mean(axis=0)).T, None, PIXEL, 1.0)
    restored = restore(shown[0], psf).image
    low, high = float(shown[0].min()), float(max(shown[0].max(), shown[1].max()))

    def picture(values: FloatArray) -> Image.Image:
        grey = np.clip((values - low) / max(high - low, 1e-12) * 255, 0, 255).astype(np.uint8)
        factor = max(1, _LARGE // max(values.shape))
        return Image.fromarray(np.kron(grey, np.ones((factor, factor), np.uint8)))

    def embedded(file: io.BytesIO, kind: str) -> str:
        data = base64.b64encode(file.getvalue()).decode()
        return f'<img alt="" style="width: 32%" src="data:image/{kind};base64,{data}">'

    blurred, sharp_one, film = io.BytesIO(), io.BytesIO(), io.BytesIO()
    picture(shown[0]).save(blurred, "PNG")
    picture(restored).save(sharp_one, "PNG")
    first, *rest = (picture(each) for each in shown[1:])
    first.save(film, "GIF", save_all=True, append_images=rest, duration=80, loop=0)
    caption = (
        f"Frame {number} as it was taken, restored with the path that was found as its blur, and played in slow motion"
        " inside its exposure along that path."
    )
    shown_all = " ".join(embedded(*each) for each in ((blurred, "png"), (sharp_one, "png"), (film, "gif")))
    return f"<figure>{shown_all}<figcaption>{caption}</figcaption></figure>"
