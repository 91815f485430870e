"""Scenes, drawn by seed: plants on which no estimator was tuned.

A scene is a rig and a simulation of it: several independent runs side by side, as axes of one rig. Seeds for building
and seeds for judging are apart (`SEEDS`): figures are those of the second, which are not used before.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy import linalg

from aolink.estimation import assumptions
from aolink.estimation.assumptions import LEAST_KERNEL_PIXELS, MOST_MODES, MOST_PATH_WIDTHS
from aolink.estimation.driver import SkippedInputs
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.optics.sensor import Kernel, Sensor, SpotSensor
from aolink.plant.lifting import input_response
from aolink.rig import Drive, Plant, Rig, Timing, load_rig
from aolink.simulation.model import simulate

SEEDS = {"building": range(100_000), "judging": range(160_000, 200_000)}
"""Ranges of seeds by name."""
Draw = Literal["random", "exact"]

MODES = (1, MOST_MODES)
SWINGS = (0.05, assumptions.MOST_SWINGS)
"""Swings of a resonance in an exposure."""
DAMPING = (0.002, 1.0)
MEMORY = (0.1, 20.0)
"""Exposures in which an Ornstein-Uhlenbeck process forgets all but 1/e."""
PATH_WIDTHS = (0.3, MOST_PATH_WIDTHS)
"""Sd of the path, in sds of the kernel."""
PEAK_SNR = (assumptions.LEAST_PEAK_SNR, assumptions.MOST_PEAK_SNR)
"""Signal to noise in the brightest pixel of a resting spot."""
STEPS = (20, 400)
KERNEL_PIXELS = (LEAST_KERNEL_PIXELS, 4.0)
"""The kernel's sigma in the paper's convention, sqrt(2) times its sd."""
_LARGEST_WINDOW = 64
"""Pixels along a side of a spot's window on a plane."""
_REACH = 4.5
"""Sds of the path to either side that the field has room for."""
_FAST_STEP_S = 0.001
_KERNEL_SD = 0.05
EXACT_SWINGS = (0.25, 0.5, 1.0, 2.0, 4.0)
MAINS_HZ = (50.0, 100.0)
AMPLITUDES = (0.5, 2.5)
"""Amplitude of the motion when a run begins, over that of the rig file."""

Geometry = Literal["line", "plane", "plane, one plant"]
Command = Literal["none", "sine", "steps"]
Kind = Literal["resonance", "Ornstein-Uhlenbeck", "random walk", "constant"]


@dataclass(frozen=True, kw_only=True)
class PlantProcess:
    """One process in a plant, independent of the others."""

    kind: Kind
    swings: float
    """Swings of a resonance in an exposure; for an Ornstein-Uhlenbeck process, 1/(2 pi memory in exposures); otherwise
    0."""
    damping: float = 0.0
    sd: float
    """Standard deviation of its part of the path, slope units; for a random walk, the standard deviation gained in the
    whole run."""
    direction: float
    """Direction in which it moves a spot on a plane, if one plant moves it along both axes, rad."""
    quadrature: bool = False
    """Whether a resonance moves such a spot on a circle instead."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """The drawn parameters of one scene."""

    seed: int
    geometry: Geometry
    modes: tuple[PlantProcess, ...]
    path_widths: float
    peak_snr: float
    steps: int
    """Fast steps in an exposure."""
    period: int
    """Fast steps from one exposure's start to the next one's."""
    kernel_pixels: float
    """sigma, pixels."""
    command: Command
    command_sd: float
    """Largest response to the commands, in sds of the path."""
    command_period: float
    """Exposures in a period of the sine, or between steps."""
    lost: float
    """Share of frames that are lost."""
    masked: float
    """Share of a line sensor's pixels that are dead; the same share is missing in a frame now and then. On a plane a
    pixel that is masked costs the whole spot, so none is dead, and three in ten frames are of no use."""
    fast_step_s: float = _FAST_STEP_S
    amplitude: float = 1.0
    """The motion's when a run begins, over that of the rig file."""
    exposures: int = 24
    """Exposures of a run; a random walk gains its sd over these."""

    @property
    def swings(self) -> float:
        """Swings in an exposure of the fastest process."""
        return max(mode.swings for mode in self.modes)

    @property
    def path_sd(self) -> float:
        """Standard deviation of the path, slope units."""
        return self.path_widths * _KERNEL_SD

    def __str__(self) -> str:
        modes = ", ".join(_of_mode(mode) for mode in self.modes)
        parts = [
            self.geometry, modes, f"path {self.path_widths:.2g} widths", f"peak SNR {self.peak_snr:.3g}",
            f"{self.steps} steps", f"kernel {self.kernel_pixels:.2g} pixels",
        ]  # fmt: skip
        parts += [f"{self.period - self.steps} steps of dead time"] if self.period > self.steps else []
        parts += [f"command: {self.command}"] if self.command != "none" else []
        parts += [f"{self.lost:.0%} of frames lost"] if self.lost else []
        parts += [f"{self.masked:.0%} of pixels masked"] if self.masked else []
        parts += [f"{self.amplitude:.2g} times the file's amplitude"] if self.amplitude != 1 else []
        return "; ".join(parts)


