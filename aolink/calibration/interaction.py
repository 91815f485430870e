"""The measurement of a rig's interaction matrix: every input is pushed and pulled, and the camera shows where the spots
go."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aolink.errors import CalibrationError
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.numerics.rms import rms
from aolink.optics.camera import to_density
from aolink.optics.centroid import centre_of_gravity
from aolink.optics.frame import spot_windows
from aolink.optics.sensor import BaseSensor, RegionSensor
from aolink.rig import Rig

# A pixel counts if its density exceeds this many sd of noise: pixels far from the spot only add noise.
_THRESHOLD_SD = 4.0
_ROUNDING = 1e-9
_LONGEST_RAMP_S = 60.0
"""A poke that takes longer to reach is probably a mistake: drift would count as the mirror's motion."""


@dataclass(frozen=True, eq=False)
class Interaction:
    """Slopes for inputs at rest, and their uncertainty."""

    matrix: FloatArray
    """Slope units per input unit, (n_outputs, n_inputs)."""
    offset: FloatArray
    """Slopes without input, (n_outputs,)."""
    singular_values: FloatArray
    """Singular values of the matrix, from large to small."""
    residual_rms: float
    """Rms of the slopes that the matrix does not explain, slope units."""
    sd: FloatArray
    """Standard deviation of the matrix's entries by these residuals, the same for all slopes, (n_inputs,); NaN where
    there are no more exposures than unknowns."""
    exposures: int
    """Number of exposures used."""

    @property
    def condition(self) -> float:
        """Largest over smallest singular value: how much weaker the weakest mirror mode is."""
        return float(self.singular_values[0] / max(self.singular_values[-1], 1e-300))


def rest_exposures(rig: Rig, hold_s: float) -> int:
    """Frame periods that a poke rests before it is measured, so that it has rested for ``hold_s``: at least one."""
    period_s = rig.timing.frame_period_steps * rig.timing.fast_step_s
    return max(1, math.ceil(hold_s / period_s - _ROUNDING))


def poke_inputs(rig: Rig, amplitude: FloatArray | float, rest_exposures: int = 1) -> FloatArray:
    """Inputs at each fast step that push each input up and down in turn.

    Each value is held for ``rest_exposures`` frame periods, in which the mirror settles, and one more to be measured.
    Where the rig file has ``mirror.slew_max_per_s``, a ramp of whole frame periods leads to each value, and from the
    last to the safe input. Raises `CalibrationError` where the pokes would go beyond the mirror's limits, or a ramp
    would take longer than a minute.
    """
    size = np.broadcast_to(np.asarray(amplitude, dtype=np.float64), rig.n_inputs)
    pokes = np.concatenate([sign * np.diag(size) for sign in (1.0, -1.0)]) + rig.mirror.park
    pokes = pokes.reshape(2, rig.n_inputs, -1).swapaxes(0, 1).reshape(-1, rig.n_inputs)
    if (pokes < rig.mirror.input_min).any() or (pokes > rig.mirror.input_max).any():
        raise CalibrationError("the pokes go beyond the mirror's limits: take a smaller amplitude")
    rows, before = [], np.asarray(rig.mirror.park, dtype=np.float64)
    for value in pokes:
        rows += [_ramp(rig, before, value), np.tile(value, ((rest_exposures + 1) * rig.timing.frame_period_steps, 1))]
        before = value
    return np.concatenate([*rows, _ramp(rig, before, rig.mirror.park)])


