"""The error of an exposure's alignment with the mirror's fast steps, as a consider parameter of any filter.

Where camera and mirror have clocks of their own, it is not known exactly which inputs belong to an exposure. The error
of the clocks' comparison is nearly the same in neighbouring exposures: it does not average out, so white noise is not a
model of it. Frames cannot distinguish it from the plant's own motion, so it is not estimated. It is considered (S. F.
Schmidt, Advances in Control Systems 3 (1966); P. S. Maybeck, Stochastic Models, Estimation, and Control 2 (1982),
section 13): two copies of the filter are given the same frames with the inputs of some steps earlier and later, and
half the difference of their estimates is the effect of such an error on the estimate, including the effect through
earlier exposures. Where the error is many steps, the estimate is not linear in it: the second order, from the sum of
the two, widens the covariances.

The clocks are known better the longer they are compared, and worse after a pause. The error is taken to be the same
number of standard deviations in all exposures, so each is shifted by its own: the effect of an exposure with badly
known alignment stays in the estimates until frames have corrected it, however well the later ones are aligned.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from aolink.estimation.estimate import AlignmentError, Estimate
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray

_NEGLIGIBLE = 0.02
"""An alignment error below this part of a fast step is negligible."""

_ROUNDED = 0.5
"""A shift of more than this part of a fast step is rounded to whole steps."""


def sigma_ns(exposure: Exposure) -> float:
    """The standard deviation of an exposure's alignment, ns; of its worst axis where the row time is not known."""
    if exposure.row_sigma_ns is None:
        return exposure.alignment_sigma_ns
    return math.hypot(exposure.alignment_sigma_ns, float(exposure.row_sigma_ns.max()))


def matters(exposure: Exposure, fast_step_ns: int) -> bool:
    """Whether an exposure's alignment is so uncertain that its error has to be considered."""
    return sigma_ns(exposure) > _NEGLIGIBLE * fast_step_ns


def share_of_shift(exposure: Exposure, fast_step_ns: int) -> float:
    """The standard deviation of an alignment as a part of the shift of the copies' inputs: one over the root of three.

    It is rounded so that the shift of this exposure, and of all that are aligned as well, is a number of whole steps.
    """
    sigma = sigma_ns(exposure) / fast_step_ns
    shift = math.sqrt(3) * sigma
    return sigma / (round(shift) if shift > _ROUNDED else shift)


class Shifted:
    """Exposures with later inputs, or earlier ones where ``share`` is negative.

    Each one's shift is the standard deviation of its alignment over ``share``. They must be given in order. Between two
    fast steps inputs are interpolated. Inputs that have not come yet are taken to be those of the last step that has;
    of those before the exposure's lead, as many are known as the longest shift or the exposure before has had.

    Where the row time is not known, the inputs of each axis are shifted by the axis's own standard deviation.
    """

    def __init__(self, share: float, fast_step_ns: int) -> None:
        self._share, self._fast_step_ns = share, fast_step_ns
        self._before: FloatArray | None = None

    def __call__(self, exposure: Exposure) -> Exposure:
        known = np.concatenate([exposure.lead_inputs, exposure.inputs])
        before = known[:0] if self._before is None else self._before
        if exposure.row_sigma_ns is None:
            shifted, reach = self._shifted(before, known, exposure.alignment_sigma_ns)
        else:
            sigmas = np.hypot(exposure.alignment_sigma_ns, exposure.row_sigma_ns)
            of_axis, reach = np.repeat(sigmas, known.shape[1] // len(sigmas)), 0
            shifted = np.empty_like(known)
            for sigma in np.unique(of_axis):
                some = of_axis == sigma
                shifted[:, some], far = self._shifted(before[:, some], known[:, some], float(sigma))
                reach = max(reach, far)
        self._before = np.concatenate([before, known])[-max(reach, len(before), len(known)) :]
        lead = len(exposure.lead_inputs)
        return replace(
            exposure, lead_inputs=shifted[:lead], inputs=shifted[lead:], alignment_sigma_ns=0.0, row_sigma_ns=None
        )  # fmt: skip

    def _shifted(self, before: FloatArray, known: FloatArray, sigma_ns: float) -> tuple[FloatArray, int]:
        """The known inputs shifted, and how many steps the shift reaches."""
        # Whole steps where the share was made so, in spite of the division.
        shift = round(sigma_ns / self._fast_step_ns / self._share, 6)
        reach, whole = math.ceil(abs(shift)), math.floor(shift)
        held = np.tile((before if len(before) else known)[0], (max(0, reach - len(before)), 1))
        row = np.concatenate([held, before, known, np.tile(known[-1], (reach + 1, 1))])
        start = len(held) + len(before) + whole
        shifted = row[start : start + len(known)]
        if shift != whole:
            shifted = shifted + (shift - whole) * (row[start + 1 : start + 1 + len(known)] - shifted)
        return shifted, reach


def considered(
    exposures: Sequence[Exposure], nominal: Iterator[Estimate], later: Iterator[Estimate], earlier: Iterator[Estimate],
    share: float, fast_step_ns: int,
) -> Iterator[Estimate]:  # fmt: skip
    """Estimates with the error of their alignment, from those of filters with inputs shifted both ways."""
    scale = share / 2
    for exposure, estimate, late, early in zip(exposures, nominal, later, earlier, strict=True):
        alignment = AlignmentError(
            steps=sigma_ns(exposure) / fast_step_ns,
            coefficients=scale * (late.coefficients - early.coefficients),
            end_state=scale * (late.end_state - early.end_state),
        )
        covariance = estimate.coefficient_covariance + _bent(share, estimate, late, early, "coefficients")
        n = estimate.end_state.shape[1]
        end_covariance = estimate.end_covariance + _bent(share, estimate, late, early, "end_state")
        innovation_covariance, nis = estimate.innovation_covariance, estimate.nis
        if innovation_covariance.ndim == 3:
            change = scale * (late.innovation - early.innovation)
            innovation_covariance = innovation_covariance + change[:, :, None] * change[:, None, :]
            nis = _nis(estimate, change)
        yield replace(
            estimate, coefficient_covariance=covariance, alignment=alignment,
            start_covariance=alignment.added_to(covariance[:, :n, :n], "coefficients"),
            end_covariance=alignment.added_to(end_covariance, "end_state"),
            innovation_covariance=innovation_covariance, nis=nis,
        )  # fmt: skip


def _bent(
    share: float, estimate: Estimate, late: Estimate, early: Estimate, name: Literal["coefficients", "end_state"]
) -> FloatArray:
    """The second-order effect of the alignment's error on the estimate, (axes, n, n).

    With shifts of root 3 standard deviations both are the points of Gauss and Hermite's quadrature, and the first
    order, c c', and this one are together the mean square of the estimate's change.
    """
    bend = getattr(late, name) + getattr(early, name) - 2 * getattr(estimate, name)
    bend *= math.sqrt(0.75) * share**2
    return np.asarray(bend[:, :, None] * bend[:, None, :])


def _nis(estimate: Estimate, change: FloatArray) -> FloatArray:
    """The NIS nu' (S + c c')^-1 nu from nu' S^-1 nu, for a change c of the innovation (Sherman and Morrison)."""
    nis = estimate.nis.copy()
    for axis in np.flatnonzero(nis > 0):
        weighted = np.linalg.lstsq(estimate.innovation_covariance[axis], change[axis], rcond=None)[0]
        nis[axis] -= (weighted @ estimate.innovation[axis]) ** 2 / (1 + weighted @ change[axis])
    return np.maximum(nis, 0.0)
