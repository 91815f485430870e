"""Real motion blur: a film of spheres that diffuse in water, imported as by `aolink import`.

The mean of K frames is an exposure of K fast steps whose path is measured in the single frames. The rig file is the one
that `aolink rig --from` writes: kernel, noise and random walk of the single frames. Beside the estimators stands what a
user would do instead: the centroid of each blurred picture, held for the exposure, or interpolated from one to the
next. Exposures of a sphere that has other light beside it, as `aolink import` reports, count in one table only.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from judging.sampled import NAME as LIMIT
from judging.sampled import estimator as estimator_named

from aolink.estimation import ESTIMATOR_NAMES, smooth
from aolink.exposure import Exposure
from aolink.films.formats import open_film
from aolink.importing.first_rig import first_rig
from aolink.importing.frames import FilmSettings
from aolink.importing.recording import import_film
from aolink.importing.survey import survey
from aolink.importing.tracker import find_objects
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.camera import to_density
from aolink.optics.centroid import weighted_centroid
from aolink.optics.frame import spot_windows
from aolink.optics.sensor import SpotSensor
from aolink.recording.reader import Recording
from aolink.rig import Rig, parse_rig
from paper_report.blocks import Block, Heading, Table, Text
from paper_report.ensemble import IntervalEstimate, ratio, rms
from paper_report.judge import BEYOND_95
from paper_report.numbers import Effort

FILE = Path(__file__).parents[2] / "tests" / "data" / "diffusing_spheres.npz"
NAMES = (*ESTIMATOR_NAMES, LIMIT)
_RATE_HZ = 24.0
_SKIP = 1
"""Exposures that are not scored, because the spheres' motion before is not known."""


def places() -> tuple[tuple[float, float], ...]:
    """Positions of the six spheres in the first frame, their films side by side, pixels."""
    data = np.load(FILE)
    width = data["frames"].shape[3]
    return tuple((float(x) + k * width, float(y)) for k, (x, y) in enumerate(data["tracked_xy"][:, 0]))


def spheres(K: int) -> tuple[Rig, list[Exposure], BoolArray]:
    """A rig of 12 axes, its exposures of K frames, read back from a recording, and where a sphere is seen and alone.

    The last is (exposures, 12).
    """
    settings = FilmSettings(rate_hz=_RATE_HZ, invert=True, track=6, places=places(), frames_per_exposure=K)
    film = open_film(FILE)
    rig = parse_rig(first_rig(film, settings, "spheres").text)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "spheres.mcap"
        import_film(film, rig, settings, path)
        exposures = list(Recording(path).exposures())
    known = survey(film, settings, find_objects(film, settings))
    alone = [
        known.alone(each.first_step, each.first_step + K)
        & np.isfinite(known.places[each.first_step : each.first_step + K]).all(axis=(0, 2))
        for each in exposures
    ]
    return rig, exposures, np.repeat(alone, 2, axis=1)


def centroids(rig: Rig, exposures: Sequence[Exposure]) -> tuple[FloatArray, FloatArray]:
    """Paths by the centroid of each picture, held and interpolated in time, each (exposures, outputs, K).

    The centroid has a Gaussian weight as wide as the spot; that came nearer than wider ones and than none.
    """
    sensor = rig.sensor
    assert isinstance(sensor, SpotSensor)
    K, width = rig.timing.exposure_steps, sensor.pixel_width
    weight_sd = float(np.sqrt(sensor.kernel.variance)) / width
    found = np.array(
        [
            (weighted_centroid(spot_windows(sensor, to_density(sensor, each.pixels)), weight_sd).ravel() + 0.5) * width
            + sensor.field[0]
            for each in exposures
        ]
    )
    # Windows move from exposure to exposure; between pictures the path is a line where they do not.
    moved = np.cumsum([each.inputs.sum(axis=0) for each in exposures], axis=0)
    moved = np.vstack([np.zeros(moved.shape[1]), moved[:-1]])
    middles = np.arange(len(exposures)) * K + (K - 1) / 2
    steps = np.arange(len(exposures) * K)
    still = np.array([np.interp(steps, middles, one) for one in (found - moved).T])
    interpolated = still.reshape(len(still), -1, K).swapaxes(0, 1) + moved[:, :, None]
    return np.repeat(found[:, :, None], K, axis=2), interpolated


@dataclass(frozen=True)
class Film:
    """Results for exposures of this many frames of the film."""

    frames: int
    path: dict[str, IntervalEstimate]
    """RMSE of the path, pixels, over the twelve axes."""
    over_held: dict[str, IntervalEstimate]
    """RMSE of the path over that of the centroid, held."""
    smoothed: dict[str, IntervalEstimate]
    over_interpolated: dict[str, IntervalEstimate]
    """RMSE of the smoothed path over that of the interpolated centroid, which uses the future as well."""
    coverage: dict[str, float]
    """Share of the path inside the estimate's 95 % intervals, with the error of the truth included."""
    crowded: int
    """Exposures of one sphere that do not count, of ``scored``: other light is beside it."""
    scored: int
    all_over_held: dict[str, IntervalEstimate]
    """As ``over_held``, with these exposures."""
    all_over_interpolated: dict[str, IntervalEstimate]