def _of_mode(mode: PlantProcess) -> str:
    if mode.kind == "resonance":
        return f"{mode.swings:.3g} swings (damping {mode.damping:.2g}){', on a circle' * mode.quadrature}"
    return f"{mode.kind} ({mode.swings:.2g})" if mode.swings else mode.kind


def draw(seed: int, kind: Draw = "random") -> Scene:
    """The scene of a seed: with anything in the ranges, or with exact ratios of frequency and frame rate."""
    if kind == "exact":
        return _exact(seed)
    rng = np.random.default_rng([18, seed])
    geometry: Geometry = get_args(Geometry)[rng.choice(3, p=[0.6, 0.2, 0.2])]
    steps = round(_between(rng, STEPS))
    period = steps + (round(steps * rng.uniform(0.05, 0.5)) if rng.random() < 0.3 else 0)
    kernel, widths = _between(rng, KERNEL_PIXELS), _between(rng, PATH_WIDTHS)
    command: Command = get_args(Command)[rng.choice(3, p=[0.6, 0.2, 0.2])]
    command_sd = 0.0 if command == "none" else float(rng.uniform(0.3, 1.5))
    while geometry != "line" and _half_pixels(kernel, widths, command_sd) > _LARGEST_WINDOW / 2:
        kernel, widths = _between(rng, KERNEL_PIXELS), _between(rng, PATH_WIDTHS)
    count = int(rng.integers(MODES[0], MODES[1] + 1))
    shares = rng.dirichlet(np.full(count, 2.0))
    modes = tuple(_mode(rng, steps, period, float(s), widths * _KERNEL_SD) for s in shares)
    return Scene(
        seed=seed, geometry=geometry, modes=modes, path_widths=widths, peak_snr=_between(rng, PEAK_SNR), steps=steps,
        period=period, kernel_pixels=kernel, command=command, command_sd=command_sd,
        command_period=_between(rng, (1.0, 20.0)), lost=0.1 if rng.random() < 0.25 else 0.0,
        masked=float(rng.uniform(0.01, 0.05)) if rng.random() < 0.25 else 0.0,
    )  # fmt: skip


def _exact(seed: int) -> Scene:
    """A scene of lines at mains frequency: the first makes an exact number of swings in an exposure, the swings and the
    frequency taking turns from seed to seed; and one or two more lines, or a state that stays."""
    rng = np.random.default_rng([21, seed])
    geometry: Geometry = ("line", "plane, one plant")[seed % 2]
    swings, hz = EXACT_SWINGS[seed // 2 % 5], MAINS_HZ[seed // 10 % 2]
    steps, widths = int(rng.choice([40, 80, 160])), float(rng.uniform(0.5, 4.0))
    sds = widths * _KERNEL_SD * np.sqrt(rng.dirichlet(np.full(int(rng.integers(1, MOST_MODES + 1)), 2.0)))
    turns = [swings, *rng.permutation([each for each in EXACT_SWINGS if each != swings])]
    modes = [
        PlantProcess(
            kind="resonance", swings=float(each), damping=_between(rng, (0.002, 0.05)), sd=float(sd),
            direction=math.pi / 4, quadrature=geometry != "line" and bool(rng.integers(2)),
        )
        for each, sd in zip(turns, sds, strict=False)
    ]  # fmt: skip
    if rng.random() < 0.5:
        stays = float(rng.choice([1e-4, 0.3 * _KERNEL_SD]))
        modes[2:] = [PlantProcess(kind="constant", swings=0.0, sd=stays, direction=math.pi / 4)]
    return Scene(
        seed=seed, geometry=geometry, modes=tuple(modes), path_widths=widths, peak_snr=_between(rng, (5.0, 300.0)),
        steps=steps, period=steps, kernel_pixels=_between(rng, (1.0, 2.5)), command="none", command_sd=0.0,
        command_period=1.0, lost=0.0, masked=0.0, fast_step_s=swings / hz / steps,
        amplitude=_between(rng, AMPLITUDES), exposures=(100, 16)[int(rng.integers(2))],
    )  # fmt: skip


def _between(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(ends))))


