"""What the pixels of an exposure say about the model: residuals at the path that fits them best.

An estimate's mean path is misleading where a blur is ambiguous, so the residuals are taken at a mode: few coefficients
are fitted to the pixels from the estimate on, with a prior so wide that any path of the plant is as good as another.
How large they are at a mode depends on how curved the likelihood is there, and the same fit of a frame that is drawn
from the fitted path has the same share of it. So residuals are counted as what they are more than those of such a frame
(parametric bootstrap: Efron & Tibshirani, An introduction to the bootstrap (1993), 10). Its random numbers follow from
the frame's pixels: the same exposures give the same bits.
"""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np

from aolink.estimation.estimate import Estimate
from aolink.estimation.frames.frame_data import HALF, Needs, Profile
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.quadrature import quadrature_paths
from aolink.estimation.pixels.likelihood import Reduction, reduction
from aolink.exposure import Exposure
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.optics.camera import effective_noise_density, shot_gain
from aolink.optics.kernel import gaussian_below
from aolink.optics.sensor import Sensor
from aolink.rig import Rig

SIGNATURES = ("width", "light", "background", "fade", "ends")
"""Changes of the frame that residuals are compared with: a wider kernel, more light, a background, light that moves
from the exposure's end to its start, and from its middle to both ends."""
_NEEDS = Needs(what="profile", least_usable=HALF)
_PASSES = 8
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-3, 1e4
_CONVERGED = 0.02
_NOTHING_NEW = 1e-3
_UNMET = 0.5
"""Mean squared residual beyond the noise at which a fit to a frame drawn counts as failed."""


class Residuals(NamedTuple):
    """Of some axes of one exposure, together."""

    excess: float
    """Sum of the squared residuals, in variances of the pixels' noise, less that of a frame drawn from the fit."""
    pixels: int
    """Number of pixels."""
    signatures: FloatArray
    """Product of the residuals with each of `SIGNATURES`, less that of the frame drawn, (5,)."""
    static: FloatArray
    """Residuals of the pixels, zero where none was used, (rows, pixels)."""
    position: FloatArray
    """What the pixels change of the path's mean as predicted from the exposure before, white where the model is right,
    (n,)."""


def residuals(
    rig: Rig, exposure: Exposure, estimate: Estimate, before: Gaussian | None, axes: Indices,
    likeliest: FloatArray | None = None,
) -> Residuals | None:  # fmt: skip
    """The residuals of some axes of an exposure, or None where its pixels cannot be used.

    ``before`` is the prediction of the start states of all axes. A fit begins at the ``likeliest`` reduced coefficients
    of all axes, or else at the estimate's mean.
    """
    plant, model = rig.plant, estimate.model
    measured = None if exposure.slopes is not None else measure(rig, exposure, _NEEDS)[0]
    if not isinstance(measured, Profile) or measured.light is not None:
        return None
    density = measured.density.reshape(plant.axes, plant.n_outputs, -1)
    mask = measured.mask.reshape(density.shape)
    usable = np.broadcast_to(True if measured.usable is None else measured.usable, (plant.axes,))
    axes = axes[usable[axes] & (estimate.nis[axes] > 0)]
    if not len(axes):
        return None
    fit = _Fit(rig.sensor.profile, reduction(model, rig.sensor), estimate, axes)
    y, seen = density[axes], mask[axes]
    z = estimate.coefficients[axes]
    start = z @ fit.reduced.expand[: z.shape[1]] if likeliest is None else likeliest[axes]
    spread = plant.initial_covariance + model.process_noise + estimate.start_covariance[axes]
    wide = fit.reduced.prior(Gaussian(estimate.start_state[axes], spread))
    fitted = fit.to(y, seen, start, wide)
    noise = np.where(seen, np.random.default_rng(zlib.crc32(exposure.pixels.tobytes())).standard_normal(y.shape), 0.0)
    drawn = np.where(seen, fitted.light + fitted.sd * noise, 0.0)
    again = fit.to(drawn, seen, start, wide)
    signatures = fit.signatures(fitted) - fit.signatures(again)
    position = np.zeros(0)
    if before is not None:
        position = fit.position(fitted, fit.reduced.prior(before.part(axes)))
    # The noise itself is known there, and left out of the difference.
    absorbed = float((noise**2).sum() - (again.residual**2).sum())
    if absorbed < -_UNMET * int(seen.sum()):
        return None  # a fit from there does not even find the path of the frame drawn
    excess = float((fitted.residual**2).sum()) - int(seen.sum()) + absorbed
    return Residuals(excess, int(seen.sum()), signatures, fitted.residual.reshape(-1, y.shape[-1]), position)


class _Fitted(NamedTuple):
    t: FloatArray
    """(axes, n)"""
    path: FloatArray
    """At the nodes, (axes, outputs, nodes)."""
    light: FloatArray
    """Expected densities, (axes, outputs, pixels)."""
    sd: FloatArray
    """Their noise."""
    residual: FloatArray
    """In that noise; zero where a pixel is masked."""
    slope: FloatArray
    """Derivative of the expected pixels by t, in their noise, (axes, outputs * pixels, n)."""
    information: FloatArray
    """(axes, n, n), the prior's included."""


