"""The figures: like the paper's 4 to 7, the results of remarks 1 and 2, and the map o3/o1."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from judging.sampled import NAME as LIMIT
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

import aolink
from aolink.colours import estimator_colour
from aolink.estimation import BlurFilter, Estimate, Estimator, PathMoments, run
from aolink.estimation.frames.moments import measure_moments
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import to_density
from aolink.rig import Rig
from paper_report.ensemble import Cell, IntervalEstimate, clean_exposures, errors, side_by_side, with_pixel_noise
from paper_report.family import SWINGS, draw
from paper_report.judge import Row
from paper_report.limit import NAMES, SceneErrors
from paper_report.limit import Scene as LimitScene
from paper_report.numbers import Effort, Remark1, Remark2
from paper_report.verdict import JUDGED, SCENE_INSIDE, by_estimator, ratios

_STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.constrained_layout.use": True,
    "lines.linewidth": 1.4,
    "mathtext.fontset": "dejavusans",
}
_TRUTH = "black"
_DASHES: dict[str, str | tuple[int, tuple[int, ...]]] = {"o1": "-", "o2": (0, (5, 2)), "o3": "-"}
_GRID = {"color": "0.9", "linewidth": 0.7}

FIRST_THETA = 0.3
"""Start of the spot in figures 4 and 5, while the filters' prior has mean 0 and this standard deviation."""


@dataclass(frozen=True)
class Scene:
    """One rig's part in the figures."""

    rig: Rig
    title: str


def scenes(printed: Rig, lively: Rig) -> list[Scene]:
    """The printed noise and the lively variant."""

    def title(name: str, rig: Rig) -> str:
        W, V = rig.plant.process_noise[0, 0], rig.sensor.noise_density
        return f"{name}: $W_f$ = {W:g}, $V$ = {V:g}"

    return [Scene(printed, title("printed noise", printed)), Scene(lively, title("lively", lively))]


@contextmanager
def _figure(path: Path, dpi: int, size: tuple[float, float], rows: int, columns: int, **options: object) -> Iterator[
    tuple[Figure, NDArray[np.object_]]
]:  # fmt: skip
    """A figure that is saved under ``path`` when it is done."""
    with mpl.rc_context(_STYLE):
        figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, **options)  # type: ignore[call-overload]
        yield figure, axes
        figure.savefig(path, dpi=dpi, metadata={"Software": "aolink tools/paper"})
        plt.close(figure)


def _colour(name: str) -> tuple[float, float, float]:
    red, green, blue = estimator_colour(name)
    return (red / 255, green / 255, blue / 255)


def displaced(rig: Rig) -> tuple[Rig, Rig]:
    """Section VI prints no x(0): a rig whose spot starts at `FIRST_THETA`, and the filters' prior."""
    theta = FIRST_THETA / rig.plant.C[0, 0]
    nothing = np.zeros_like(rig.plant.initial_covariance)
    there = dataclasses.replace(rig.plant, initial_mean=np.array([theta, 0.0]), initial_covariance=nothing)
    wide = rig.plant.initial_covariance.copy()
    wide[0, 0] = theta**2
    believed = dataclasses.replace(rig.plant, initial_covariance=wide)
    return dataclasses.replace(rig, plant=there), dataclasses.replace(rig, plant=believed)


def _paths(estimates: Sequence[Estimate]) -> FloatArray:
    return np.concatenate([e.path[0] for e in estimates])


def _truth(exposures: Sequence[Exposure]) -> FloatArray:
    return np.concatenate([e.truth.path[0] for e in exposures if e.truth is not None])


def _times(exposures: Sequence[Exposure], rig: Rig) -> FloatArray:
    first = exposures[0].first_step
    return np.asarray((first + np.arange(sum(e.n_steps for e in exposures))) * rig.timing.fast_step_s)


