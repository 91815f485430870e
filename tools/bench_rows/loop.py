"""Residual slopes of a closed loop under turbulence and a vibration, beside integrators, pyRTC's predictors and the
limit."""

from __future__ import annotations

import copy
import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pyrtc.predictive import ModalPredictor, make_predictor
from scipy import linalg, optimize, signal

from aolink.control import ControllerRow, Seen
from aolink.control.loop import centroids
from aolink.control.lqg import LQG
from aolink.control.modes import reached, response_at_rest
from aolink.exposure import residual_rms
from aolink.identification import Process, ProcessSum, identified_text, maxima, readings, space_of
from aolink.jobs.closed_loop import closed_loop
from aolink.numerics.arrays import FloatArray
from aolink.numerics.covariance import psd_root
from aolink.optics.turbulence import FrozenFlow, Layer
from aolink.rig import Rig, load_rig, parse_rig
from bench_rows.row import Effort, Row

STEP_S = 1e-3
PUPIL_M = 0.5
WINDS_M_S = (5.0, 11.0)
"""Winds of the two layers, which blow in directions drawn by the seed."""
DAMPING = 0.002
GAINS = (0.1, 0.3, 0.5, 0.7, 0.9, 1.1, 1.3)
_SD = 1.5 * 0.1 / math.sqrt(2)
"""Standard deviation of the path, slope units: 1.5 times that of the kernel of the rig `loop`."""
_NOISE = 0.02
"""Sd of the centroid's noise (of a sum over all pixels) over that of the path."""
_SHORTEST_M = PUPIL_M / 8
_ORDER = 64
_RIDGE = 1e-9
_HIGHEST_HZ = 100.0
"""Highest frequency at which a model is fitted to the spectrum of turbulence, Hz."""
_GOAL = 0.95


@dataclass(frozen=True)
class Cell:
    """A disturbance, a camera, and the estimators that serve `lqg`."""

    turbulence: bool
    vibration: float
    """Frequency of the vibration over the frame rate. Where there is turbulence too, their sd is equal."""
    steps: int = 50
    """Fast steps in an exposure, and from frame to frame."""
    identified: tuple[str, ...] = ()
    """Estimators with the model that is identified from the past exposures alone, beside those with the known one."""

    def __str__(self) -> str:
        text = f"vibration at {self.vibration:g}" + (f", N = {self.steps}" if self.steps != 50 else "")
        return f"turbulence + {text}" if self.turbulence else text

    def disturbance(self, steps: int, past: int, seed: int) -> DisturbanceRun:
        """Slopes of that many fast steps, the first ``past`` of them known."""
        sd = _SD / math.sqrt(1 + self.turbulence)
        parts = [turbulence(sd, steps, past, seed)] if self.turbulence else []
        return together([*parts, vibration(self.vibration / (self.steps * STEP_S), sd, steps, seed)])

    def rig(self, model: ProcessSum) -> Rig:
        """The rig `loop` with this camera and ``model``."""
        text = load_rig("loop").toml.replace("exposure_steps = 50", f"exposure_steps = {self.steps}")
        # The variance of the centroid is 2/3 V.
        text = text.replace("noise_density = 1e-5", f"noise_density = {1.5 * (_NOISE * _SD) ** 2:.6g}")
        return parse_rig(identified_text(text, parse_rig(text), [model]))


ESTIMATORS = ("o1", "moments", "profile")
CELLS = (
    *(Cell(True, at, identified=("o1", "profile")) for at in (2.4, 2.7)), *(Cell(True, at) for at in (0.6, 1.5)),
    Cell(False, 2.4), *(Cell(True, 2.4, steps=steps) for steps in (20, 200)),
)  # fmt: skip


@dataclass(frozen=True)
class Size:
    """How much of each cell is run."""

    seeds: Sequence[int] = range(701, 706)
    past: int = 200
    """Exposures with the mirror at rest, to which predictors are fitted and from which models are identified."""
    exposures: int = 100
    """Exposures after those, with the loop closed."""
    settled: int = 20
    """Number of the first of these, which are left out."""
    gains: Sequence[float] = GAINS


FULL = Size()
SHORT = Size(seeds=range(1, 3), past=64, exposures=6, settled=3, gains=GAINS[:1])


@dataclass(frozen=True)
class Measured:
    """Residual slopes at the fast rate of each seed, root mean square, slope units, by what closed the loop."""

    cell: Cell
    rms: Mapping[str, FloatArray]

    @property
    def best(self) -> str:
        """The integrator with the best gain for these seeds, with hindsight."""
        return min((name for name in self.rms if name.startswith("integrator")), key=lambda name: self.rms[name].mean())

    def ratio(self, name: str, over: str = "") -> float:
        """The mean over the seeds of the ratio to the best integrator, or to another controller."""
        return float((self.rms[name] / self.rms[over or self.best]).mean())