def _mode(rng: np.random.Generator, steps: int, period: int, share: float, path_sd: float) -> PlantProcess:
    sd, direction = path_sd * math.sqrt(share), float(rng.uniform(0, math.pi))
    kind: Kind = get_args(Kind)[rng.choice(4, p=[0.75, 0.15, 0.1, 0.0])]
    if kind == "random walk":
        return PlantProcess(kind=kind, swings=0.0, sd=sd, direction=direction)
    if kind == "Ornstein-Uhlenbeck":
        swings = 1 / (2 * math.pi * _between(rng, MEMORY))
        return PlantProcess(kind=kind, swings=swings, damping=1.0, sd=sd, direction=direction)
    fastest = min(SWINGS[1], steps / assumptions.STEPS_IN_SWING)
    swings = _between(rng, (SWINGS[0], fastest))
    if rng.random() < 0.25:  # an alias of the frame rate: its phase at each frame's start is the same, or the opposite
        half_turns = max(1, round(2 * swings * period / steps))
        swings = min(half_turns / 2 * steps / period, fastest)
    return PlantProcess(kind=kind, swings=swings, damping=_between(rng, DAMPING), sd=sd, direction=direction)


def _half_pixels(kernel_pixels: float, path_widths: float, command_sd: float) -> int:
    """Pixels on either side of the middle."""
    return math.ceil(kernel_pixels / math.sqrt(2) * (path_widths * (_REACH + command_sd) + 4)) + 1


def plant_of(scene: Scene, axes: int) -> Plant:
    """The plant of a scene, as its rig file has it."""
    outputs = 2 if scene.geometry == "plane, one plant" else 1
    blocks, noises, stationary, rows = [], [], [], []
    for mode in scene.modes:
        A, B_w, P = _dynamics(mode, scene.steps, scene.exposures * scene.period)
        blocks.append(A)
        noises.append(B_w)
        stationary.append(P)
        row = np.zeros((outputs, len(A)))
        row[:, 0] = (math.cos(mode.direction), math.sin(mode.direction)) if outputs == 2 else 1.0
        if outputs == 2 and mode.quadrature:
            row[:] = np.eye(2)
        rows.append(row)
    A, B_w = linalg.block_diag(*blocks), linalg.block_diag(*noises)
    n = len(A)
    return Plant(
        A=A, B=B_w.sum(axis=1, keepdims=True), B_w=B_w, C=np.concatenate(rows, axis=1),
        process_noise=np.eye(B_w.shape[1]), initial_mean=np.zeros(n), initial_covariance=linalg.block_diag(*stationary),
        axes=axes,
    )  # fmt: skip