def figure_4(path: Path, chosen: Sequence[Scene], dpi: int) -> None:
    """Theta and its estimates by o1 and o2 from a wrong start."""
    with _figure(path, dpi, (7.2, 5.4), len(chosen), 1, sharex=True) as (_, axes):
        for ax, scene in zip(axes[:, 0], chosen, strict=True):
            there, believed = displaced(scene.rig)
            series = list(aolink.simulate(there, 60, seed=4))
            found, t = run(believed, series, ["o1", "o2"]), _times(series, scene.rig)
            _draw_centroids(ax, scene.rig, series)
            ax.plot(t, _truth(series), color=_TRUTH, label="truth", linewidth=1.1)
            for name, estimates in found.items():
                ax.plot(t, _paths(estimates), color=_colour(name), linestyle=_DASHES[name], label=name, linewidth=1.7)
            ax.set(ylabel=r"$\theta$ (slope units)", title=scene.title, ylim=(-0.7, 1.0), xlim=(0, t[-1]))
            ax.grid(**_GRID)
        axes[-1, 0].set_xlabel("time (s)")
        axes[0, 0].legend(ncol=4, loc="lower left")


def _draw_centroids(ax: Axes, rig: Rig, series: Sequence[Exposure]) -> None:
    """Measured centroids at the middle of their exposures."""
    half = rig.timing.exposure_steps / 2
    points = [
        ((e.first_step + half) * rig.timing.fast_step_s, m.value[0, 0])
        for e in series
        if not isinstance(m := measure_moments(rig.sensor.profile, e.pixels, (1,)), str)
    ]
    ax.plot(*np.array(points).T, ".", color="0.65", markersize=4, label="$y_1$ as measured", zorder=1)


def figure_5(
    path: Path, chosen: Sequence[Scene], effort: Effort, levels: Sequence[dict[str, IntervalEstimate]]
) -> None:
    """State error norms from a wrong start, over the exposures; one run, and root mean squares of many."""
    count = effort.exposures + 10
    with _figure(path, effort.dpi, (7.2, 5.4), len(chosen), 1, sharex=True) as (_, axes):
        for ax, scene, level in zip(axes[:, 0], chosen, levels, strict=True):
            for name, squares in _start_errors(scene.rig, effort.runs, count).items():
                _draw_norms(ax, name, squares)
            for name in ("o1", "o3"):
                _mark_level(ax, count, level[name], name)
            ax.set(ylabel=r"$\|\hat{x} - x\|_2$ at exposure start", title=scene.title, xlim=(1, count), ylim=(0, None))
            ax.grid(**_GRID)
        axes[-1, 0].set_xlabel("exposure number $j$")
        axes[0, 0].legend(title="thin: one run; thick: rms of all runs", loc="upper right", title_fontsize=8.5)


def _start_errors(rig: Rig, runs: int, count: int) -> dict[str, FloatArray]:
    """Squared norms of the start state's errors from a wrong start, (runs, exposures), by estimator."""
    there, believed = (side_by_side(each, runs) for each in displaced(rig))
    series = with_pixel_noise(there, clean_exposures(there, count, seed=14), seed=15)
    varying = Estimator(believed, "o1", BlurFilter(believed.plant, PathMoments(believed.plant, (1,))))
    found = {**run(believed, series, ["o1", "o3"]), "o1, time-varying gain": [varying.step(e) for e in series]}
    return {name: errors(series, estimates, 0).start for name, estimates in found.items()}


def _draw_norms(ax: Axes, name: str, squares: FloatArray) -> None:
    j, colour = np.arange(1, squares.shape[1] + 1), _colour(name[:2])
    thick = np.sqrt(squares.mean(axis=0))
    if name not in _DASHES:
        ax.plot(j, thick, color="0.25", linewidth=1.3, linestyle=(0, (1, 1.5)), label=name, zorder=4)
        return
    ax.plot(j, np.sqrt(squares[0]), color=colour, alpha=0.5, linewidth=0.8)
    ax.plot(j, thick, color=colour, linewidth=2, label=name, linestyle="-" if name == "o1" else (0, (4, 2)))


