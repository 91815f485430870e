"""Real motion blur: a film of spheres that diffuse in water, imported as by `aolink import`.

The mean of K frames is an exposure of K fast steps whose path is measured in the single frames. The rig file is the one
that `aolink rig --from` writes: kernel, noise and random walk of the single frames. Beside the estimators stands what a
user would do instead: the centroid of each blurred picture, held for the exposure, or interpolated from one to the
next.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aolink.estimation import ESTIMATOR_NAMES, make_estimator, smooth
from aolink.exposure import Exposure
from aolink.importing.first_rig import first_rig
from aolink.importing.frames import Settings
from aolink.importing.readers import open_film
from aolink.importing.recording import import_film
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import to_density
from aolink.optics.centroid import weighted_centroid
from aolink.optics.frame import spot_windows
from aolink.optics.sensor import SpotSensor
from aolink.recording.reader import Recording
from aolink.rig import Rig, parse_rig
from paper_report.blocks import Block, Heading, Table, Text
from paper_report.ensemble import Measured, ratio, rms
from paper_report.numbers import Effort

FILE = Path(__file__).parents[2] / "tests" / "data" / "diffusing_spheres.npz"
_RATE_HZ = 24.0
_SKIP = 1
"""Exposures that are not scored, because the spheres' motion before is not known."""


def places() -> tuple[tuple[float, float], ...]:
    """Positions of the six spheres in the first frame, their films side by side, pixels."""
    data = np.load(FILE)
    width = data["frames"].shape[3]
    return tuple((float(x) + k * width, float(y)) for k, (x, y) in enumerate(data["tracked_xy"][:, 0]))


def spheres(K: int) -> tuple[Rig, list[Exposure]]:
    """A rig of 12 axes and its exposures of K frames, read back from a recording."""
    settings = Settings(rate_hz=_RATE_HZ, invert=True, track=6, places=places(), frames_per_exposure=K)
    film = open_film(FILE)
    rig = parse_rig(first_rig(film, settings, "spheres"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "spheres.mcap"
        import_film(film, rig, settings, path)
        return rig, list(Recording(path).exposures())


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
    path: dict[str, Measured]
    """RMSE of the path, pixels, over the twelve axes."""
    over_held: dict[str, Measured]
    """RMSE of the path over that of the centroid, held."""
    smoothed: dict[str, Measured]
    over_interpolated: dict[str, Measured]
    """RMSE of the smoothed path over that of the interpolated centroid, which uses the future as well."""
    coverage: dict[str, float]
    """Share of the path inside the estimate's 95 % intervals, with the error of the truth included."""


def film(effort: Effort) -> list[Film]:
    """The estimators on the film, in exposures of each length."""
    found = []
    for frames in effort.film_frames:
        rig, exposures = spheres(frames)
        exposures = exposures[: effort.film_exposures]
        scored = [k for k, each in enumerate(exposures) if k >= _SKIP and each.truth is not None]
        true = np.array([each.truth.path for each in exposures if each.truth is not None and each is not exposures[0]])
        unit = 1 / rig.sensor.pixel_width

        def squares(paths: FloatArray, true: FloatArray = true, unit: float = unit) -> FloatArray:
            """Mean squared errors, pixels squared, (axes, exposures)."""
            return np.asarray(((paths - true) ** 2).mean(axis=2).T * unit**2)

        held, interpolated = (squares(each[scored]) for each in centroids(rig, exposures))
        path, smoothed, coverage = {"centroid, held": held}, {"centroid, interpolated": interpolated}, {}
        for name in ESTIMATOR_NAMES:
            options = {"particles": effort.particles} if name == "sampled" else {}
            estimator = make_estimator(rig, name, **options)
            estimates = [estimator.step(exposure) for exposure in exposures]
            some = [estimates[k] for k in scored]
            after = smooth(rig.plant, exposures, estimates)
            path[name] = squares(np.array([each.path for each in some]))
            smoothed[name] = squares(np.array([after[k].path for k in scored]))
            truth_sd = max(each.truth.path_sd for each in exposures if each.truth is not None)
            error = np.abs(np.array([each.path for each in some]) - true)
            spread = np.hypot(np.array([each.path_sd for each in some]), truth_sd)
            coverage[name] = float((error <= 1.96 * spread).mean())
        found.append(
            Film(
                frames,
                {name: rms(each) for name, each in path.items()},
                {name: ratio(each, held) for name, each in path.items()},
                {name: rms(each) for name, each in smoothed.items()},
                {name: ratio(each, interpolated) for name, each in smoothed.items()},
                coverage,
            )
        )
    return found


def film_section(found: Sequence[Film]) -> list[Block]:
    """A row for each estimator, exposures of more and more frames across."""
    filtered, smoothed = list(found[0].path), list(found[0].smoothed)
    across = [f"{each.frames} frames" for each in found]
    return [
        Heading("Blur that nobody here made"),
        Text(
            "Not the paper's: a film of six spheres that diffuse in water, along x and y"
            " (tests/data/diffusing_spheres.md), imported as `aolink rig --from` and `aolink import --track 6 --sum K`"
            " do it. The mean of K frames is an exposure, the places in the single frames its path; kernel, noise and"
            " random walk are those of single frames. RMSE of the path, pixels, with the standard error over the twelve"
            " axes:"
        ),
        Table(["estimator", *across], [[name, *(str(each.path[name]) for each in found)] for name in filtered]),
        Text("Over that of the held centroid, with the 95 % interval of a bootstrap over the axes:"),
        Table(
            ["estimator", *across], [[name, *(each.over_held[name].interval for each in found)] for name in filtered]
        ),
        Text("Smoothed, beside the centroid interpolated to the next picture; both use the future:"),
        Table(["smoother", *across], [[name, *(str(each.smoothed[name]) for each in found)] for name in smoothed]),
        Text("Over that of the interpolated centroid:"),
        Table(
            ["smoother", *across],
            [[name, *(each.over_interpolated[name].interval for each in found)] for name in smoothed],
        ),
        Text("Share of the path inside the estimate's 95 % intervals, with the tracker's own error added:"),
        Table(
            ["estimator", *across],
            [[name, *(f"{each.coverage[name]:.3f}" for each in found)] for name in ESTIMATOR_NAMES],
        ),
    ]
