"""The smoother: later exposures correct the estimates of earlier ones.

An exposure's coefficients and its end state are jointly Gaussian, cov(z, end) = P E', E the rows of the end state, and
between exposures the state goes on by the plant's transition A_g over the gap. So Rauch, Tung and Striebel's
recursion runs from start state to start state and unfolds into paths: with x the next start, its prediction N(x-, P-)
and all that is known of it N(x+, P+),

    G = P E' A_g' P-^-1,    z <- z + G (x+ - x-),    P <- P + G (P+ - P-) G'.

Rauch, Tung, Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA J. 3 (1965), (3.30) to (3.32).
The posteriors are those of the estimator: its approximations remain in the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aolink.errors import EstimatorError
from aolink.estimation.estimate import AlignmentError, Estimate, Status
from aolink.estimation.judge import scaled
from aolink.estimation.model.base import over_steps
from aolink.exposure import Exposure
from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray
from aolink.plant.lifting import lift
from aolink.rig import Plant


def smooth(
    plant: Plant, exposures: Sequence[Exposure], estimates: Sequence[Estimate], lag: int | None = None
) -> list[Estimate]:
    """Estimates of one estimator, each corrected by later exposures.

    Parameters
    ----------
    plant:
        The plant of the rig that they are from.
    exposures, estimates:
        One estimate for each exposure, in the order of time.
    lag:
        Number of later exposures that correct each (fixed lag); None: all of them (fixed interval).

    Returns
    -------
    The same with other states, coefficients, paths and covariances; status, innovation and NIS stay the filter's.
    Where a filter started again, later exposures do not correct earlier ones.

    Raises
    ------
    EstimatorError
        The estimates are not those of the exposures, or the lag is negative.
    """
    if [e.frame_id for e in estimates] != [e.frame_id for e in exposures]:
        raise EstimatorError(
            f"{len(estimates)} estimates for {len(exposures)} exposures, or for other frames of the same number:"
            " give one for each, in their order"
        )
    if lag is None:
        return _backward(plant, exposures, estimates)
    if lag < 0:
        raise EstimatorError(f"lag = {lag}: give the number of later exposures, 0 or more, or None for all")
    windows = (slice(k, k + lag + 1) for k in range(len(estimates)))
    return [_backward(plant, exposures[some], estimates[some])[0] for some in windows]


def _backward(plant: Plant, exposures: Sequence[Exposure], estimates: Sequence[Estimate]) -> list[Estimate]:
    """Each estimate corrected by all later ones of the series."""
    # Process noise is never widened: the intervals are again as wide as the verdict has them afterwards.
    factors = [1.0 if each.verdict is None else each.verdict.widening for each in estimates]
    estimates = [each if f == 1 else scaled(each, 1 / f) for each, f in zip(estimates, factors, strict=True)]
    smoothed: list[Estimate] = []
    for k in reversed(range(len(estimates))):
        estimate = estimates[k]
        if smoothed and smoothed[-1].status != Status.REINITIALISED:
            estimate = _corrected(plant, exposures[k], estimate, exposures[k + 1], smoothed[-1])
        smoothed.append(estimate)
    pairs = zip(reversed(smoothed), factors, strict=True)
    return [each if f == 1 else scaled(each, f) for each, f in pairs]


def _corrected(
    plant: Plant, exposure: Exposure, estimate: Estimate, next_exposure: Exposure, later: Estimate
) -> Estimate:
    """An estimate of the filter, corrected by ``later``, the smoothed estimate of the next exposure."""
    model = estimate.model
    z, P = estimate.coefficients, estimate.coefficient_covariance
    end, P_end, alignment = estimate.end_state, estimate.end_covariance, estimate.alignment
    if alignment is not None:  # it is not noise, and later frames have it too: it is kept apart
        P_end = P_end - alignment.added_to(np.zeros_like(P_end), "end_state")
    E = model.transition if z.shape[1] == plant.n_states else model.end_rows
    transition, noise, kick = _gap(plant, exposure, next_exposure)
    predicted = batched.matvec(transition, end) + kick
    spread = batched.symmetric(batched.congruence(transition, P_end) + noise)
    n = plant.n_states
    innovation, change = later.start_state - predicted, later.coefficient_covariance[:, :n, :n] - spread
    # A state that is known for certain has no inverse, and needs none.
    inverse: FloatArray = np.linalg.pinv(spread, hermitian=True).astype(np.float64)

    def corrected(mean: FloatArray, covariance: FloatArray, gain: FloatArray) -> tuple[FloatArray, FloatArray]:
        after = batched.symmetric(covariance + batched.congruence(gain, change))
        return mean + batched.matvec(gain, innovation), _without_negative(after)

    to_next = batched.transpose(transition @ E)
    gain = batched.matmul(batched.matmul(P, np.broadcast_to(to_next, (len(P), *to_next.shape))), inverse)
    end_gain = batched.matmul(batched.matmul(P_end, np.broadcast_to(transition.T, P_end.shape)), inverse)
    z, P = corrected(z, P, gain)
    end, P_end = corrected(end, P_end, end_gain)
    P_start = P[:, :n, :n]
    if alignment is not None and later.alignment is not None:
        moved = later.alignment.coefficients[:, :n] - batched.matvec(transition, alignment.end_state)
        alignment = AlignmentError(
            alignment.steps,
            alignment.coefficients + batched.matvec(gain, moved),
            alignment.end_state + batched.matvec(end_gain, moved),
        )
    if alignment is not None:
        P_start, P_end = alignment.added_to(P_start, "coefficients"), alignment.added_to(P_end, "end_state")
    return replace(
        estimate, start_state=z[:, :n], start_covariance=P_start, end_state=end, end_covariance=P_end, coefficients=z,
        coefficient_covariance=P, alignment=alignment,
    )  # fmt: skip


def _gap(plant: Plant, before: Exposure, after: Exposure) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Transition, noise and response to the inputs of the fast steps between two exposures."""
    steps = max(0, after.first_step - before.first_step - before.n_steps)
    if not steps:
        return *lift(plant, 0), np.zeros((plant.axes, plant.n_states))
    known = after.lead_inputs[-steps:]
    held = np.tile(before.inputs[-1], (steps - len(known), 1))
    return over_steps(plant, np.concatenate([held, known]))


def _without_negative(covariance: FloatArray) -> FloatArray:
    """The nearest covariance without negative eigenvalues, which rounding makes where variances are tiny."""
    values, vectors = np.linalg.eigh(covariance)
    return batched.symmetric(batched.matmul(vectors * np.maximum(values, 0.0)[:, None], batched.transpose(vectors)))