def _mark_level(ax: Axes, count: int, level: IntervalEstimate, name: str) -> None:
    """The steady level in the right margin."""
    place = (15, 8 if name == "o1" else -8)
    arrow = {"arrowstyle": "-", "color": _colour(name), "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0}
    ax.annotate(f"{name}: {level.value:.3f}", (count, level.value), place, textcoords="offset points", va="center",
                fontsize=8.5, annotation_clip=False, arrowprops=arrow)  # fmt: skip


def figure_6(path: Path, chosen: Sequence[Scene], dpi: int, first: int = 25, count: int = 15) -> None:
    """Error of theta at the fast rate over a section of the run."""
    with _figure(path, dpi, (7.2, 5.0), len(chosen), 1, sharex=True) as (_, axes):
        for ax, scene in zip(axes[:, 0], chosen, strict=True):
            series = list(aolink.simulate(scene.rig, first + count, seed=6))
            section = series[first:]
            truth, t = _truth(section), _times(section, scene.rig)
            for start in t[:: scene.rig.timing.exposure_steps]:
                ax.axvline(start, color="0.9", linewidth=0.7)
            ax.axhline(0, color="0.5", linewidth=0.8)
            for name, estimates in run(scene.rig, series, ["o1", "o3"]).items():
                error = _paths(estimates[first:]) - truth
                ax.plot(t, error, color=_colour(name), label=f"{name}, rms {np.sqrt(np.mean(error**2)):.3f}")
            ax.set(ylabel=r"$\hat{\theta} - \theta$ (slope units)", title=scene.title, xlim=(t[0], t[-1]))
            ax.legend(loc="upper right", ncol=2)
            ax.margins(y=0.25)
        axes[-1, 0].set_xlabel("time (s); grey lines: exposures start")


def figure_7(path: Path, chosen: Sequence[Scene], dpi: int, exposure: int = 32) -> None:
    """Inside one exposure: truth and estimates with their bands, and the camera's frame."""
    with _figure(path, dpi, (7.2, 5.6), 2, len(chosen), height_ratios=[2, 1]) as (figure, axes):
        for (above, below), scene in zip(axes.T, chosen, strict=True):
            series = list(aolink.simulate(scene.rig, exposure + 1, seed=7))
            found = run(scene.rig, series, ["o1", "o3"])
            t = np.arange(series[-1].n_steps) * scene.rig.timing.fast_step_s * 1e3
            for name, estimates in found.items():
                last = estimates[-1]
                above.plot(t, last.path[0], color=_colour(name), label=name, linewidth=1.8)
                low, high = last.path[0] - 2 * last.path_sd[0], last.path[0] + 2 * last.path_sd[0]
                above.fill_between(t, low, high, color=_colour(name), alpha=0.16, linewidth=0)
                for edge in (low, high):
                    above.plot(t, edge, color=_colour(name), linewidth=0.8, linestyle=(0, (4, 2)))
            above.plot(t, _truth(series[-1:]), color=_TRUTH, label="truth", linewidth=1.2)
            above.set(title=scene.title, xlabel="time in the exposure (ms)", xlim=(0, t[-1]))
            above.grid(**_GRID)
            _draw_frame(below, scene.rig, series[-1])
        axes[0, 0].set_ylabel(r"$\theta$ (slope units)")
        axes[1, 0].set_ylabel("density (1/slope)")
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncol=3)


def _draw_frame(ax: Axes, rig: Rig, exposure: Exposure) -> None:
    """Draw the frame as the camera read it, and the truth's own histogram as a range."""
    sensor = rig.sensor.profile
    density = to_density(sensor, exposure.pixels)[0]
    ax.stairs(density, sensor.edges, color="0.35", fill=True, alpha=0.35, linewidth=0)
    ax.stairs(density, sensor.edges, color="0.35", linewidth=0.8)
    path = _truth([exposure])
    ax.axvspan(path.min(), path.max(), color="black", alpha=0.12, linewidth=0)
    ax.axhline(0, color="0.5", linewidth=0.8)
    ax.set(xlabel=r"$\omega$ (slope units); band: where the spot went", xlim=rig.sensor.field)


