"""What a series shows at one look, drawn with matplotlib on the caller's axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from aolink.colours import estimator_colour
from aolink.errors import ExportError
from aolink.estimation.frames.spots import profiles
from aolink.exporting.common import check_frame, needed, together
from aolink.exporting.series import Series
from aolink.exposure import Exposure
from aolink.optics.camera import to_density
from aolink.optics.sensor import BaseSensor, Sensor, SpotSensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FloatArray = NDArray[np.float64]

_POINTS_OF_PATH = 9
"""Of a path within its exposure."""
_SIZE_IN = (10.0, 6.0)
_BRIGHTEST = 98.0
"""Percentile of the exposures' brightest pixels that is drawn black."""


def plot(
    series: Series, estimators: Sequence[str] | None, output: int, axes: tuple[Axes, Axes] | None
) -> tuple[Axes, Axes]:
    """What `Series.plot` draws."""
    names = series.named(estimators)
    pyplot = needed("matplotlib.pyplot", "plot", "a plot")
    if not 0 <= output < series.rig.n_outputs:
        raise ExportError(f"there is no output {output}: {series.path} has {series.rig.n_outputs}, counted from 0")
    step_s, paths = series.rig.timing.fast_step_s, PathLines(series.rig.timing.fast_step_s)
    seen: list[FloatArray] = []
    spans: list[tuple[float, float]] = []
    nis: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    axis = output // series.rig.plant.n_outputs
    first_step = None
    for exposure, estimates in together(series, names):
        check_frame(series, exposure)
        first_step = exposure.first_step if first_step is None else first_step
        begin = (exposure.first_step - first_step) * step_s
        spans.append((begin, begin + exposure.n_steps * step_s))
        seen.append(_profile(series.rig.sensor, exposure, output))
        if exposure.truth is not None:
            paths.add("truth", begin, exposure.truth.path[output])
        for name, estimate in zip(names, estimates, strict=True):
            if estimate is not None:
                paths.add(name, begin, estimate.path[output])
                if estimate.innovation.shape[1]:
                    nis[name].append((begin, float(estimate.nis[axis])))
    above, below = axes or pyplot.subplots(2, 1, sharex=True, figsize=_SIZE_IN, height_ratios=(3, 1), layout="tight")[1]
    line = series.rig.sensor.profile
    brightest = [np.nanmax(each) for each in seen if not np.isnan(each).all()]
    top = float(np.percentile(brightest, _BRIGHTEST)) if brightest else line.peak_density
    draw_blur(above, line, spans, seen, top)
    paths.draw(above, 0.9)
    above.set(title=series.path.name, ylabel=f"output {output} (slope units)", ylim=line.field)
    for name, points in nis.items():
        if points:
            below.plot(*np.array(points).T, ".-", color=colour(name), linewidth=0.6, label=name)
    below.set(xlabel="time (s)", ylabel="NIS")
    if any(nis.values()):
        below.set_yscale("log")
    if names or paths.known:
        above.legend(loc="upper right", ncols=4)
    return above, below


def draw_blur(
    axes: Axes, line: Sensor, spans: Sequence[tuple[float, float]], seen: Sequence[FloatArray], top: float
) -> None:
    """Profiles of exposures as columns over their times, from begin to end; a lost frame leaves its place empty."""
    blur = np.full((line.pixels, 2 * len(spans) - 1), np.nan)
    blur[:, ::2] = np.stack(seen, axis=1)
    edges = np.ravel(spans)
    axes.pcolormesh(edges, line.edges, blur, cmap="Greys", vmin=0, vmax=1.2 * max(top, 1e-12), rasterized=True)


class PathLines:
    """Paths of all exposures as one line for each name, with gaps between them."""

    def __init__(self, step_s: float) -> None:
        self._step_s = step_s
        self.known: dict[str, list[FloatArray]] = {}
        """Times and places by name, (2, points) for each exposure."""

    def add(self, name: str, begin: float, path: FloatArray) -> None:
        some = np.unique(np.linspace(0, len(path) - 1, _POINTS_OF_PATH).astype(int))
        gap = np.full((2, 1), np.nan)
        self.known.setdefault(name, []).extend([np.stack([begin + some * self._step_s, path[some]]), gap])

    def draw(self, axes: Axes, width: float) -> None:
        for name, lines in self.known.items():
            width_of = 1.4 if name == "truth" else width
            axes.plot(*np.concatenate(lines, axis=1), color=colour(name), linewidth=width_of, label=name)


def _profile(sensor: BaseSensor, exposure: Exposure, output: int) -> FloatArray:
    """Intensity density over the positions of one output, (pixels,); NaN where a pixel never came."""
    counts, mask = exposure.pixels.astype(np.float64), exposure.mask
    if isinstance(sensor, SpotSensor):
        found = profiles(sensor, exposure.pixels, exposure.mask)
        counts, mask = np.asarray(found.counts[output], dtype=np.float64), found.mask[output]
    return np.where(mask, to_density(sensor.profile, counts), np.nan).ravel()


def colour(name: str) -> tuple[float, ...]:
    """As in the viewer, but for the truth, whose yellow is hard to see on white."""
    return (0.0, 0.0, 0.0) if name == "truth" else tuple(part / 255 for part in estimator_colour(name))