class _Fit:
    """Fits paths to the pixels of some axes."""

    def __init__(self, line: Sensor, reduced: Reduction, estimate: Estimate, axes: Indices) -> None:
        self.line, self.reduced = line, reduced
        response = estimate.model.response(estimate.inputs)
        levels = reduced.resolution.levels
        level = int(reduced.resolution.of(response.path[axes]).max(initial=0)) if response.path.any() else 0
        at = quadrature_paths(estimate.model, response, levels[level])
        self.basis, self.weights, self.inputs = at.basis @ reduced.expand, at.weights, at.inputs[axes]
        outputs = range(self.basis.shape[0])
        self.variance = np.array([float(self.line.kernel.variance + reduced.widening) for _ in outputs])[:, None]
        self.read_noise = effective_noise_density(line) / line.pixel_size
        self.gain = shot_gain(line)

    def to(self, y: FloatArray, seen: BoolArray, t: FloatArray, prior: Gaussian) -> _Fitted:
        """The mode that a start leads to, by Levenberg and Marquardt's method."""
        precision = np.asarray(np.linalg.pinv(prior.covariance, hermitian=True), np.float64)
        now, objective = self._at(y, seen, t, prior.mean, precision)
        damping = np.full(len(t), _FIRST_DAMPING)
        diagonal = np.eye(t.shape[1])
        for _ in range(_PASSES):
            pull = np.einsum("apn,ap->an", now.slope, now.residual.reshape(len(t), -1))
            pull -= np.einsum("aij,aj->ai", precision, now.t - prior.mean)
            damped = now.information * (1 + damping[:, None, None] * diagonal)
            step = np.linalg.solve(damped, pull[..., None])[..., 0]
            if ((step * pull).sum(axis=1) < _CONVERGED).all() and (damping <= _FIRST_DAMPING).all():
                break
            there, reached = self._at(y, seen, now.t + step, prior.mean, precision)
            better = reached < objective
            damping = np.where(better, damping / 8, 8 * np.maximum(damping, _FIRST_DAMPING))
            done = bool((np.where(better, objective - reached, 1.0) < _CONVERGED).all())
            if better.all():
                now, objective = there, reached
            elif better.any():
                pairs = zip(there, now, strict=True)
                now = _Fitted(*(np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))
                objective = np.where(better, reached, objective)
            if done or (damping > _LARGEST_DAMPING).all():
                break
        return now

    def _at(
        self, y: FloatArray, seen: BoolArray, t: FloatArray, mean: FloatArray, precision: FloatArray
    ) -> tuple[_Fitted, FloatArray]:
        path = self.inputs + np.einsum("okn,an->aok", self.basis, t)
        masses, slopes = self._masses(path, 1)
        light = np.einsum("k,aokp->aop", self.weights, masses)
        sd = np.sqrt(self.read_noise + self.gain * np.maximum(light, 0.0))
        residual = np.where(seen, (y - light) / sd, 0.0)
        weighted = self.weights[:, None] * self.basis
        slope = np.matmul(slopes.swapaxes(-1, -2), weighted) * np.where(seen, 1 / sd, 0.0)[..., None]
        slope = slope.reshape(len(t), -1, t.shape[1])
        information = np.matmul(slope.swapaxes(1, 2), slope) + precision
        away = t - mean
        objective = (residual**2).sum(axis=(1, 2)) + np.einsum("ai,aij,aj->a", away, precision, away)
        return _Fitted(t, path, light, sd, residual, slope, information), objective

    def _masses(self, path: FloatArray, highest: int) -> list[FloatArray]:
        """Densities of the pixels at each node, (axes, outputs, nodes, pixels), and derivatives by the position."""
        below = gaussian_below(self.variance, self.line.edges, path, highest)
        return [np.diff(each, axis=-1) / self.line.pixel_size for each in below]

    def signatures(self, fitted: _Fitted) -> FloatArray:
        """Products of the residuals with `SIGNATURES`, each as long as the light, (5,)."""
        masses, _, bent = self._masses(fitted.path, 2)
        time = np.cumsum(self.weights) - self.weights / 2
        time = 2 * time / self.weights.sum() - 1
        shapes = (
            self.variance * np.einsum("k,aokp->aop", self.weights, bent), fitted.light,
            np.full_like(fitted.light, fitted.light.mean()),
            np.einsum("k,aokp->aop", -self.weights * time, masses),
            np.einsum("k,aokp->aop", self.weights * (3 * time**2 - 1), masses),
        )  # fmt: skip
        return np.array([float((each / fitted.sd * fitted.residual).sum()) for each in shapes])

    def position(self, fitted: _Fitted, before: Gaussian) -> FloatArray:
        """Change of the mean path by the pixels, from its prediction, white where the model is right, (n,)."""
        rows = np.einsum("k,okn->on", self.weights, self.basis)
        seen = np.matmul(fitted.slope.swapaxes(1, 2), fitted.slope)
        new = np.einsum("apn,ap->an", fitted.slope, fitted.residual.reshape(len(seen), -1))
        new += np.einsum("aij,aj->ai", seen, fitted.t - before.mean)
        # The Kalman update in information form: what the pixels change of the prediction, and the variance of that.
        n = seen.shape[-1]
        after = np.linalg.solve(np.eye(n) + before.covariance @ seen, before.covariance)
        away = np.einsum("oi,aij,aj->ao", rows, after, new)
        spread = np.einsum("oi,aij,pj->aop", rows, before.covariance - after, rows)
        prior = np.einsum("oi,aij,oj->a", rows, before.covariance, rows)
        # The pixels may say nothing that was not known.
        known = np.linalg.eigvalsh((spread + spread.swapaxes(1, 2)) / 2)[:, 0] > _NOTHING_NEW * prior
        root = np.linalg.cholesky(spread[known])
        return np.linalg.solve(root, away[known][..., None]).ravel()