def figure_remarks(path: Path, first: Remark1, second: Remark2, dpi: int) -> None:
    """Draw remark 1: the motion that the centroid loses, and remark 2: the error of o2 alone, by the offset."""
    with _figure(path, dpi, (7.2, 3.1), 1, 2) as (_, axes):
        left, right = axes[0]
        left.plot(first.frequency_hz, np.maximum(first.gain, 1e-9), color="0.6", label=r"$|\bar{C}|$")
        smallest = r"smallest s.v. of $[\bar{C}; \bar{C}A^N]$"
        left.plot(first.frequency_hz, np.maximum(first.smallest, 1e-9), color="black", label=smallest)
        left.set(xlabel="frequency of an undamped mode (Hz)", ylabel="what 200 ms leave of it", yscale="log",
                 ylim=(1e-4, 60), title="Remark 1: an undamped mode", xlim=(0, 20.5))  # fmt: skip
        left.legend(loc="upper right")
        left.grid(**_GRID)
        right.axhline(1, color=_colour("open-loop"), linewidth=1.2)
        for name, values in (("o1", second.o1), ("o2", second.o2)):
            bars = [[v.value - v.low for v in values], [v.high - v.value for v in values]]
            right.errorbar(second.offsets, [v.value for v in values], yerr=bars, color=_colour(name), marker="o",
                           markersize=4, capsize=2, linestyle=_DASHES[name], label=name)  # fmt: skip
        right.text(second.offsets[-1], 1.02, "open-loop", ha="right", fontsize=8.5)
        right.set(xlabel="offset of the spot (slope units)", ylabel="path RMSE / open loop's", ylim=(0, 1.15),
                  title="Remark 2: the lively plant")  # fmt: skip
        right.legend(loc="lower left")
        right.grid(**_GRID)


_RATIOS = (("path", "path"), ("start", "start state"), ("end", "end state"))


def figure_map(path: Path, cells: Sequence[Cell], dpi: int) -> None:
    """Heat maps of o3/o1 over offset and V, a column for each W_f, a row for each of path, start and end."""
    noises = sorted({c.process_noise for c in cells})
    offsets, densities = sorted({c.offset for c in cells}), sorted({c.noise_density for c in cells})
    size = (1.2 + 3.1 * len(noises), 7.4)
    with _figure(path, dpi, size, len(_RATIOS), len(noises), sharex=True, sharey=True) as (figure, axes):
        for row, (key, label) in zip(axes, _RATIOS, strict=True):
            for ax, noise in zip(row, noises, strict=True):
                by_place = {(c.noise_density, c.offset): getattr(c, key) for c in cells if c.process_noise == noise}
                grid = np.array([[by_place[V, x].value for x in offsets] for V in densities])
                image = ax.imshow(grid, cmap="PuOr", vmin=0.7, vmax=1.3, aspect="auto", origin="lower")
                _annotate(ax, [[by_place[V, x] for x in offsets] for V in densities], 2 if key == "path" else 3)
                ax.spines[:].set_visible(False)
                ax.set_title(f"{label}, $W_f$ = {noise:g}")
                ax.set_xticks(range(len(offsets)), [f"{x:g}" for x in offsets])
                ax.set_yticks(range(len(densities)), [f"{V:g}" for V in densities])
        for ax in axes[-1]:
            ax.set_xlabel("offset (slope units)")
        for ax in axes[:, 0]:
            ax.set_ylabel("$V$ (noise density)")
        bar = figure.colorbar(image, ax=axes, shrink=0.6, aspect=35, pad=0.015)
        bar.set_label("RMSE of o3 / RMSE of o1 (orange: o3 is better)")
        bar.outline.set_visible(False)


