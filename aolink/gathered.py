"""What is drawn of a recording, as plain arrays, with its names and units: gathered here once, and drawn from it by
Rerun (`aolink.viewing`) and by matplotlib (`aolink.plotting`)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from aolink.estimation.estimate import Estimate, Status
from aolink.estimation.frames.measure import profiles_of
from aolink.exposure import Exposure, Truth
from aolink.numerics.arrays import FloatArray, IntArray
from aolink.numerics.chi_square import chi_square_quantile
from aolink.optics.camera import to_density
from aolink.optics.frame import spot_windows
from aolink.optics.scene import SceneSensor
from aolink.optics.sensor import BaseSensor, RegionSensor, Sensor
from aolink.recording import topics
from aolink.rig import Rig
from aolink.series import Step

if TYPE_CHECKING:
    from aolink.recording.reader import Recording

BAND = 2.0
"""Standard deviations to each side of an estimate."""
NIS_COVERAGE = 0.95
"""Probability that a consistent estimator's NIS lies inside the bounds drawn."""
SLOPES, PER_SLOPE = "slope units", "1/slope unit"
"""Units of a position, and of a density over positions."""
SCENES = {"came": "as it came", "restored": "restored", "true": "at rest"}
"""The pictures of a scene."""
MAPS = {
    "light": ("light", "1 = a lenslet wholly lit", "viridis"),
    "slope_x": ("mean slope x", SLOPES, "RdBu_r"),
    "slope_y": ("mean slope y", SLOPES, "RdBu_r"),
    "blur": ("blur", f"RMS of the path, {SLOPES}", "magma"),
    "nis": ("NIS", "no unit", "magma"),
}
"""Maps over the lenslets by the name of their values: title, meaning of the colours, colour map."""
FRAME_INCIDENTS = ("frames lost", "frames incomplete", "inputs not reported")
NO_TIME, VERDICT = "no time for it", "verdict"
REFUSED = {
    Status.GATED: "gated",
    Status.DIVERGED: "diverged",
    Status.REINITIALISED: "begun anew",
    Status.INPUT_INVALID: "not usable",
}
"""Words for an estimate whose exposure was not used normally."""

