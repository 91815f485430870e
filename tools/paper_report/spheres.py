"""Real motion blur: spheres that diffuse in water, six spots of two directions each, as a rig and its exposures.

The mean of K frames is an exposure of K fast steps whose path the single frames tell. Each direction is a line of
pixels: the window's darkness summed across. Kernel and noise are those of single frames; the plant is a random walk.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from aolink.estimation import ESTIMATOR_NAMES, make_estimator
from aolink.exposure import Exposure
from aolink.optics.camera import to_counts
from aolink.optics.kernel import pixel_mass
from aolink.optics.sensor import Kernel, Sensor
from aolink.rig import Rig, load_rig
from paper_report.blocks import Block, Heading, Table, Text
from paper_report.ensemble import Measured, SensorRows, ratio, rms
from paper_report.numbers import Effort

FloatArray = NDArray[np.float64]

FILE = Path(__file__).parents[2] / "tests" / "data" / "diffusing_spheres.npz"
HALF = 24  # pixels; the field is one slope unit on each side
COUNTS = 2000.0


REACH = 9  # pixels about where the sphere was last: beyond them are other spheres
NEAR = 6  # the same across, where it is summed


def load() -> tuple[FloatArray, FloatArray]:
    """Darkness of all frames (6, frames, 48, 48) and tracked positions, pixels, (6, frames, 2)."""
    data = np.load(FILE)
    frames, xy = data["frames"].astype(float), data["tracked_xy"].astype(float)
    return np.median(frames, axis=(2, 3), keepdims=True) - frames, xy


def profile(dark: FloatArray, centre: FloatArray) -> FloatArray:
    """Darkness about a pixel summed across, along x and along y, (2, 48); what is beyond is no light."""
    away = np.abs(np.arange(48) - np.rint(centre)[:, None])
    (x, y), (near_x, near_y) = away <= REACH, away <= NEAR
    return np.stack([(dark * near_y[:, None] * x).sum(axis=0), (dark * near_x * y[:, None]).sum(axis=1)])


def kernel_and_noise(dark: FloatArray, xy: FloatArray) -> tuple[FloatArray, float, float]:
    """Light of each axis, width of the Gaussian that fits single frames best, and V: what it leaves, times a pixel."""
    edges = np.linspace(-1, 1, 49)
    singles = np.array([[profile(dark[s, k], xy[s, k]) for k in range(0, 300, 6)] for s in range(6)])  # (6, k, 2, 48)
    light = singles.sum(axis=3).mean(axis=1) / HALF
    density = singles / light[:, None, :, None]
    track = (xy[:, ::6] + 0.5 - HALF) / HALF

    def left(sigma: float) -> FloatArray:
        return np.asarray(density - pixel_mass(Kernel(shape="gaussian", sigma=float(sigma)), edges, track) * HALF)

    sigma = float(optimize.minimize_scalar(lambda s: (left(s) ** 2).mean(), bounds=(0.02, 0.5), method="bounded").x)
    seen = np.abs(density) > 0
    return light, sigma, float((left(sigma)[seen] ** 2).mean() / HALF)


def spheres(K: int) -> tuple[Rig, list[Exposure], FloatArray]:
    """A rig of 12 axes, its exposures of K frames, and the paths, (exposures, 12, K)."""
    dark, xy = load()
    light, sigma, V = kernel_and_noise(dark, xy)
    track = ((xy + 0.5 - HALF) / HALF).transpose(0, 2, 1).reshape(12, -1)
    rig = load_rig("section-vi-lively")
    axes, frames = track.shape
    walk = float(np.diff(track, axis=1).var())
    plant = dataclasses.replace(
        rig.plant, A=np.eye(1), B=np.eye(1), B_w=np.eye(1), C=np.eye(1), process_noise=np.eye(1) * walk,
        initial_mean=np.zeros(1), initial_covariance=np.eye(1) * 0.1, axes=axes,
    )  # fmt: skip
    line = dataclasses.replace(
        rig.sensor.profile,
        pixels=48,
        noise_density=V,
        counts_per_density=COUNTS,
        kernel=Kernel(shape="gaussian", sigma=sigma),
    )
    sensor = SensorRows(**{f.name: getattr(line, f.name) for f in dataclasses.fields(Sensor)}, rows=axes)
    timing = dataclasses.replace(rig.timing, exposure_steps=K, frame_period_steps=K)
    rig = dataclasses.replace(rig, plant=plant, sensor=sensor, timing=timing)
    exposures, paths = [], []
    for j in range(frames // K):
        steps = slice(j * K, j * K + K)
        last = xy[:, max(0, j * K - 1)]
        blurred = np.stack([profile(dark[s, steps].mean(axis=0), last[s]) for s in range(6)])
        density = (blurred / light[..., None]).reshape(12, 48)
        exposures.append(
            Exposure(
                frame_id=j + 1,
                first_step=j * K,
                n_steps=K,
                pixels=to_counts(sensor, density),
                mask=np.ones(sensor.shape, bool),
                inputs=np.zeros((K, axes)),
                lead_inputs=np.zeros((0, axes)),
            )
        )
        paths.append(track[:, steps])
    return rig, exposures, np.array(paths)


@dataclasses.dataclass(frozen=True)
class Film:
    """What came of exposures of so many frames of the film."""

    frames: int
    path: dict[str, Measured]
    """RMSE of the path, pixels, over the twelve axes."""
    over_o1: dict[str, Measured]


def film(effort: Effort) -> list[Film]:
    """The estimators on the film, in exposures of each length."""
    found = []
    for frames in effort.film_frames:
        rig, exposures, paths = spheres(frames)
        squares = {}
        for name in ESTIMATOR_NAMES:
            options = {"particles": effort.particles} if name == "sampled" else {}
            estimator = make_estimator(rig, name, **options)
            estimates = [estimator.step(exposure) for exposure in exposures[: effort.film_exposures]]
            error = np.array([e.path - path for e, path in zip(estimates, paths, strict=False)])[1:]
            squares[name] = HALF**2 * (error**2).mean(axis=2).T  # (axes, exposures)
        over = {name: ratio(each, squares["o1"]) for name, each in squares.items()}
        found.append(Film(frames, {name: rms(each) for name, each in squares.items()}, over))
    return found


def film_section(found: Sequence[Film]) -> list[Block]:
    """A row for each estimator, exposures of more and more frames across."""
    names = list(found[0].path)
    across = [f"{each.frames} frames" for each in found]
    return [
        Heading("Blur that nobody here made"),
        Text(
            "Not the paper's: a film of six spheres that diffuse in water, along x and y"
            " (tests/data/diffusing_spheres.md). The mean of some frames is an exposure, what a tracker saw in the"
            " single frames its path; kernel and noise are those of single frames, the plant is a random walk. The"
            " model is not known to be right: what counts is the ratio to o1. RMSE of the path, pixels, with the"
            " standard error over the twelve axes:"
        ),
        Table(["estimator", *across], [[name, *(str(each.path[name]) for each in found)] for name in names]),
        Text("Over o1's, with the 95 % interval of a bootstrap over the axes:"),
        Table(["estimator", *across], [[name, *(each.over_o1[name].interval for each in found)] for name in names]),
    ]
