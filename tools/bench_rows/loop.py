"""What closing the loop is worth: residual slopes with lqg beside the best integrator, on the same disturbances."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from aolink.exposure import residual_rms
from aolink.jobs.closed_loop import closed_loop
from aolink.rig import Rig, load_rig, parse_rig
from bench_rows.row import Effort, Row

_FREQUENCIES_HZ = (12.0, 30.0, 48.0)
"""0.6, 1.5 and 2.4 times the frame rate of the rig `loop`."""
_ESTIMATORS = ("o1", "moments", "profile")
_GAINS = (0.3, 0.5, 0.7, 0.9)
_SETTLED = 20
"""Exposures at the beginning that are left out."""
_T_95 = {2: 6.31, 5: 2.13}
"""Student's t for a one-sided 95 % bound, by the number of seeds."""


def residual(rig: Rig, controller: str, estimator: str, exposures: int, seed: int) -> float:
    """Root mean square of the true slopes at the fast rate, once the loop has settled."""
    series = [each.exposure for each in closed_loop(rig, controller, estimator, exposures, seed=seed)]
    return residual_rms(series[min(_SETTLED, exposures // 2) :])


def residual_slopes(effort: Effort) -> list[Row]:
    """Drift and a line of equal sd, as the rig file's model has them: 5 seeds of 120 exposures, four gains tried.

    The integrator's gain is the best for all seeds together, with hindsight. In brackets: the mean over the seeds of
    ours over the integrator's, and its one-sided 95 % bound.
    """
    seeds, exposures = range(101, 101 + effort.of(5, 2)), effort.of(120, 6)
    gains = _GAINS if effort.share >= 1 else _GAINS[:1]
    rows = []
    for frequency in _FREQUENCIES_HZ:
        rig = parse_rig(load_rig("loop").toml.replace("frequency_hz = 12.0", f"frequency_hz = {frequency}"))
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
                f"loop, drift + line at {rate:.1f} of the frame rate: lqg + {estimator}",
                f"{np.mean(ours):.4f} ({shares.mean():.3f}, below {bound:.3f})",
                f"integrator {np.mean(tried[best]):.4f} (gain {gains[best]:g}); open {np.mean(still):.4f}",
                float(1 / shares.mean()), 1.0,
            ))  # fmt: skip
    return rows
