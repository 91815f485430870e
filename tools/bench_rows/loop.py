"""Rows about the benefit of closing the loop: residual slopes with lqg beside the best integrator, on the same
disturbances."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from aolink.exposure import residual_rms
from aolink.jobs.closed_loop import closed_loop
from aolink.optics.turbulence import FrozenFlow, Layer
from aolink.rig import Rig, load_rig, parse_rig
from bench_rows.disturbances import by_model, played
from bench_rows.row import Effort, Row

_FREQUENCIES_HZ = (12.0, 30.0, 48.0)
"""0.6, 1.5 and 2.4 times the frame rate of the rig `loop`."""
_ESTIMATORS = ("o1", "moments", "profile")
_GAINS = (0.3, 0.5, 0.7, 0.9)
_SETTLED = 20
"""Exposures at the beginning that are left out."""
_T_95 = {2: 6.31, 5: 2.13, 24: 1.714}
"""Student's t for a one-sided 95 % bound, by the number of seeds."""


def residual(rig: Rig, controller: str, estimator: str, exposures: int, seed: int) -> float:
    """Root mean square of the true slopes at the fast rate, once the loop has settled."""
    series = [each.exposure for each in closed_loop(rig, controller, estimator, exposures, seed=seed)]
    return residual_rms(series[min(_SETTLED, exposures // 2) :])


def residual_slopes(effort: Effort) -> list[Row]:
    """Drift and a vibration of equal sd, as the rig file's model has them: 5 seeds of 120 exposures, four gains tried.

    The integrator's gain is the best for all seeds together, with hindsight. In brackets: the mean over the seeds of
    ours over the integrator's, and its one-sided 95 % bound, which is to be below one.
    """
    seeds, exposures = range(101, 101 + effort.of(5, 2)), effort.of(120, 6)
    gains = _GAINS if effort.share >= 1 else _GAINS[:1]
    rows = []
    for frequency in _FREQUENCIES_HZ:
        rig = _with_vibration(frequency)
        still = [residual(rig, "", "", exposures, seed) for seed in seeds]
        tried = [
            [residual(replace(rig, control=replace(rig.control, gain=gain)), "integrator", "", exposures, seed)
             for seed in seeds] for gain in gains
        ]  # fmt: skip
        best = int(np.argmin(np.mean(tried, axis=1)))
        for estimator in _ESTIMATORS:
            ours = [residual(rig, "lqg", estimator, exposures, seed) for seed in seeds]
            shares = np.array(ours) / tried[best]
            bound = shares.mean() + _T_95[len(seeds)] * shares.std(ddof=1) / math.sqrt(len(seeds))
            rate = rig.timing.frame_period_steps * rig.timing.fast_step_s * frequency
            rows.append(Row(
                f"loop, drift + vibration at {rate:.1f} of the frame rate: lqg + {estimator}",
                f"{np.mean(ours):.4f} ({shares.mean():.3f}, below {bound:.3f})",
                f"integrator {np.mean(tried[best]):.4f} (gain {gains[best]:g}); open {np.mean(still):.4f}",
                float(1 / bound), 1.0,
            ))  # fmt: skip
    return rows


Series = Callable[[int, np.random.Generator], NDArray[np.float64]]
"""A function that gives the slopes of a number of fast steps, (steps, 1)."""
_PUPIL_M = 0.5


def fall_back(effort: Effort) -> list[Row]:
    """lqg + o1 on the rig `loop` with other disturbances than its model has: 24 seeds of 240 exposures.

    The integrator has the rig file's gain, not the best one. Numbers in brackets are as in `residual_slopes`; where the
    model is right or turbulence is alone, the bound is to be at most 1.02.
    """
    seeds, exposures = range(501, 501 + effort.of(24, 2)), effort.of(240, 6)
    wrong = _by_model(0.7 * 12.0), _by_model(1.3 * 12.0)
    cases: list[tuple[str, float, Series | None]] = [
        ("as the model has it, vibration at 0.6", 12.0, None),
        ("as the model has it, vibration at 2.4", 48.0, None),
        ("vibration 30 % below the model's", 12.0, wrong[0]),
        ("vibration 30 % above the model's", 12.0, wrong[1]),
        ("turbulence alone, 5 and 11 m/s", 12.0, _turbulence(5.0)),
        ("turbulence alone, 20 and 44 m/s", 12.0, _turbulence(20.0)),
    ]
    rows = []
    for what, frequency, series in cases:
        found = []
        for seed in seeds:
            with TemporaryDirectory() as folder:
                rig = _disturbed(_with_vibration(frequency), series, exposures, seed, Path(folder))
                alone = replace(rig, control=replace(rig.control, fall_back=False))
                each = ((alone, "", ""), (alone, "integrator", ""), (alone, "lqg", "o1"), (rig, "lqg", "o1"))
                found.append([residual(*of, exposures, seed) for of in each])
        still, integrator, never, ours = np.array(found).T
        shares = ours / integrator
        bound = shares.mean() + _T_95[len(seeds)] * shares.std(ddof=1) / math.sqrt(len(seeds))
        rows.append(Row(
            f"loop, {what}: lqg + o1 that may fall back", f"{ours.mean():.4f} ({shares.mean():.3f}, below {bound:.3f})",
            f"integrator {integrator.mean():.4f}; never falling back {never.mean():.4f}; open {still.mean():.4f}",
            float(1.02 / bound), 0.0 if series in wrong else 1.0,
        ))  # fmt: skip
    return rows


def _with_vibration(frequency_hz: float) -> Rig:
    return parse_rig(load_rig("loop").toml.replace("frequency_hz = 12.0", f"frequency_hz = {frequency_hz}"))


def _disturbed(believed: Rig, series: Series | None, exposures: int, seed: int, folder: Path) -> Rig:
    """A rig that keeps its model while another disturbance acts."""
    if series is None:
        return believed
    steps = (exposures + 2) * believed.timing.frame_period_steps
    return played(believed, series(steps, np.random.default_rng(1000 + seed)), folder / "rig.toml")


def _by_model(frequency_hz: float) -> Series:
    """The disturbance of the rig's model with its vibration at another frequency."""
    return lambda steps, rng: by_model(_with_vibration(frequency_hz), steps, rng, None)[0]


def _turbulence(wind_m_s: float) -> Series:
    """Tilt over a square pupil of two layers in frozen flow, of sd 0.14 in the mean over seeds."""

    def waves(wind: float, turn: float, rng: np.random.Generator) -> tuple[FrozenFlow, NDArray[np.complex128]]:
        layer = Layer(r0_m=0.1, wind_m_s=(wind * math.cos(turn), wind * math.sin(turn)))
        flow = FrozenFlow(layer, rng, shortest_m=_PUPIL_M / 2)
        k = flow.wave_numbers
        over_pupil = np.prod(np.sinc(k * _PUPIL_M / (2 * math.pi)), axis=1)
        return flow, 1j * k[:, 0] * flow.amplitudes * over_pupil

    def series(steps: int, rng: np.random.Generator) -> NDArray[np.float64]:
        several = [waves(5.0, 0.0, np.random.default_rng(900 + seed))[1] for seed in range(30)]
        scale = 0.14 / math.sqrt(2 * np.mean([np.sum(np.abs(each) ** 2) / 2 for each in several]))
        slopes, times = np.zeros(steps), 0.001 * np.arange(steps, dtype=np.float64)
        for wind in (wind_m_s, 2.2 * wind_m_s):
            flow, tilts = waves(wind, rng.uniform(0, 2 * math.pi), rng)
            for k in range(0, steps, 4096):
                slopes[k : k + 4096] += np.real(np.matmul(tilts, flow.blown(times[k : k + 4096])))
        return (scale * slopes)[:, None]

    return series
