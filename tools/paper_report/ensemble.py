"""Many independent runs of a rig at once, their errors, and the uncertainty of these."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aolink.estimation import Estimate, run
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import pixel_noise_sd, to_counts, to_density
from aolink.optics.sensor import Sensor
from aolink.rig import Rig
from aolink.simulation.model import simulate

_RESAMPLES = 1000


@dataclass(frozen=True, kw_only=True)
class SensorRows(Sensor):
    """A line sensor for each of several independent axes, read out as the rows of one frame."""

    rows: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        return (self.rows, self.pixels)


def variant(
    rig: Rig, *, process_noise: float | None = None, noise_density: float | None = None, offset: float | None = None,
    output: Sequence[float] | None = None,
) -> Rig:  # fmt: skip
    """A rig with other noise, another output, or held off centre from the start instead of driven.

    Parameters
    ----------
    process_noise:
        W_f; the initial covariance, the stationary one, goes with it.
    noise_density:
        V.
    offset:
        Where a constant input holds the spot, slope units; 0 is the rig without input.
    output:
        C, one row.
    """
    plant, sensor, drive = rig.plant, rig.sensor, rig.drive
    if process_noise is not None:
        factor = process_noise / plant.process_noise[0, 0]
        plant = dataclasses.replace(
            plant, process_noise=plant.process_noise * factor, initial_covariance=plant.initial_covariance * factor
        )
    if noise_density is not None:
        sensor = dataclasses.replace(sensor, noise_density=noise_density)
    if offset is not None:
        rest = np.linalg.solve(np.eye(plant.n_states) - plant.A, plant.B[:, 0]).astype(np.float64)
        held = offset / float(plant.C[0] @ rest)
        drive = dataclasses.replace(drive, kind="none", amplitude=np.zeros(1), offset=np.array([held]))
        plant = dataclasses.replace(plant, initial_mean=rest * held)
    if output is not None:
        plant = dataclasses.replace(plant, C=np.array([output], dtype=np.float64))
    return dataclasses.replace(rig, plant=plant, sensor=sensor, drive=drive)


def side_by_side(rig: Rig, runs: int) -> Rig:
    """A rig whose axes are ``runs`` independent copies of one that has a single axis."""
    values = {f.name: getattr(rig.sensor, f.name) for f in dataclasses.fields(Sensor)}
    return dataclasses.replace(
        rig, plant=dataclasses.replace(rig.plant, axes=runs), sensor=SensorRows(**values, rows=runs)
    )


def clean_exposures(rig: Rig, exposures: int, seed: int) -> list[Exposure]:
    """Exposures of a rig from `side_by_side` with process noise and without pixel noise; its slow input is the same for
    all runs."""
    silent = dataclasses.replace(rig, sensor=dataclasses.replace(rig.sensor, noise_density=0.0))
    inputs = rig.drive.inputs(0, exposures * rig.timing.exposure_steps, rig.timing.fast_step_s)
    return simulate(silent, exposures, seed, inputs=np.tile(inputs, (1, rig.plant.axes)))


def with_pixel_noise(rig: Rig, clean: Sequence[Exposure], seed: int) -> list[Exposure]:
    """The same exposures as the rig's noisy sensor sees them; the same random numbers whatever its V."""
    rng, sd = np.random.default_rng(seed), pixel_noise_sd(rig.sensor)
    noisy = []
    for exposure in clean:
        density = to_density(rig.sensor, exposure.pixels) + sd * rng.standard_normal(exposure.pixels.shape)
        noisy.append(dataclasses.replace(exposure, pixels=to_counts(rig.sensor, density)))
    return noisy


def ensemble(rig: Rig, runs: int, exposures: int, seed: int) -> tuple[Rig, list[Exposure]]:
    """Independent runs of a rig with a single axis, as one rig with many, and its exposures."""
    many = side_by_side(rig, runs)
    return many, with_pixel_noise(many, clean_exposures(many, exposures, seed), seed + 1)


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Squared errors of one estimator, each (runs, exposures)."""

    path: FloatArray
    """Mean over the exposure of the squared error of theta."""
    start: FloatArray
    """Squared norm of the error of the state at the exposure's start."""
    end: FloatArray
    """Squared norm of the error of the state at its end."""


def errors(exposures: Sequence[Exposure], estimates: Sequence[Estimate], skip: int) -> Errors:
    """Errors of estimates of an ensemble; the first ``skip`` exposures are left out."""
    path, start, end = [], [], []
    for exposure, estimate in list(zip(exposures, estimates, strict=True))[skip:]:
        truth = exposure.truth
        assert truth is not None
        path.append(np.mean((estimate.path - truth.path) ** 2, axis=1))
        start.append(np.sum((estimate.start_state - truth.start_state) ** 2, axis=1))
        end.append(np.sum((estimate.end_state - truth.end_state) ** 2, axis=1))
    return Errors(path=np.array(path).T, start=np.array(start).T, end=np.array(end).T)


