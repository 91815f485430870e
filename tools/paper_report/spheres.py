"""Real motion blur: a film of spheres that diffuse in water.

The mean of K frames is an exposure of K fast steps, whose path a tracker saw in the single frames. Beside the
estimators stands what a user would do instead: the centroid of each blurred picture, held for the exposure, or
interpolated from one to the next. Exposures of a sphere that has another one beside it count in one table only.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from judging.sampled import NAME as LIMIT
from judging.sampled import estimator as estimator_named

import aolink
from aolink.estimation import ESTIMATOR_NAMES, smooth
from aolink.exposure import Exposure, Truth
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.camera import to_density
from aolink.optics.centroid import weighted_centroid
from aolink.optics.frame import spot_windows
from aolink.optics.maxima import cut_windows
from aolink.optics.sensor import SpotSensor
from aolink.rig import Rig, parse_rig
from paper_report.blocks import Block, Heading, Table, Text
from paper_report.ensemble import IntervalEstimate, ratio, rms
from paper_report.judge import BEYOND_95
from paper_report.numbers import Effort

FILE = Path(__file__).parents[2] / "tests" / "data" / "diffusing_spheres.npz"
NAMES = (*ESTIMATOR_NAMES, LIMIT)
_SKIP = 1
"""Exposures that are not scored, because the spheres' motion before is not known."""
_STEP, _SD, _NOISE = 0.47, 1.7, 0.009
"""Rms of a sphere's step in a frame and its standard deviation, pixels; noise of a mean's pixel over its light."""
PATH_SD = 0.1
"""Error of the tracker, pixels."""
_BESIDE = {0: (180, 300), 1: (0, 30), 5: (240, 270)}
"""Frames in which a sphere has another one beside it that is a third as bright or more."""
HALF = 12
"""Pixels of a window on either side of its middle one."""
_BLACK, _COUNTS = 20_000, 340_000
WALK = """
A = [[1.0, 0.0], [0.0, 0.0]]
B = [[1.0], [0.0]]
B_w = [[1.0], [1.0]]
C = [[1.0, -0.21132487]]
process_noise = [[{0}]]
initial_covariance = [[4.0, 0.0], [0.0, {0}]]
"""
"""Plant of a random walk that gains so much variance in a frame, in pixels. The mean over a frame has not the whole
last step yet, which is the last state; the input is the shift of the window."""


def spot_rig(plant: str, spots: int, frames: int, sd: float, noise: float) -> Rig:
    """A rig of spots, each in a window that its inputs shift, for exposures of so many frames. The slope unit is a
    pixel; ``noise`` is the standard deviation of a pixel over a spot's light."""
    edge = HALF + 0.5
    return parse_rig(f"""
name = "spots"
[plant]
axes = {2 * spots}
{plant}
[timing]
fast_step_s = 0.04
exposure_steps = {frames}
frame_period_steps = {frames}
[sensor]
kind = "spots"
grid = [1, {spots}]
window = [{2 * HALF + 1}, {2 * HALF + 1}]
field = [{-edge}, {edge}]
noise_density = {noise**2}
black_level = {_BLACK}
counts_per_density = {_COUNTS}
[sensor.kernel]
shape = "gaussian"
sd = {sd}
[mirror]
input_min = -{2 * HALF}.0
input_max = {2 * HALF}.0
dac_bits = 0
block_steps = 1
queue_steps = 16
""")


def followed(rig: Rig, light: FloatArray, places: FloatArray, reach: float) -> list[Exposure]:
    """Exposures of spots of a film, (frames, rows, columns), with their true paths; ``places`` are those in the single
    frames, (frames, spots, 2) as (x, y), pixels.

    From exposure to exposure a window moves by whole pixels to the middle of the blur before; light farther than
    ``reach`` from that belongs to others.
    """
    K, spots = rig.timing.exposure_steps, places.shape[1]
    count, middles = len(light) // K, places[0]
    rows, columns = np.indices((2 * HALF + 1, 2 * HALF + 1))
    own, corners = [], []
    for k in range(count):
        windows, corner = cut_windows(light[k * K : (k + 1) * K].mean(axis=0), middles, HALF)
        windows -= np.median(windows, axis=(1, 2), keepdims=True)  # the ground
        found = weighted_centroid(windows, reach / 2, start=middles - corner)
        far = np.hypot(columns - found[:, :1, None], rows - found[:, 1:, None]) > reach
        own.append(np.where(far, 0.0, windows))
        corners.append(corner)
        middles = corner + found
    density = np.array(own) / np.median(np.sum(own, axis=(2, 3)), axis=0)[:, None, None]
    counts = np.rint(_BLACK + _COUNTS * density).clip(0, rig.sensor.full_scale)
    inputs = np.zeros((count * K, rig.n_inputs))
    inputs[K - 1 : -1 : K] = -np.diff(corners, axis=0).reshape(-1, 2 * spots)
    frames = counts.transpose(0, 2, 1, 3).reshape(count, *rig.sensor.shape)
    unknown = np.full((rig.plant.axes, rig.plant.n_states), np.nan)
    exposures = list[Exposure]()
    for k, each in enumerate(aolink.exposures(frames, rig, inputs)):
        path = (places[k * K : (k + 1) * K] - corners[k] - HALF).reshape(K, 2 * spots).T
        exposures.append(replace(each, truth=Truth(start_state=unknown, end_state=unknown, path=path)))
    return exposures


def spheres(K: int) -> tuple[Rig, list[Exposure], BoolArray]:
    """A rig of 12 axes, its exposures of K frames, and where a sphere is alone, (exposures, 12)."""
    data = np.load(FILE)
    films, tracks = data["frames"], data["tracked_xy"]
    beside = np.array([[k * films.shape[3], 0.0] for k in range(len(films))])
    picture = np.concatenate(list(films), axis=2)  # side by side
    light = np.median(picture, axis=(1, 2), keepdims=True) - picture
    rig = spot_rig(WALK.format(_STEP**2), len(films), K, _SD, _NOISE)
    exposures = followed(rig, light, tracks.swapaxes(0, 1) + beside, 2.5 * np.hypot(_SD, _STEP * np.sqrt(K)))
    alone = np.ones((len(exposures), len(films)), dtype=np.bool_)
    for sphere, (first, end) in _BESIDE.items():
        alone[first // K : -(-end // K), sphere] = False
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
    true = np.array([each.path for each in truths])
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
        spread = np.hypot(np.array([each.path_sd for each in some]), PATH_SD)
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
            " (tests/data/diffusing_spheres.md). The mean of K frames is an exposure, the places in the single frames"
            " its path; kernel, noise and random walk are those of single frames. Exposures of a sphere that has"
            " another one beside it do not count: "
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
