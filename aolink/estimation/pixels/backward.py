"""Backward simulation over Gaussian mixtures: later exposures correct the path in an earlier one.

Given the start state x of the next exposure, this one is independent of all later measurements. Under component c of
its posterior, coefficients z and x are jointly Gaussian, so x moves them by a gain G_c, and reweights the components:

    w_c(x) ~ a_c N(x; x_c, S_c),    z | x, c ~ N(z_c + G_c (x - x_c), P_c - G_c S_c G_c').

Start states of the last exposure are drawn from its posterior, for each of them one of the exposure before, and so on
to the first: they are drawn from the joint posterior of all exposures (Godsill, Doucet, West, Monte Carlo smoothing for
nonlinear time series, J. Am. Stat. Assoc. 99 (2004)). Mean and covariance of an exposure are those of the mixtures
w_c(x) of all draws, not of draws of z. The draws of its start state are moved and scaled to the same mean and
covariance: where all posteriors are Gaussian, the result is that of Rauch, Tung and Striebel, without any chance in it.

As in the filter, the density of x has a share of one thousandth from the prediction without any measurement, under
which x carries no information about z: where a filter has lost the state and found it again, the past stays as the
filter left it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from aolink.estimation.estimate import Components, Estimate
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, log_sum, single
from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray
from aolink.numerics.covariance import cholesky, lower_inverse, psd_root

_DRAWS = 400
_DOUBT = 1e-3
# Components of less than this weight are left out.
_NEGLIGIBLE = 1e-4


@dataclass(frozen=True, eq=False)
class Next:
    """The start state of the next exposure."""

    transition: FloatArray
    """From the end of this exposure, (n_states, n_states)."""
    noise: FloatArray
    """(n_states, n_states)"""
    kick: FloatArray
    """Response to the inputs in between, (axes, n_states)."""
    unseen: Gaussian
    """Prediction of the next start state without any measurement."""
    draws: FloatArray
    """Draws given all later exposures, (axes, draws, n_states)."""


@dataclass(frozen=True, eq=False)
class Smoothed:
    """One exposure, smoothed with all later ones."""

    joint: Gaussian
    """Coefficients and end state together, (axes, n_coefficients + n_states)."""
    gain: FloatArray
    """Their mean change with the next start state, (axes, n_coefficients + n_states, n_states)."""
    draws: FloatArray
    """Start states, equally likely, (axes, draws, n_states)."""


def smoothed(estimate: Estimate, components: Components, after: Next | None) -> Smoothed:
    """An estimate with its components, corrected by the next exposure, if there is one."""
    each = [_of_axis(estimate, components, after, axis) for axis in range(len(estimate.start_state))]
    mean, covariance, gain, draws = (np.stack(arrays) for arrays in zip(*each, strict=True))
    return Smoothed(Gaussian(mean, covariance), gain, draws)


def _of_axis(
    estimate: Estimate, components: Components, after: Next | None, axis: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mean, covariance, gain and draws of one axis."""
    log_weight, mean, P = _joint(estimate, components, axis)
    n, size = estimate.start_state.shape[1], estimate.coefficients.shape[1]
    rng = np.random.default_rng((estimate.frame_id, axis))
    if after is None:
        weight = np.repeat(np.exp(log_weight - log_sum(log_weight, axis=0))[:, None], _DRAWS, axis=1)
        G, away, given = np.zeros((len(P), size + n, n)), np.zeros((len(P), _DRAWS, n)), P
    else:
        x, A = after.draws[axis], after.transition
        expected = GaussianMixture(
            log_weight[None], (mean[:, size:] @ A.T + after.kick[axis])[None],
            batched.symmetric(A @ P[:, size:, size:] @ A.T + after.noise)[None],
        )  # fmt: skip
        inverse = lower_inverse(cholesky(expected.covariance[0]))
        G = P[:, :, size:] @ A.T @ batched.transpose(inverse) @ inverse
        away = x - expected.mean[0][:, None]
        given = P - G @ expected.covariance[0] @ batched.transpose(G)
        # Each component a second time, with x independent of it.
        unseen = single(after.unseen.part(slice(axis, axis + 1))).log_density(x[None])
        logs = expected.component_log_densities(x[None])[0] + math.log1p(-_DOUBT)
        logs = np.concatenate([logs, log_weight[:, None] + unseen + math.log(_DOUBT)])
        weight = np.exp(logs - log_sum(logs, axis=0))
        mean, given = np.tile(mean, (2, 1)), np.concatenate([given, P])
        G, away = np.concatenate([G, np.zeros_like(G)]), np.tile(away, (2, 1, 1))
    count = weight.shape[1]
    share = weight.sum(axis=1) / count
    moved = batched.matvec(G, (weight[:, None] @ away)[:, 0] / count)
    square = batched.transpose(away) @ (weight[..., None] * away) / count
    whole = share @ mean + moved.sum(axis=0)
    apart = mean - whole
    spread = np.tensordot(share, given, axes=1) + (G @ square @ batched.transpose(G)).sum(axis=0)
    spread += apart.T @ (share[:, None] * apart) + apart.T @ moved + moved.T @ apart
    spread = batched.symmetric(spread)
    total = np.cumsum(weight, axis=0)
    chosen = np.minimum((total < rng.random(count) * total[-1]).sum(axis=0), len(total) - 1)
    root = psd_root(given[:, :n, :n])[chosen]
    start = mean[chosen, :n] + batched.matvec(G[chosen, :n], away[chosen, np.arange(count)])
    start += batched.matvec(root, rng.standard_normal((count, n)))
    return whole, spread, np.tensordot(share, G, axes=1), _with_moments(start, whole[:n], spread[:n, :n])


def _joint(estimate: Estimate, components: Components, axis: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Log-weights of an axis's components, and means and covariances of coefficients and end state together."""
    log_weight, t, P = components.of(axis)
    heavy = log_weight > log_weight.max() + math.log(_NEGLIGIBLE)
    log_weight, t, P = log_weight[heavy], t[heavy], P[heavy]
    model, expand = estimate.model, components.expand
    z, P = t @ expand.T, expand @ P @ expand.T + components.left_out
    if estimate.alignment is not None:  # its second order is not in the components
        whole = GaussianMixture(log_weight[None], z[None], P[None]).gaussian
        P = P + (estimate.coefficient_covariance[axis] - whole.covariance[0])
    rows = np.concatenate([np.eye(len(expand)), model.end_rows])
    mean, covariance = z @ rows.T, rows @ P @ rows.T
    n = len(model.end_rows)
    mean[:, -n:] += estimate.end_state[axis] - model.end_rows @ estimate.coefficients[axis]  # response to the inputs
    covariance[:, -n:, -n:] += model.end_remainder
    return log_weight, mean, covariance


def _with_moments(points: FloatArray, mean: FloatArray, covariance: FloatArray) -> FloatArray:
    """Points (count, n), moved and scaled so that they have this mean and covariance."""
    away = points - points.mean(axis=0)
    own = lower_inverse(cholesky(away.T @ away / len(away)))
    return np.asarray(mean + away @ (cholesky(covariance) @ own).T)