def film(effort: Effort) -> list[Film]:
    """The estimators on the film, in exposures of each length."""
    return [_film_of(frames, effort) for frames in effort.film_frames]


def _film_of(frames: int, effort: Effort) -> Film:
    rig, exposures, alone = spheres(frames)
    exposures = exposures[: effort.film_exposures]
    scored = [k for k, each in enumerate(exposures) if k >= _SKIP and each.truth is not None]
    truths = [each.truth for k, each in enumerate(exposures) if k >= _SKIP and each.truth is not None]
    true, truth_sd = np.array([each.path for each in truths]), max(each.path_sd for each in truths)
    counts = alone[scored].T

    def squares(paths: FloatArray) -> FloatArray:
        """Mean squared errors, pixels squared, (axes, exposures)."""
        return np.asarray(((paths - true) ** 2).mean(axis=2).T / rig.sensor.pixel_width**2)

    held, interpolated = (squares(each[scored]) for each in centroids(rig, exposures))
    path, smoothed, coverage = {"centroid, held": held}, {"centroid, interpolated": interpolated}, {}
    for name in NAMES:
        estimator = estimator_named(rig, name, particles=effort.particles)
        estimates = [estimator.step(exposure) for exposure in exposures]
        some = [estimates[k] for k in scored]
        after = smooth(rig.plant, exposures, estimates)
        path[name] = squares(np.array([each.path for each in some]))
        smoothed[name] = squares(np.array([after[k].path for k in scored]))
        error = np.abs(np.array([each.path for each in some]) - true)
        spread = np.hypot(np.array([each.path_sd for each in some]), truth_sd)
        coverage[name] = float((error <= BEYOND_95 * spread).mean(axis=2).T[counts].mean())

    def of(errors: FloatArray, which: BoolArray) -> FloatArray:
        """Those that count, of the axes that have any."""
        return np.where(which, errors, np.nan)[which.any(axis=1)]

    def over(errors: dict[str, FloatArray], reference: FloatArray, which: BoolArray) -> dict[str, IntervalEstimate]:
        return {name: ratio(of(each, which), of(reference, which)) for name, each in errors.items()}

    everywhere = np.ones_like(counts)
    return Film(
        frames, {name: rms(of(each, counts)) for name, each in path.items()}, over(path, held, counts),
        {name: rms(of(each, counts)) for name, each in smoothed.items()}, over(smoothed, interpolated, counts),
        coverage, int((~counts).sum()) // 2, counts.size // 2, over(path, held, everywhere),
        over(smoothed, interpolated, everywhere),
    )  # fmt: skip


def film_section(found: Sequence[Film]) -> list[Block]:
    """A row for each estimator, exposures of more and more frames across."""
    filtered, smoothed = list(found[0].path), list(found[0].smoothed)
    over_all = [*(each.all_over_held for each in found), *(each.all_over_interpolated for each in found)]
    across = [f"{each.frames} frames" for each in found]

    def table(kind: str, names: Sequence[str], of: Callable[[Film, str], str]) -> Table:
        return Table([kind, *across], [[name, *(of(each, name) for each in found)] for name in names])

    return [
        Heading("Blur that nobody here made"),
        Text(
            "Not the paper's: a film of six spheres that diffuse in water, along x and y"
            " (tests/data/diffusing_spheres.md), imported as `aolink rig --from` and `aolink import --track 6 --sum K`"
            " do it. The mean of K frames is an exposure, the places in the single frames its path; kernel, noise and"
            " random walk are those of single frames. Exposures of a sphere that has other light beside it, as"
            " `aolink import` says of the single frames, do not count: "
            + ", ".join(f"{each.crowded} of {each.scored} at {each.frames} frames" for each in found)
            + ". RMSE of the path, pixels, with the standard error over the twelve axes:"
        ),
        table("estimator", filtered, lambda each, name: str(each.path[name])),
        Text("Over that of the held centroid, with the 95 % interval of a bootstrap over the axes:"),
        table("estimator", filtered, lambda each, name: each.over_held[name].interval),
        Text("Smoothed, beside the centroid interpolated to the next picture; both use the future:"),
        table("smoother", smoothed, lambda each, name: str(each.smoothed[name])),
        Text("Over that of the interpolated centroid:"),
        table("smoother", smoothed, lambda each, name: each.over_interpolated[name].interval),
        Text("With the exposures that do not count, filtered over held and smoothed over interpolated:"),
        Table(
            ["estimator", *across, *(f"{each}, smoothed" for each in across)],
            [[name, *(of[name].interval for of in over_all)] for name in NAMES],
        ),
        Text("Share of the path inside the estimate's 95 % intervals, with the tracker's own error added:"),
        table("estimator", NAMES, lambda each, name: f"{each.coverage[name]:.3f}"),
    ]