def normalised(estimate: Estimate, error: FloatArray) -> FloatArray:
    """Normalised square of an error of the end state (axes, n_states), (axes,)."""
    return np.asarray(np.einsum("ai,ai->a", error, np.linalg.solve(estimate.end_covariance, error[..., None])[..., 0]))


def measure_errors(rig: Rig, exposures: Sequence[Exposure], names: Sequence[str], skip: int) -> dict[str, Errors]:
    """Errors of several estimators on the same exposures, by their names."""
    return {name: errors(exposures, each, skip) for name, each in run(rig, exposures, names).items()}


@dataclass(frozen=True)
class IntervalEstimate:
    """A number from runs, with its standard error and 95 % interval by bootstrap over the runs."""

    value: float
    se: float
    low: float
    high: float

    def __str__(self) -> str:
        if self.se <= 0:
            return f"{self.value:.3g}"
        power = math.floor(math.log10(max(abs(self.value), self.se)))
        power = power if power < -3 else 0
        value, se = self.value / 10**power, self.se / 10**power
        digits = -math.floor(math.log10(se))
        decimals = max(0, digits + (se * 10**digits < 2))
        text = f"{value:.{decimals}f} ± {se:.{decimals}f}"
        return f"({text})e{power:03d}" if power else text

    @property
    def interval(self) -> str:
        """Value and 95 % interval, for ratios."""
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def _resampled(count: int) -> NDArray[np.intp]:
    return np.random.default_rng(count).integers(0, count, size=(_RESAMPLES, count))


def measured(value: float, samples: FloatArray) -> IntervalEstimate:
    """A number with the error and the interval of its bootstrap samples."""
    low, high = np.quantile(samples, [0.025, 0.975])
    return IntervalEstimate(float(value), float(samples.std()), float(low), float(high))


def rms(squares: FloatArray) -> IntervalEstimate:
    """Root of the mean of squared errors, (runs, exposures); NaN where one does not count."""
    each = np.nanmean(squares, axis=1)
    return measured(np.sqrt(each.mean()), np.sqrt(each[_resampled(len(each))].mean(axis=1)))


def mean(values: FloatArray) -> IntervalEstimate:
    """Mean of (runs, exposures)."""
    each = values.mean(axis=1)
    return measured(each.mean(), each[_resampled(len(each))].mean(axis=1))


def ratio(squares: FloatArray, reference: FloatArray) -> IntervalEstimate:
    """Ratio of root mean squares, the runs resampled in pairs; both (runs, exposures), NaN where one does not count."""
    above, below = np.nanmean(squares, axis=1), np.nanmean(reference, axis=1)
    chosen = _resampled(len(above))
    samples = np.sqrt(above[chosen].mean(axis=1) / below[chosen].mean(axis=1))
    return measured(np.sqrt(above.mean() / below.mean()), samples)


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One point of the map."""

    offset: float
    noise_density: float
    process_noise: float
    path: IntervalEstimate
    """o3/o1, ratio of the RMSE of the path."""
    start: IntervalEstimate
    """The same ratio for the start state's norm."""
    end: IntervalEstimate
    """The same ratio for the end state's norm."""
    rmse: Mapping[str, IntervalEstimate]
    """RMSE of the path by estimator."""


def map_cells(
    rig: Rig, offsets: Sequence[float], densities: Sequence[float], process_noises: Sequence[float], *, runs: int,
    exposures: int, skip: int,
) -> list[Cell]:  # fmt: skip
    """The map o3/o1 over (offset, V, W_f): paired runs, and the same random numbers at every point."""
    cells = []
    for noise in process_noises:
        for offset in offsets:
            many = side_by_side(variant(rig, process_noise=noise, offset=offset), runs)
            clean = clean_exposures(many, exposures, seed=101)
            for density in densities:
                point = variant(many, noise_density=density)
                series = with_pixel_noise(point, clean, seed=102)
                cells.append(_cell(point, series, offset, skip))
    return cells


def _cell(rig: Rig, series: Sequence[Exposure], offset: float, skip: int) -> Cell:
    by_name = measure_errors(rig, series, ("open-loop", "o1", "o2", "o3"), skip)
    o1, o3 = by_name["o1"], by_name["o3"]
    return Cell(
        offset=offset,
        noise_density=rig.sensor.noise_density,
        process_noise=float(rig.plant.process_noise[0, 0]),
        path=ratio(o3.path, o1.path),
        start=ratio(o3.start, o1.start),
        end=ratio(o3.end, o1.end),
        rmse={name: rms(each.path) for name, each in by_name.items()},
    )
