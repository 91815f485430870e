"""Real motion blur: a film of spheres that diffuse in water, tests/data/diffusing_spheres.md.

The mean of K frames is an exposure of K fast steps, whose path is where an established tracker saw the spheres in the
single frames. Kernel, noise and random walk of the rig are those of single frames. A window goes with its sphere by
whole pixels from exposure to exposure, which the model has as an input. Beside the estimators stands what a user would
do instead: the centroid of each blurred picture, held for the exposure.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from aolink.estimation import make_estimator, smooth
from aolink.exposure import Exposure
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.camera import to_counts, to_density
from aolink.optics.centroid import weighted_centroid
from aolink.optics.frame import spot_windows
from aolink.optics.sensor import SpotSensor
from aolink.rig import Rig, parse_rig
from aolink.simulation.model import simulate
from judging.rows import BEYOND_95, Given, Judge, Line, Row, grouped, ratio

FILE = Path(__file__).parents[2] / "tests" / "data" / "diffusing_spheres.npz"
LENGTHS = (8, 12, 24)
"""Frames in an exposure; a seed of `tools/judge spheres` is one of them."""
_SIDE = 18
"""Pixels along a side of a window."""
_PIXEL = 2 / _SIDE
_KERNEL_SD, _WALK, _NOISE = 1.7, 0.22, 4.5
"""Pixels; pixels squared that a sphere's place gains in a frame along one direction; grey levels that a
Gaussian leaves of single frames, and of their means."""
_TRUTH_SD = 0.1
_REACH, _BESIDE = 7.0, 0.3
"""Pixels from a sphere beyond which light is not its own, and is taken out; the share of its light that such light may
have."""
_RIG = """
name = "spheres"
[plant]
axes = 12
A = [[1.0]]
B = [[1.0]]
B_w = [[1.0]]
C = [[1.0]]
process_noise = [[{walk}]]
initial_covariance = [[0.1]]
[timing]
fast_step_s = 0.041666667
exposure_steps = {frames}
[sensor]
kind = "spots"
grid = [1, 6]
window = [{side}, {side}]
field = [-1.0, 1.0]
noise_density = {noise}
bit_depth = 16
black_level = 8000
counts_per_density = 500
kernel = {{shape = "gaussian", sigma = {sigma}}}
[mirror]
input_min = -2.0
input_max = 2.0
"""


def spheres(frames: int) -> tuple[Rig, list[Exposure], BoolArray]:
    """A rig of 12 axes, its exposures of so many frames, and where a sphere is alone, (exposures, 12)."""
    data = np.load(FILE)
    grey, xy = data["frames"].astype(np.float64), data["tracked_xy"].astype(np.float64)
    light = np.median(grey, axis=(2, 3), keepdims=True) - grey  # the spheres are dark
    y, x = np.indices(grey.shape[2:])
    away = np.hypot(x - xy[..., 0, None, None], y - xy[..., 1, None, None])
    ring = np.where((away > _REACH - 2) & (away < _REACH), light, np.nan)
    light -= np.nanmedian(ring, axis=(2, 3), keepdims=True)
    far = away > _REACH
    total = (light * ~far).sum(axis=(2, 3)).mean(axis=1)
    light /= total[:, None, None, None]
    noise = _NOISE / total.mean()
    rig = parse_rig(_RIG.format(
        frames=frames, walk=_WALK * _PIXEL**2, side=_SIDE, noise=noise**2 / _PIXEL**2,
        sigma=_KERNEL_SD * math.sqrt(2) * _PIXEL,
    ))  # fmt: skip
    count = xy.shape[1] // frames
    corners = np.clip(np.rint(xy[:, ::frames]).astype(int) - _SIDE // 2, 0, 48 - _SIDE)[:, :count]
    exposures, alone = [], []
    for k, made in enumerate(simulate(rig, count)):
        during, rows, windows = slice(k * frames, (k + 1) * frames), [], []
        for sphere, (left, top) in enumerate(corners[:, k]):
            part = (sphere, during, slice(top, top + _SIDE), slice(left, left + _SIDE))
            other = (light[part] * far[part]).mean(axis=0)
            own = light[part].mean(axis=0) - other
            windows.append(own / own.sum())  # spheres go out of focus and come back
            rows.append(other[other > noise].sum() < _BESIDE)
        inputs = np.zeros((frames, 12))
        inputs[-1] = (corners[:, k] - corners[:, min(k + 1, count - 1)]).ravel() * _PIXEL
        path = ((xy[:, during] - corners[:, k, None] + 0.5) * _PIXEL - 1).swapaxes(1, 2).reshape(12, frames)
        assert made.truth is not None
        truth = replace(made.truth, path=path)
        pixels = to_counts(rig.sensor, np.concatenate(windows, axis=1) / _PIXEL**2)
        exposures.append(replace(made, pixels=pixels, inputs=inputs, truth=truth))
        alone.append(np.repeat(rows, 2))
    return rig, exposures, np.array(alone)


def centroids(rig: Rig, exposures: Sequence[Exposure]) -> FloatArray:
    """Paths by the centroid of each picture, held, (exposures, outputs, steps); its Gaussian weight is as wide as the
    spot, which came nearer than wider ones and than none."""
    sensor = rig.sensor
    assert isinstance(sensor, SpotSensor)
    found = [
        weighted_centroid(spot_windows(sensor, to_density(sensor, each.pixels)), _KERNEL_SD).ravel()
        for each in exposures
    ]
    return np.repeat(((np.array(found) + 0.5) * _PIXEL - 1)[:, :, None], rig.timing.exposure_steps, axis=2)


def rows(seed: int, given: Given) -> Iterator[Row]:
    """Each estimator, filtered and smoothed, and the centroid: squared errors by axis, and coverage with the error of
    the truth included."""
    frames = LENGTHS[seed % len(LENGTHS)]
    rig, exposures, alone = spheres(frames)
    true = np.array([each.truth.path for each in exposures if each.truth is not None])[1:]
    counts = alone[1:]  # of the first exposure the motion before is not known

    def row(what: str, paths: FloatArray, inside: float) -> Row:
        errors = ((paths[1:] - true) ** 2).mean(axis=2) / _PIXEL**2
        by_axis = [float(errors[counts[:, k], k].mean()) for k in range(12) if counts[:, k].any()]
        return {"what": what, "frames": frames, "path": by_axis, "inside": inside}

    yield row("centroid, held", centroids(rig, exposures), math.nan)
    for name in given.estimators:
        estimator = make_estimator(rig, name)
        filtered = [estimator.step(exposure) for exposure in exposures]
        for what, each in ((name, filtered), (f"{name}, smoothed", smooth(rig.plant, exposures, filtered))):
            paths, sd = (np.array([getattr(e, key) for e in each]) for key in ("path", "path_sd"))
            hits = np.abs(paths[1:] - true) <= BEYOND_95 * np.hypot(sd[1:], _TRUTH_SD * _PIXEL)
            yield row(what, paths, float(hits.mean(axis=2)[counts].mean()))


def table(rows: Sequence[Row]) -> tuple[Line, Iterable[Line]]:
    """A line for each length of an exposure and way to a path."""
    lines = []
    for frames, of_length in grouped(rows, "frames").items():
        by_what = {what: each[0] for what, each in grouped(of_length).items()}
        held = by_what["centroid, held"]["path"]
        for what, each in by_what.items():
            over = ratio(list(zip(each["path"], held, strict=True)))
            rmse = math.sqrt(np.mean(each["path"]))
            lines.append((frames, what, f"{rmse:.3f}", over, f"{each['inside']:.3f}"))
    return ("frames", "path by", "error, pixels", "over the centroid", "coverage"), lines


SPHERES = Judge(
    summary="estimators on real blur: diffusing spheres, in exposures of 8, 12 and 24 frames (a seed each)",
    rows=rows, table=table, estimators=("o1", "moments", "profile"), scenes=len(LENGTHS),
)  # fmt: skip
