"""A family of scenes, drawn by seed: plants on which no estimator was tuned.

A scene is a rig and a simulation of it: several independent runs side by side, as axes of one rig. Seeds for tuning and
seeds for reporting are separate (`SEEDS`): figures are those of the second, which are not used before.
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
from paper_report.ensemble import SensorRows

SEEDS = {"tuning": range(100_000), "reporting": range(160_000, 200_000)}
"""Ranges of seeds by name; each judgement takes the first ones of its range."""

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

Geometry = Literal["line", "plane", "plane, one plant"]
Command = Literal["none", "sine", "steps"]
Kind = Literal["resonance", "Ornstein-Uhlenbeck", "random walk"]


@dataclass(frozen=True, kw_only=True)
class PlantProcess:
    """One process in a plant, independent of the others."""

    kind: Kind
    swings: float
    """Swings of a resonance in an exposure; for an Ornstein-Uhlenbeck process, 1/(2 pi memory in exposures); for a
    random walk 0."""
    damping: float
    sd: float
    """Standard deviation of its part of the path, slope units; for a random walk, the standard deviation gained in the
    whole run."""
    direction: float
    """Direction in which it moves a spot on a plane, if one plant moves it along both axes, rad."""


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
        return "; ".join(parts)


def _of_mode(mode: PlantProcess) -> str:
    if mode.kind == "resonance":
        return f"{mode.swings:.3g} swings (damping {mode.damping:.2g})"
    return mode.kind if mode.kind == "random walk" else f"{mode.kind} ({mode.swings:.2g})"


def draw(seed: int) -> Scene:
    """The scene of a seed."""
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


def _between(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(ends))))


def _mode(rng: np.random.Generator, steps: int, period: int, share: float, path_sd: float) -> PlantProcess:
    sd, direction = path_sd * math.sqrt(share), float(rng.uniform(0, math.pi))
    kind: Kind = get_args(Kind)[rng.choice(3, p=[0.75, 0.15, 0.1])]
    if kind == "random walk":
        return PlantProcess(kind=kind, swings=0.0, damping=0.0, sd=sd, direction=direction)
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


def plant_of(scene: Scene, axes: int, exposures: int) -> Plant:
    """The plant of a scene; ``exposures`` is the length of a run, over which a random walk gains its sd."""
    outputs = 2 if scene.geometry == "plane, one plant" else 1
    blocks, noises, stationary, rows = [], [], [], []
    for mode in scene.modes:
        A, B_w, P = _dynamics(mode, scene.steps, exposures * scene.period)
        blocks.append(A)
        noises.append(B_w)
        stationary.append(P)
        row = np.zeros((outputs, len(A)))
        row[:, 0] = (math.cos(mode.direction), math.sin(mode.direction)) if outputs == 2 else 1.0
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


def rig_of(scene: Scene, runs: int, exposures: int) -> Rig:
    """The rig whose axes are the runs of a scene; frames of a line sensor have a row for each run."""
    kernel = Kernel(shape="gaussian", sigma=_KERNEL_SD * math.sqrt(2))
    half = _half_pixels(scene.kernel_pixels, scene.path_widths, scene.command_sd)
    pixel = kernel.sigma / scene.kernel_pixels
    common = {
        "field": (-half * pixel, half * pixel), "kernel": kernel, "bit_depth": 16, "black_level": 20_000.0,
        "noise_density": 0.0, "counts_per_density": 1.0,
    }  # fmt: skip
    line = SensorRows(kind="line", pixels=2 * half, rows=runs, **common)  # type: ignore[arg-type]
    spots = SpotSensor(kind="spots", grid=(1, runs), window=(2 * half, 2 * half), **common)  # type: ignore[arg-type]
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
        name=f"family-{scene.seed}",
        plant=plant_of(scene, axes, exposures),
        timing=Timing(fast_step_s=_FAST_STEP_S, exposure_steps=scene.steps, frame_period_steps=scene.period),
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


def exposures_of(scene: Scene, runs: int, exposures: int) -> tuple[Rig, list[Exposure]]:
    """Rig and exposures of a scene; frames that are lost are not among them."""
    rig = rig_of(scene, runs, exposures)
    inputs = commands_of(scene, rig.plant, exposures * scene.period)
    made = simulate(rig, exposures, scene.seed, inputs=inputs)
    return rig, list(with_flaws(scene, rig, made))


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
