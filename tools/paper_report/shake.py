"""A shake faster than the frames, where the blur shows motion that centroids cannot, and the consistency of `moments`
there."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from aolink.estimation import Estimate, run
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig
from paper_report.blocks import Block, Heading, Table, Text
from paper_report.ensemble import IntervalEstimate, ensemble, errors, mean, normalised, ratio, rms, variant
from paper_report.numbers import Effort

DAMPING, SD = 0.005, 0.2
FREQUENCIES_HZ, DENSITIES = (5.0, 8.0, 12.0, 20.0), (0.1, 0.01, 0.001)
# Enough for five sd of the noise at V = 0.1 above the spot at rest.
_COUNTS_PER_DENSITY = 1500.0


@dataclass(frozen=True)
class ShakeRow:
    """The row of one frequency and noise."""

    frequency_hz: float
    noise_density: float
    o1: IntervalEstimate
    """RMSE of the path."""
    moments: IntervalEstimate
    ratio: IntervalEstimate
    """Ratio moments/o1, paired."""
    nees: IntervalEstimate
    """NEES of the end state by `moments`; 2 where its covariance is right."""
    nees_open_loop: IntervalEstimate
    """The same by prediction alone, whose covariance is right: it shows the scatter about 2 with this number of
    runs."""


def shaken(rig: Rig, frequency_hz: float, noise_density: float) -> Rig:
    """The rig with a damped resonance for its plant, whose displacement has the same sd at any frequency."""
    w = 2 * math.pi * frequency_hz
    A = linalg.expm(np.array([[0, 1], [-w * w, -2 * DAMPING * w]]) * rig.timing.fast_step_s)
    B_w = np.array([[0.0], [1.0]])
    W = SD**2 / linalg.solve_discrete_lyapunov(A, B_w @ B_w.T)[0, 0]
    stationary = np.asarray(linalg.solve_discrete_lyapunov(A, W * B_w @ B_w.T))
    plant = dataclasses.replace(
        rig.plant, A=A, B_w=B_w, process_noise=np.array([[W]]), initial_mean=np.zeros(2), initial_covariance=stationary
    )
    sensor = dataclasses.replace(rig.sensor, counts_per_density=_COUNTS_PER_DENSITY)
    return variant(dataclasses.replace(rig, plant=plant, sensor=sensor), noise_density=noise_density, offset=0.0)


def end_nees(exposures: Sequence[Exposure], estimates: Sequence[Estimate], skip: int) -> FloatArray:
    """Normalised squared error of the end state, (runs, exposures)."""
    found = []
    for exposure, estimate in list(zip(exposures, estimates, strict=True))[skip:]:
        assert exposure.truth is not None
        found.append(normalised(estimate, estimate.end_state - exposure.truth.end_state))
    return np.array(found).T


def shake_table(rig: Rig, effort: Effort) -> list[ShakeRow]:
    """o1 and moments at every frequency and noise."""
    rows, skip = [], min(5, effort.skip)
    for i, frequency in enumerate(FREQUENCIES_HZ):
        for density in DENSITIES:
            many, series = ensemble(shaken(rig, frequency, density), effort.shake_runs, skip + 20, seed=610 + 2 * i)
            found = run(many, series, ["open-loop", "o1", "moments"])
            o1, moments = (errors(series, found[name], skip).path for name in ("o1", "moments"))
            nees, open_loop = (mean(end_nees(series, found[name], skip)) for name in ("moments", "open-loop"))
            rows.append(ShakeRow(frequency, density, rms(o1), rms(moments), ratio(moments, o1), nees, open_loop))
    return rows


def shake_section(rows: Sequence[ShakeRow], effort: Effort) -> list[Block]:
    """The table with its interpretation."""
    table = [
        [f"{r.frequency_hz:g}", f"{r.noise_density:g}", str(r.o1), str(r.moments), r.ratio.interval, str(r.nees),
         str(r.nees_open_loop)]
        for r in rows
    ]  # fmt: skip
    worst = max(rows, key=lambda r: r.ratio.high)
    return [
        Heading("A shake faster than the frames"),
        Text(
            f"Not the paper's: a resonance of damping {DAMPING} and sd {SD} in the same exposures of 200 ms, without"
            f" input, {effort.shake_runs} runs. At 5 and 20 Hz whole periods fit into an exposure: centroids see next"
            " to nothing, and the blur shows the amplitude but not the phase. Elsewhere the blur is most of what there"
            f" is. The largest upper bound of moments/o1 is {worst.ratio.high:.3f} (at {worst.frequency_hz:g} Hz,"
            f" V = {worst.noise_density:g})."
        ),
        Text(
            "NEES is that of the end state, 2 where a covariance is right. A resonance remembers its amplitude for many"
            " exposures, so that a run is worth few independent ones: open loop, whose covariance is right by"
            " construction, shows by how much 2 is missed by chance. In an ensemble of thirty runs that is a quarter,"
            " and the ratio to o1 at 20 Hz is off by two per cent."
        ),
        Table(["Hz", "V", "o1", "moments", "moments/o1 [95 %]", "NEES", "NEES of open loop"], table),
    ]  # fmt: skip