def all_measured(cells: Sequence[Cell], size: Size = FULL) -> Iterator[Measured]:
    """Each cell measured, all controllers on the same disturbances. Standard error output has the time of each."""
    for cell in cells:
        start = time.monotonic()
        each = [_of_seed(cell, seed, size) for seed in size.seeds]
        yield Measured(cell, {name: np.array([found[name] for found in each]) for name in each[0]})
        print(f"  {cell}: {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)


def _of_seed(cell: Cell, seed: int, size: Size) -> dict[str, float]:
    past = size.past * cell.steps
    whole = cell.disturbance(past + (size.exposures + 1) * cell.steps, past, seed)
    ahead = replace(whole, slopes=whole.slopes[past:], states=whole.states[past:])
    rms: dict[str, float] = {}
    with TemporaryDirectory() as folder:

        def run(name: str, rig: Rig, controller: str | ControllerRow, estimator: str = "") -> None:
            series = [seen.exposure for seen in closed_loop(rig, controller, estimator, size.exposures, seed=seed)]
            rms[name] = residual_rms(series[size.settled :])

        def disturbed(model: ProcessSum) -> Rig:
            return played(cell.rig(model), ahead.slopes[:, None], Path(folder) / "ahead.toml")

        rig = disturbed(whole.model)
        run("open", rig, "")
        for gain in size.gains:
            run(f"integrator {gain:g}", replace(rig, control=replace(rig.control, gain=gain)), "integrator")
        before = played(cell.rig(whole.model), whole.slopes[:past, None], Path(folder) / "before.toml")
        earlier = [seen.exposure for seen in closed_loop(before, "", "", size.past, seed=seed + 10_000)]
        for name in PREDICTORS:
            run(name, rig, predicted(name, np.array([centroids(rig, exposure) for exposure in earlier])))
        for estimator in ESTIMATORS:
            run(estimator, rig, "lqg", estimator)
        if cell.identified:
            kinds = [*["second-order"] * cell.turbulence, "resonance"]
            seen = [readings(before, earlier)]
            space = space_of(kinds, seen)
            own = disturbed(space.model(maxima(space, seen)[0].x))
            for estimator in cell.identified:
                run(f"identified {estimator}", own, "lqg", estimator)
        run("true state", rig, with_true_state(ahead))
    return rms


def loop_worth(effort: Effort) -> list[Row]:
    """By frequency of the vibration and exposure; with turbulence at 2.4 and 2.7 times the frame rate, which centroids
    cannot reach, `profile` is to leave less than .95 of the best integrator's residual."""
    cells, size = (CELLS, FULL) if effort.share == 1 else ([Cell(True, 2.4, 20, ("o1",))], SHORT)
    rows = []
    for each in all_measured(cells, size):
        ours = [*(f"identified {name}" for name in each.cell.identified), *ESTIMATORS]
        shown = ", ".join(f"{name} {each.ratio(name):.2f}" for name in ours)
        theirs = ", ".join(f"{name} {each.ratio(name):.2f}" for name in (*PREDICTORS, "true state"))
        worst = max(each.ratio(name) for name in ours if name.endswith("profile"))
        rows.append(Row(
            f"loop, {each.cell}: slopes left over those of the best integrator", shown,
            f"{theirs}; {each.best} {each.rms[each.best].mean():.4f}, open {each.rms['open'].mean():.4f}",
            _GOAL / worst, 1.0 if len(each.cell.identified) > 1 else 0.0,
        ))  # fmt: skip
    return rows


# The disturbances


@dataclass(frozen=True, eq=False)
class DisturbanceRun:
    """Slopes at each fast step, and the state from which one who has seen all of them up to a step predicts the next.

    Row k of ``states``, (steps, n), goes with ``slopes[k]``, which is C x(k); the prediction is x(k+1) = A x(k).
    """

    slopes: FloatArray
    states: FloatArray
    A: FloatArray
    C: FloatArray
    model: ProcessSum
    """The model that an estimator is given."""


def played(believes: Rig, slopes: FloatArray, path: Path) -> Rig:
    """A rig with a file of its own that these slopes (steps, 1) disturb, whatever its model is."""
    np.save(path.with_suffix(".npy"), slopes)
    table = f'[disturbance]\nplant_noise = false\nrecorded = "{path.stem}.npy"\n\n[simulation]'
    path.write_text(believes.toml.replace("[simulation]", table, 1))
    return load_rig(path)


def together(parts: Sequence[DisturbanceRun]) -> DisturbanceRun:
    """The sum of independent disturbances."""
    return DisturbanceRun(
        np.sum([part.slopes for part in parts], axis=0), np.hstack([part.states for part in parts]),
        np.asarray(linalg.block_diag(*(part.A for part in parts))), np.hstack([part.C for part in parts]),
        ProcessSum(tuple(process for part in parts for process in part.model.processes)),
    )  # fmt: skip


def vibration(frequency_hz: float, sd: float, steps: int, seed: int) -> DisturbanceRun:
    """A vibration: a resonance that noise drives. Its model is the true one."""
    model = ProcessSum((Process("resonance", (frequency_hz, DAMPING, sd)),))
    space, random = model.state_space(STEP_S), np.random.default_rng([seed, 1])
    pushes = random.standard_normal((steps, len(space.A))) @ psd_root(space.W).T @ space.B_w.T
    states = np.empty((steps, len(space.A)))
    state = psd_root(space.initial_covariance) @ random.standard_normal(len(space.A))
    for k, push in enumerate(pushes):
        states[k] = state
        state = space.A @ state + push
    return DisturbanceRun(states @ space.C[0], states, space.A, space.C, model)


def turbulence(sd: float, steps: int, past: int, seed: int) -> DisturbanceRun:
    """Tilt of two von Karman layers in frozen flow.

    It has no finite model. Two models are fitted to its true slopes in the first ``past`` steps: an autoregressive one,
    and for the estimators the sum of two processes of second order with the highest likelihood (Whittle).
    """
    slopes = sd * _tilt(steps, seed)
    order = min(_ORDER, past // 4)
    A = _autoregressive(slopes[:past], order)
    led = np.concatenate([np.full(order - 1, slopes[0]), slopes])
    states = np.lib.stride_tricks.sliding_window_view(led, order)[:, ::-1]
    return DisturbanceRun(slopes, states, A, np.eye(1, order), likeliest(slopes[:past]))


@lru_cache(maxsize=16)
def _tilt(steps: int, seed: int) -> FloatArray:
    """Tilt of mean zero and sd 1, (steps,)."""
    random = np.random.default_rng([seed, 2])
    made = np.sum([_waves(wind, steps, random) for wind in WINDS_M_S], axis=0)
    return np.asarray((made - made.mean()) / made.std())


def _wind(speed_m_s: float, random: np.random.Generator) -> tuple[float, float]:
    turn = random.uniform(0, 2 * math.pi)
    return speed_m_s * math.cos(turn), speed_m_s * math.sin(turn)


def _waves(speed_m_s: float, steps: int, random: np.random.Generator) -> FloatArray:
    """Mean slope over a square pupil."""
    flow = FrozenFlow(Layer(r0_m=0.1, wind_m_s=_wind(speed_m_s, random)), random, shortest_m=_SHORTEST_M)
    k = flow.wave_numbers
    tilts = 1j * k[:, 0] * flow.amplitudes * np.prod(np.sinc(k * PUPIL_M / (2 * math.pi)), axis=1)
    times = STEP_S * np.arange(steps, dtype=np.float64)
    return np.concatenate([np.real(tilts @ flow.blown(times[k : k + 4096])) for k in range(0, steps, 4096)])


def _autoregressive(slopes: FloatArray, order: int) -> FloatArray:
    """The companion matrix of the least-squares fit, whose state is the last values, the newest first."""
    rows = np.lib.stride_tricks.sliding_window_view(slopes, order + 1)
    before, after = rows[:, -2::-1], rows[:, -1]
    normal = before.T @ before
    normal += _RIDGE * np.trace(normal) / order * np.eye(order)
    return np.vstack([np.linalg.solve(normal, before.T @ after), np.eye(order - 1, order)])


def likeliest(slopes: FloatArray) -> ProcessSum:
    """The sum of two processes of second order with the highest likelihood (Whittle)."""
    frequency, power = signal.periodogram(slopes, 1 / STEP_S, window="hann", detrend="constant")
    used = slice(2, int(np.searchsorted(frequency, _HIGHEST_HZ)))  # the taper mixes the first two with the mean
    omega, power, sd = 2 * math.pi * frequency[used], power[used] / 2, float(slopes.std())

    def model(x: FloatArray) -> ProcessSum:
        return ProcessSum(tuple(Process("second-order", tuple(each)) for each in np.exp(x).reshape(2, 3).tolist()))

    def minus_log_likelihood(x: FloatArray) -> float:
        density = np.zeros_like(omega)
        for each in model(x).processes:
            poles = each.poles[:, None]
            density += (each.residues[:, None] * -2 * poles / (poles**2 + omega**2)).sum(axis=0).real
        return float(np.sum(np.log(density) + power / density))

    start = np.log([0.3, 0.03, 0.7 * sd, 0.05, 0.01, 0.7 * sd])
    bounds = 2 * [*np.log([(1e-3, 10.0), (1e-3, 10.0), (1e-3 * sd, 3 * sd)])]
    return model(optimize.minimize(minus_log_likelihood, start, method="L-BFGS-B", bounds=bounds).x)


# What closes the loop beside ours

PREDICTORS = ("ar_kalman", "least_squares")


class _MirrorFollowed:
    """Computes the mirror's motion by its model and the inputs that it held, all of which it gets."""

    def __init__(self, rig: Rig) -> None:
        moved, _ = reached(rig.plant)
        self._A, self._B, self._C = rig.plant.A[np.ix_(moved, moved)], rig.plant.B[moved], rig.plant.C[:, moved]
        self._mirror = np.zeros(len(moved))
        self._steps = rig.timing.exposure_steps
        self._held = [rig.mirror.park] * (self._steps + 1)
        """Inputs from the step before the newest exposure on."""

    def exposed(self, seen: Seen) -> FloatArray:
        """The mirror's mean share of the slopes in the exposure that is seen, (n_outputs,); it then is at its end."""
        total = np.zeros(len(self._C))
        for u in self._held[1 : self._steps + 1]:
            total += self._C @ self._mirror
            self._mirror = self._A @ self._mirror + self._B @ u
        self._held = [self._held[self._steps], *seen.pending[:-1]]
        return total / self._steps

    def follow(self, held: FloatArray) -> None:
        """The input of one more step."""
        self._held.append(held)


class Predicted(_MirrorFollowed):
    """A predictor of pyRTC on the pseudo-open-loop centroids: the mirror cancels its prediction for a frame."""

    def __init__(self, rig: Rig, predictor: ModalPredictor) -> None:
        super().__init__(rig)
        self.predictor = copy.deepcopy(predictor)
        self._from_slopes = np.linalg.inv(response_at_rest(rig.plant, self._steps))
        self._u = rig.mirror.park

    def see(self, seen: Seen) -> None:
        self.predictor.update(seen.slopes - self.exposed(seen))
        self._u = -self._from_slopes @ self.predictor.predict()

    def step(self, held: FloatArray) -> FloatArray:
        self.follow(held)
        return self._u


class TrueState(_MirrorFollowed):
    """`lqg` with the disturbance's true state at the end of each exposure in the place of an estimate."""

    def __init__(self, rig: Rig, known: DisturbanceRun) -> None:
        super().__init__(rig)
        n = len(known.A)
        plant = replace(
            rig.plant, A=linalg.block_diag(self._A, known.A), B=np.vstack([self._B, np.zeros((n, 1))]),
            C=np.hstack([self._C, known.C]), initial_mean=np.zeros(len(self._A) + n),
        )  # fmt: skip
        self._lqg, self._states, self._end = LQG(replace(rig, plant=plant)), known.states, 0

    def see(self, seen: Seen) -> None:
        self.exposed(seen)
        self._end += self._steps
        state = np.concatenate([self._mirror, self._states[self._end]])
        self._lqg.see(replace(seen, state=state[None]))

    def step(self, held: FloatArray) -> FloatArray:
        self.follow(held)
        return self._lqg.step(held)


def predicted(name: str, centroids: FloatArray) -> ControllerRow:
    """A predictor of pyRTC fitted to the centroids of past exposures with the mirror at rest, (exposures, 1).

    The correction acts from the next exposure on: one frame ahead. Everything else is as in pyRTC.
    """
    predictor = make_predictor({"type": name, "horizon": 1}, centroids.shape[1]).fit(centroids)
    for each in centroids:
        predictor.update(each)
    return ControllerRow(
        name=name, summary="pyRTC", build=lambda rig: Predicted(rig, predictor), needs_state=False
    )  # fmt: skip


def with_true_state(known: DisturbanceRun) -> ControllerRow:
    """The row of the controller for a loop whose first fast step has the first row of ``known``."""
    return ControllerRow(
        name="true-state", summary="the limit", build=lambda rig: TrueState(rig, known), needs_state=False
    )  # fmt: skip