_KERNELS = 4.0
"""The drawn field reaches this many of the kernel's standard deviations beyond the paths."""
_LEAST_SPOTS = 4
_ENVELOPE_FROM = 0.5
"""Where a curve through some points of a path misses it by this share of its motion (RMS), its range is drawn."""
_ERF_AT = np.linspace(-5.0, 5.0, 1001)
_ERF = np.array([math.erf(u) for u in _ERF_AT.tolist()])
"""The error function; linear interpolation between these points is wrong by 1e-5. Loading SciPy's takes a third of a
second."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Blur:
    """The blur of one exposure along one output, and the paths that explain it."""

    sensor: BaseSensor
    output: int
    exposure: Exposure
    measured: FloatArray
    """Intensity density, one over slope units, (pixels,); NaN where a pixel never came."""
    paths: Mapping[str, FloatArray]
    """Name (``truth``, first, or an estimator's) -> position at each fast step of the output's own interval, slope
    units."""

    @classmethod
    def of(cls, rig: Rig, step: Step, output: int) -> Blur:
        """The blur of a step of a series."""
        exposure, line = step.exposure, rig.sensor.profile
        found = profiles_of(rig.sensor, exposure.pixels, exposure.mask)
        measured = np.where(found.mask[output], to_density(line, found.counts[output]), np.nan)
        plant = rig.plant
        late = plant.delays[output % plant.n_outputs] if plant.delays else 0  # the output's own interval
        own = slice(late, late + exposure.n_steps - plant.last_delay)
        paths = {name: path[own] for name, (path,) in paths_of(step, [output]).items()}
        return cls(sensor=rig.sensor, output=output, exposure=exposure, measured=measured, paths=paths)

    @property
    def line(self) -> Sensor:
        """The sensor's pixels along the output."""
        return self.sensor.profile

    @cached_property
    def centroid(self) -> float:
        """The measured slope: what other software measured, or the density's mean, missing pixels counting as dark."""
        if self.exposure.slopes is not None:
            return float(self.exposure.slopes[self.output])
        if isinstance(self.sensor, RegionSensor):
            seen = self.sensor.texture.seen(to_density(self.sensor, self.exposure.pixels))
            return math.nan if seen is None else float(seen.mean @ self.sensor.texture.axes[:, self.output])
        return float(np.nansum(self.line.centres * self.measured) * self.line.pixel_width)

    @property
    def limits(self) -> tuple[float, float]:
        """The part of the field that holds the paths and their blur, slope units."""
        return limits_of(self.line, list(self.paths.values()))

    def predicted(self, name: str) -> FloatArray:
        """Density in each pixel that a path predicts, as `exposure_density` gives it, (pixels,)."""
        line = self.line
        if isinstance(self.sensor, RegionSensor):
            at_rest, places = self.sensor.at_rest.sum(axis=self.output), line.centres - self.paths[name][:, None]
            return np.asarray(np.interp(places, line.centres, at_rest).mean(axis=0) * line.pixel_width)
        u = (line.edges - self.paths[name][:, None]) / math.sqrt(2 * line.kernel.variance)
        share = np.diff(np.interp(u, _ERF_AT, _ERF).mean(axis=0)) / (2 * line.pixel_width)
        return np.asarray(self.sensor.light_of(self.output) * share)

    def histogram(self, name: str, width: float | None = None) -> tuple[FloatArray, FloatArray]:
        """How long a path stays at a position: density in each bin of a width (half a pixel by default), and the bins'
        edges."""
        line, path = self.line, self.paths[name]
        bin_width = width or 0.5 * line.pixel_width
        bins = ((np.clip(path, *line.field) - line.field[0]) / bin_width).astype(int)
        low, high = int(bins.min()), int(bins.max())
        density = np.bincount(bins - low) / (len(path) * bin_width)
        return density, np.asarray(line.field[0] + bin_width * np.arange(low, high + 2), dtype=np.float64)


def paths_of(step: Step, outputs: Sequence[int] | None = None) -> dict[str, FloatArray]:
    """The paths of some outputs or all by their names, (outputs, n_steps), the truth before the estimates. A path that
    is not known in one of these outputs is left out; of all outputs, none is."""
    truth = step.exposure.truth
    found: dict[str, Truth | Estimate] = {**({"truth": truth} if truth is not None else {}), **step.estimates}
    if outputs is None:
        return {name: each.path for name, each in found.items()}
    chosen = list(outputs)
    paths = {name: each.path[chosen] for name, each in found.items()}
    return {name: path for name, path in paths.items() if np.isfinite(path).all()}


def limits_of(line: Sensor, paths: Sequence[FloatArray]) -> tuple[float, float]:
    """The part of the field that holds the paths and their blur, slope units; the whole field where there are no
    paths."""
    known = [path for path in paths if np.isfinite(path).any()]
    if not known:
        return line.field
    reach = _KERNELS * line.kernel.sigma
    low = max(min(float(np.nanmin(path)) for path in known) - reach, line.field[0])
    high = min(max(float(np.nanmax(path)) for path in known) + reach, line.field[1])
    return (low, high) if low < high else line.field


def extremes(path: FloatArray, segments: int) -> tuple[FloatArray, FloatArray]:
    """The least and the largest value of a path in each of its segments, (segments,) each."""
    parts = np.array_split(path, min(segments, len(path)))
    return np.array([part.min() for part in parts]), np.array([part.max() for part in parts])


def hides_swings(path: FloatArray, count: int) -> bool:
    """Whether a curve through ``count`` points of a path, spread evenly, misses most of its motion."""
    places = np.linspace(0, len(path) - 1, min(count, len(path)))
    drawn = np.interp(np.arange(len(path)), places, path[places.astype(int)])
    return bool(np.std(path - drawn) > _ENVELOPE_FROM * np.std(path))


def some_rows(values: FloatArray, count: int) -> IntArray:
    """The rows to keep of curves, (rows, curves), that have more than ``count`` rows: the extremes of each part, and
    the ends; NaN is no extreme."""
    rows, curves = values.shape
    if rows <= count:
        return np.arange(rows)
    size = -(-rows // max(1, count // (2 * curves)))
    known = np.where(np.isfinite(values), values, np.nanmean(values) if np.isfinite(values).any() else 0.0)
    parts = np.pad(known, ((0, -rows % size), (0, 0)), mode="edge").reshape(-1, size, curves)
    starts = size * np.arange(len(parts))[:, None]
    kept = [np.minimum(starts + find(parts, axis=1), rows - 1).ravel() for find in (np.argmin, np.argmax)]
    return np.unique(np.concatenate([[0, rows - 1], *kept]))


@lru_cache(maxsize=64)
def nis_bounds(degrees_of_freedom: int) -> tuple[float, float]:
    """The bounds of a consistent estimator's NIS in `NIS_COVERAGE` of the exposures (two-sided)."""
    tail = (1 - NIS_COVERAGE) / 2
    return chi_square_quantile(tail, degrees_of_freedom), chi_square_quantile(1 - tail, degrees_of_freedom)


def incidents_of(before: Exposure | None, step: Step) -> Iterator[tuple[str, str]]:
    """What went wrong with an exposure: the kind of each incident, and a sentence.

    Kinds are `FRAME_INCIDENTS` and, of each estimator, "NAME: " with a word of `REFUSED`, `NO_TIME` or `VERDICT`.
    Frames are lost after the exposure ``before``.
    """
    e = step.exposure
    lost, incomplete, assumed = FRAME_INCIDENTS
    if before is not None and (count := e.frame_id - before.frame_id - 1) > 0:
        yield lost, f"{count} frame{'s' if count > 1 else ''} lost before frame {e.frame_id}"
    if e.slopes is None and not e.mask.all():
        yield incomplete, f"frame {e.frame_id} is incomplete: {1 - e.mask.mean():.0%} of its pixels never came"
    if e.inputs_assumed:
        yield assumed, f"frame {e.frame_id}: the mirror did not report its input in {e.inputs_assumed} steps"
    for name in step.skipped:
        yield f"{name}: {NO_TIME}", f"{name} had no time for frame {e.frame_id}"
    for name, estimate in step.estimates.items():
        if (word := REFUSED.get(estimate.status)) is not None:
            why = f": {estimate.reason}" if estimate.reason else ""
            yield f"{name}: {word}", f"{name}: frame {e.frame_id} {word}{why}"
        if estimate.verdict is not None and estimate.verdict.begins_with(e.frame_id):
            yield f"{name}: {VERDICT}", f"{name}: frame {e.frame_id}: {estimate.verdict.text}"


def has_pupil(rig: Rig) -> bool:
    """Whether the sensor has lenslets enough for a map."""
    return rig.sensor.spots >= _LEAST_SPOTS


def maps_of(rig: Rig, exposure: Exposure, estimate: Estimate | None) -> dict[str, FloatArray]:
    """Maps over the lenslets by the names of `MAPS`, (rows, columns) of the grid, as far as an exposure and its
    estimate have them; NaN where no light falls.

    Without an estimate slopes are the spots' centroids. NIS is there where each spot has axes of its own, and NaN
    where nothing was measured.
    """
    sensor = rig.sensor
    found: dict[str, FloatArray] = {}
    if exposure.mask.any():
        density = np.where(exposure.mask, to_density(sensor, exposure.pixels), 0.0)
        found["light"] = spot_windows(sensor, density).sum(axis=(-2, -1)) * sensor.pixel_size
    if estimate is None:
        slopes = exposure.slopes if exposure.slopes is not None else _centroids(sensor, exposure)
    else:
        slopes = estimate.path.mean(axis=1)
        blur = np.mean((estimate.path - slopes[:, None]) ** 2, axis=1)
        found["blur"] = np.sqrt(blur.reshape(-1, 2).sum(axis=1))
        if rig.plant.n_outputs <= 2 and estimate.innovation.shape[1]:
            measured = np.where(estimate.nis > 0, estimate.nis, np.nan)
            found["nis"] = measured.reshape(-1, 2 // rig.plant.n_outputs).mean(axis=1)
    found["slope_x"], found["slope_y"] = np.reshape(slopes, (-1, 2)).T
    maps = {}
    for name, values in found.items():
        whole = np.full(sensor.grid[0] * sensor.grid[1], np.nan)
        whole[sensor.lit] = values
        maps[name] = whole.reshape(sensor.grid)
    return maps


def _centroids(sensor: BaseSensor, exposure: Exposure) -> FloatArray:
    """Centre of each output's profile, slope units, (n_outputs,); NaN where no light came."""
    line, found = sensor.profile, profiles_of(sensor, exposure.pixels, exposure.mask)
    density = np.where(found.mask, to_density(line, np.asarray(found.counts, dtype=np.float64)), 0.0)
    light = density.sum(axis=1)
    return np.asarray(np.divide(density @ line.centres, light, out=np.full(len(light), np.nan), where=light > 0))


def scene_of(sensor: SceneSensor | None, exposure: Exposure) -> FloatArray | None:
    """The picture sensor's scene as it came, intensity, (rows, columns); NaN where a pixel never came."""
    if sensor is None or exposure.scene is None:
        return None
    return np.where(exposure.scene.mask, sensor.to_intensity(exposure.scene.pixels), np.nan)


def lost_before(exposures: Sequence[Exposure], before: Exposure | None) -> int:
    """How many frames were lost between exposures, and between these and the one ``before`` them."""
    every = [*([before] if before is not None else []), *exposures]
    return sum(b.frame_id - a.frame_id - 1 for a, b in pairwise(every))


def lacks(recording: Recording) -> list[str]:
    """Sentences about the data that a recording lacks, and how to make them."""
    counts = recording.counts
    restored = recording.rig.scene is None or topics.RESTORED_SCENE in counts
    said = {
        "It holds no estimates; `aolink estimate` makes them.": recording.estimators,
        "The truth is not known, so there are no errors, only NIS.": recording.has_truth,
        "It holds no commands.": topics.COMMAND in counts,
        "It holds no reports of the mirror; inputs are those commanded, or zero.": topics.APPLIED in counts,
        "It holds no latencies: it was recorded on virtual time, or imported.": topics.LATENCY in counts,
        "Its pictures were not restored; `aolink deblur` does that.": restored,
        f"It is damaged: {recording.damage}.": not recording.damage,
    }
    return [text for text, there in said.items() if not there]