def _annotate(ax: Axes, grid: Sequence[Sequence[IntervalEstimate]], decimals: int) -> None:
    """Ratio and half width of its interval; bold where the interval leaves 1 out."""
    for row, values in enumerate(grid):
        for column, value in enumerate(values):
            clear, dark = value.high < 1 or value.low > 1, value.value < 0.8
            half = (value.high - value.low) / 2
            ax.text(column, row + 0.12, f"{value.value:.{decimals}f}", ha="center", va="center",
                    fontsize=9.5 - decimals, fontweight="bold" if clear else "normal",
                    color="white" if dark else "black" if clear else "0.45")  # fmt: skip
            ax.text(column, row - 0.26, f"±{half:.3f}", ha="center", va="center", fontsize=5.5,
                    color="white" if dark else "0.3")  # fmt: skip


_MARKERS = {"open-loop": "|", "o1": "o", "o3": "s", "moments": "D", "profile": "^", "sampled": "*"}


def figure_limit(path: Path, table: Sequence[LimitScene], dpi: int) -> None:
    """A row for each scene: path RMSE of all estimators, and how far they are from the sampler."""
    rows = np.arange(len(table))[::-1]
    with _figure(path, dpi, (9.5, 2.0 + 0.36 * len(table)), 1, 2, sharey=True) as (figure, ((left, right),)):
        for name in NAMES:
            style = {"marker": _MARKERS[name], "color": _colour(name), "linestyle": "none", "markersize": 6.0}
            found: list[SceneErrors] = [scene.found[name] for scene in table]
            left.plot([each.path for each in found], rows, label=name, **style)
            if name != "sampled":
                right.plot([max(each.distance, 0.01) for each in found], rows, **style)
        left.set(xscale="log", xlabel="path RMSE (slope units)", yticks=rows)
        left.set_yticklabels([scene.name for scene in table])
        right.set(xscale="log", xlabel="distance from sampled (its standard deviations)")
        for at, cost, side in ((0.32, "5 % ", "right"), (0.46, " 10 %", "left")):
            right.axvline(at, color="0.5", linewidth=0.9, linestyle=":")
            right.text(at, 1.01, cost, transform=right.get_xaxis_transform(), ha=side, va="bottom", fontsize=7.5)
        for ax in (left, right):
            ax.grid(axis="y", **_GRID)
        figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=len(NAMES))


def figure_family(path: Path, given: Sequence[Row], dpi: int) -> None:
    """Each scene a point: path RMSE over the sampler's, or over o1's without rows of it, and coverage, against swings
    in an exposure."""
    rows = by_estimator(given)
    reference, span = (LIMIT, (0.5, 4.0)) if rows[LIMIT] else ("o1", (0.0, 1.6))
    with _figure(path, dpi, (9.5, 4.2), 1, 2) as (figure, ((left, right),)):
        for name in ("o1", *JUDGED):
            style = {"marker": _MARKERS[name], "color": _colour(name), "linestyle": "none", "markersize": 4.5}
            over = ratios(rows, name, reference)
            left.plot([_swings(seed) for seed in over], list(over.values()), label=name, **style)
            found = rows[name]
            right.plot([_swings(seed) for seed in found], [np.mean(row.inside) for row in found.values()], **style)
        left.axhline(1, color=_colour(reference), linewidth=1.2)
        left.set(ylabel=f"path RMSE / {reference}'s", ylim=span)
        for end in SCENE_INSIDE:
            right.axhline(end, color="0.5", linewidth=0.9, linestyle=":")
        right.set(ylim=(0, 1.02), ylabel="coverage of 95 % intervals")
        for ax in (left, right):
            ax.set(xscale="log", xlabel="swings of the fastest mode in an exposure")
            ax.grid(**_GRID)
        figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=4)


def _swings(seed: int) -> float:
    """Swings of the fastest process in an exposure; for a random walk, which has none, the least of the family."""
    return max(draw(seed).swings, SWINGS[0] / 5)
