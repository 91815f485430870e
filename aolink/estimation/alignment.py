"""The error of an exposure's alignment with the mirror's fast steps, as a consider parameter of any filter.

Where camera and mirror have clocks of their own, nobody knows exactly which inputs belong to an exposure. The error of
the clocks' comparison is nearly the same in neighbouring exposures: it does not average out, so white noise is no model
of it. Nor can frames tell it from the plant's own motion, so it is not estimated. It is considered (S. F. Schmidt,
Advances in Control Systems 3 (1966); P. S. Maybeck, Stochastic Models, Estimation, and Control 2 (1982), section 13):
two copies of the filter are given the same frames with the inputs of some steps earlier and later, and half the
difference of their estimates is what such an error does to the estimate, with all that earlier exposures contributed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from aolink.estimation.estimate import AlignmentError, Estimate
from aolink.exposure import Exposure

FloatArray = NDArray[np.float64]


_NEGLIGIBLE = 0.02
"""An alignment that is known to this part of a fast step changes no estimate that the model has right."""


def matters(exposure: Exposure, fast_step_ns: int) -> bool:
    """Whether an exposure's alignment is so uncertain that it is to be considered."""
    return exposure.alignment_sigma_ns > _NEGLIGIBLE * fast_step_ns


def shift_for(exposure: Exposure, fast_step_ns: int) -> int:
    """How far the copies' inputs are shifted: about the root of three standard deviations, in whole fast steps."""
    return max(1, round(math.sqrt(3) * exposure.alignment_sigma_ns / fast_step_ns))


class Shifted:
    """Exposures with the inputs of some fast steps later, or earlier where ``steps`` is negative.

    They must be given in order. Inputs that have not come yet are taken to be those of the last step that has.
    """

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self._before: FloatArray | None = None
        """Inputs of the last steps before the next exposure's lead, as many as the shift is long."""

    def __call__(self, exposure: Exposure) -> Exposure:
        known = np.concatenate([exposure.lead_inputs, exposure.inputs])
        before = np.tile(known[0], (abs(self.steps), 1)) if self._before is None else self._before
        self._before = np.concatenate([before, known])[-abs(self.steps) :]
        if self.steps < 0:
            known = np.concatenate([before, known])
        else:
            known = np.concatenate([known, np.tile(known[-1], (self.steps, 1))])[self.steps :]
        lead, end = len(exposure.lead_inputs), len(exposure.lead_inputs) + exposure.n_steps
        return replace(
            exposure, first_step=exposure.first_step + self.steps, lead_inputs=known[:lead], inputs=known[lead:end],
            alignment_sigma_ns=0.0,
        )  # fmt: skip


def considered(
    exposures: Sequence[Exposure], nominal: Iterator[Estimate], later: Iterator[Estimate], earlier: Iterator[Estimate],
    shift: int, fast_step_ns: int,
) -> Iterator[Estimate]:  # fmt: skip
    """Estimates with the error of their alignment, from those of filters with inputs ``shift`` steps off."""
    for exposure, estimate, late, early in zip(exposures, nominal, later, earlier, strict=True):
        steps = exposure.alignment_sigma_ns / fast_step_ns
        scale = steps / (2 * shift)
        alignment = AlignmentError(
            steps=steps,
            coefficients=scale * (late.coefficients - early.coefficients),
            end_state=scale * (late.end_state - early.end_state),
        )
        innovation_covariance, nis = estimate.innovation_covariance, estimate.nis
        if innovation_covariance.ndim == 3:
            change = scale * (late.innovation - early.innovation)
            innovation_covariance = innovation_covariance + change[:, :, None] * change[:, None, :]
            nis = _nis(estimate, change)
        yield replace(
            estimate,
            start_covariance=alignment.added_to(estimate.start_covariance, "coefficients"),
            end_covariance=alignment.added_to(estimate.end_covariance, "end_state"),
            innovation_covariance=innovation_covariance,
            nis=nis,
            alignment=alignment,
        )


def _nis(estimate: Estimate, change: FloatArray) -> FloatArray:
    """nu' (S + c c')^-1 nu from nu' S^-1 nu, for a change c of the innovation (Sherman and Morrison)."""
    nis = estimate.nis.copy()
    for axis in np.flatnonzero(nis > 0):
        weighted = np.linalg.lstsq(estimate.innovation_covariance[axis], change[axis], rcond=None)[0]
        nis[axis] -= (weighted @ estimate.innovation[axis]) ** 2 / (1 + weighted @ change[axis])
    return np.maximum(nis, 0.0)