def _dynamics(mode: PlantProcess, steps: int, run_steps: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A, B_w for noise of variance one, and the covariance at the start."""
    if mode.kind == "constant":
        return np.eye(1), np.zeros((1, 1)), np.array([[mode.sd**2]])
    if mode.kind == "random walk":
        sd = mode.sd / math.sqrt(run_steps)
        return np.eye(1), np.array([[sd]]), np.array([[mode.sd**2 / 10]])
    w = 2 * math.pi * mode.swings / steps
    if mode.kind == "Ornstein-Uhlenbeck":
        keeps = math.exp(-w)
        return np.array([[keeps]]), np.array([[mode.sd * math.sqrt(1 - keeps**2)]]), np.array([[mode.sd**2]])
    A = linalg.expm(np.array([[0.0, w], [-w, -2 * mode.damping * w]]))
    push = np.array([[0.0], [1.0]])
    of_one = linalg.solve_discrete_lyapunov(A, push @ push.T)
    gain = mode.sd / math.sqrt(of_one[0, 0])
    return np.asarray(A), gain * push, np.asarray(gain**2 * of_one)


@dataclass(frozen=True, kw_only=True)
class SensorRows(Sensor):
    """A line sensor for each of several independent axes, read out as the rows of one frame."""

    rows: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        return (self.rows, self.pixels)


def side_by_side(rig: Rig, runs: int) -> Rig:
    """A rig whose axes are ``runs`` independent copies of one that has a single axis."""
    values = {f.name: getattr(rig.sensor, f.name) for f in dataclasses.fields(Sensor)}
    plant = dataclasses.replace(rig.plant, axes=runs)
    return dataclasses.replace(rig, plant=plant, sensor=SensorRows(**values, rows=runs))


def rig_of(scene: Scene, runs: int, grid: tuple[int, int] | None = None) -> Rig:
    """The rig whose axes are the runs of a scene; frames of a line sensor have a row for each run, those on a plane a
    row of windows, or a grid."""
    kernel = Kernel(shape="gaussian", sigma=_KERNEL_SD * math.sqrt(2))
    half = _half_pixels(scene.kernel_pixels, scene.path_widths * max(1.0, scene.amplitude), scene.command_sd)
    pixel = kernel.sigma / scene.kernel_pixels
    common = {
        "field": (-half * pixel, half * pixel), "kernel": kernel, "bit_depth": 16, "black_level": 20_000.0,
        "noise_density": 0.0, "counts_per_density": 1.0,
    }  # fmt: skip
    line = SensorRows(kind="line", pixels=2 * half, rows=runs, **common)  # type: ignore[arg-type]
    spots = SpotSensor(kind="spots", grid=grid or (1, runs), window=(2 * half, 2 * half), **common)  # type: ignore[arg-type]
    sensor: Sensor | SpotSensor = line if scene.geometry == "line" else spots
    peak = sensor.peak_density
    sd = peak / scene.peak_snr
    # Six sds of noise above zero and below full scale: what a camera is set to.
    counts = min(sensor.black_level / (6 * sd), (sensor.full_scale - sensor.black_level) / (peak + 6 * sd))
    sensor = dataclasses.replace(sensor, noise_density=sd**2 * sensor.pixel_size, counts_per_density=counts)
    axes = 2 * runs if scene.geometry == "plane" else runs
    base, zeros = load_rig("section-vi"), np.zeros(axes)
    return dataclasses.replace(
        base,
        name=f"scene-{scene.seed}",
        plant=plant_of(scene, axes),
        timing=Timing(fast_step_s=scene.fast_step_s, exposure_steps=scene.steps, frame_period_steps=scene.period),
        sensor=sensor,
        mirror=dataclasses.replace(
            base.mirror, dac_bits=0, input_min=zeros - np.inf, input_max=zeros + np.inf, park=zeros
        ),
        drive=Drive(kind="none", amplitude=zeros, period_s=1.0, offset=zeros),
    )


def commands_of(scene: Scene, plant: Plant, n_steps: int) -> FloatArray:
    """Inputs at each fast step, the same for all axes, (n_steps, axes)."""
    rng = np.random.default_rng([19, scene.seed])
    turn = scene.command_period * scene.period
    k = np.arange(n_steps)
    if scene.command == "none":
        return np.zeros((n_steps, plant.axes))
    if scene.command == "sine":
        one = np.sin(2 * math.pi * k / turn)
    else:
        one = rng.uniform(-1, 1, int(n_steps / turn) + 1)[(k / turn).astype(int)]
    response, _ = input_response(dataclasses.replace(plant, axes=1), one[None, :, None])
    scale = scene.command_sd * scene.path_sd / max(float(np.abs(response).max()), 1e-300)
    return np.repeat((scale * one)[:, None], plant.axes, axis=1)


def exposures_of(scene: Scene, runs: int) -> tuple[Rig, list[Exposure]]:
    """Rig and exposures of a scene; frames that are lost are not among them."""
    rig = rig_of(scene, runs)
    inputs = commands_of(scene, rig.plant, scene.exposures * scene.period)
    start = scene.amplitude**2 * rig.plant.initial_covariance
    true = dataclasses.replace(rig, plant=dataclasses.replace(rig.plant, initial_covariance=start))
    return rig, list(with_flaws(scene, rig, simulate(true, scene.exposures, scene.seed, inputs=inputs)))


def with_flaws(scene: Scene, rig: Rig, made: Sequence[Exposure]) -> Iterator[Exposure]:
    """Exposures without lost frames and masked pixels: the same ones in all runs, as each alone would have them."""
    rng, skipped = np.random.default_rng([20, scene.seed]), SkippedInputs()
    pixels = rig.sensor.profile.pixels
    side = (1, pixels) if scene.geometry == "line" else (pixels, pixels)
    repeats = tuple(whole // part for whole, part in zip(rig.sensor.shape, side, strict=True))
    dead = (rng.random(side) < scene.masked) & (scene.geometry == "line")
    for exposure in made:
        lost, missing = rng.random() < scene.lost, rng.random() < 0.3
        passing = rng.random(side) < scene.masked
        if lost:
            skipped.skip(exposure)
            continue
        mask = np.tile(~(dead | (passing & missing)), repeats)
        yield dataclasses.replace(skipped.leading(exposure), mask=mask)