def _ramp(rig: Rig, begin: FloatArray, end: FloatArray) -> FloatArray:
    """Inputs from ``begin`` to ``end``, which comes last, no faster than the rig file allows, (n_steps, n_inputs)."""
    slew, timing = rig.mirror.slew_max_per_s, rig.timing
    if not slew:
        return np.zeros((0, rig.n_inputs))
    needed_s = float(np.abs(end - begin).max()) / slew
    if needed_s > _LONGEST_RAMP_S:
        raise CalibrationError(
            f"mirror.slew_max_per_s = {slew:g} makes the ramp from one poke to the next {needed_s:.3g} s long, more"
            f" than {_LONGEST_RAMP_S:g} s: take a smaller amplitude, or correct the rig file"
        )
    n_steps = math.ceil(needed_s / (timing.frame_period_steps * timing.fast_step_s)) * timing.frame_period_steps
    return begin + (end - begin) * np.arange(1, n_steps + 1)[:, None] / max(n_steps, 1)


def measure_interaction(
    rig: Rig, exposures: Iterable[Exposure], slopes_of: Callable[[Exposure], FloatArray] | None = None,
    rest_exposures: int = 1,
) -> Interaction:  # fmt: skip
    """Fit slopes to inputs by least squares, over the exposures whose input had rested since the beginning of an
    earlier exposure.

    Raises `CalibrationError` where the sensor has no grid of spots, spots are missing, or inputs did not move apart
    from each other.

    Parameters
    ----------
    rest_exposures:
        How many exposures earlier that one is, as for `poke_inputs`.
    slopes_of:
        Function that gives the slopes of an exposure instead of its spots' centroids, (n_outputs,), such as those of
        the rig file's plant. It is called for every exposure, in order.
    """
    check_spots(rig)
    inputs, slopes, value, rested = [], [], np.full(rig.n_inputs, np.nan), 0
    for exposure in exposures:
        seen = slopes_of(exposure) if slopes_of else None
        still = bool((exposure.inputs == exposure.inputs[0]).all())
        goes_on = still and (exposure.inputs[0] == value).all() and (exposure.lead_inputs == value).all()
        value, rested = exposure.inputs[0], rested + 1 if goes_on else int(still)
        if rested > rest_exposures and exposure.complete:
            inputs.append(value)
            slopes.append(spot_slopes(rig.sensor, exposure.pixels) if seen is None else seen)
    if not inputs:
        raise CalibrationError(
            f"in no exposure had the input rested since {rest_exposures} exposure(s) before it: hold each poke longer"
        )
    u, y = np.array(inputs), np.array(slopes)
    if np.isnan(y).any():
        raise CalibrationError(f"{int(np.isnan(y).any(axis=0).sum() // 2)} spots are missing in some exposure")
    design = np.column_stack([u, np.ones(len(u))])
    if np.linalg.matrix_rank(design) < design.shape[1]:
        raise CalibrationError(
            f"{len(u)} exposures at rest do not determine {rig.n_inputs} inputs: poke each of them alone"
        )
    solution, *_ = np.linalg.lstsq(design, y, rcond=None)
    matrix, residual = solution[:-1].T, y - design @ solution
    freedom = (len(u) - design.shape[1]) * y.shape[1]
    noise = float(np.sqrt((residual**2).sum() / freedom)) if freedom else float("nan")
    sd = noise * np.sqrt(np.diag(np.linalg.inv(design.T @ design))[:-1])
    return Interaction(matrix, solution[-1], np.linalg.svd(matrix, compute_uv=False), rms(residual), sd, len(u))


def check_spots(rig: Rig) -> None:
    """Raise CalibrationError for a sensor that sees no slopes in two directions."""
    if rig.sensor.directions == 1 or isinstance(rig.sensor, RegionSensor):
        raise CalibrationError("an interaction matrix needs a sensor of kind 'spots'")


def spot_slopes(sensor: BaseSensor, pixels: NDArray[np.uint16]) -> FloatArray:
    """Thresholded centroid of each spot in the rig's order, slope units, (2 spots,); NaN where there is no spot."""
    density = spot_windows(sensor, to_density(sensor, pixels))
    noise = np.sqrt(sensor.noise_density / sensor.pixel_size)
    place = centre_of_gravity(density, _THRESHOLD_SD * noise)
    return np.asarray(sensor.field[0] + (place + 0.5) * sensor.pixel_width).ravel()
