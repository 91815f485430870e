"""The estimator `profile`: the modes of the posterior of all pixels, carried from exposure to exposure as at most four
Gaussians.

By Laplace's method each mode is a Gaussian, and its evidence a weight. That holds where the path bends the light little
over the mode's own uncertainty. Where a mode is wider than that, as the ring of all phases of a vibration that makes a
whole number of swings in an exposure, its weight is wrong, and so much the more as the same error returns in the next
exposures. So one rule decides: **where the uncertainty of a mode that counts changes the blur by more than its noise
shows, the posterior is the Gaussian of windowed moments**, whose covariance has what the linearisation leaves out, with
its memory (`aolink.estimation.moments.windowed`). No weight is carried on there, and `profile` is `moments`.

Timing, gate and status are those of `BlurFilter`: an exposure corrects the state at its start, a gated frame leaves the
prediction, and after several of them the filter starts again from the prediction without any measurement.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import special

from aolink.estimation.estimate import Status
from aolink.estimation.frames.frame_data import HALF, Needs, Profile, SpotWindows
from aolink.estimation.kalman.filter import (
    GATE_PROBABILITY,
    PATIENCE,
    Filter,
    Posterior,
    gate_status,
    starts_wider,
)
from aolink.estimation.kalman.gaussian import Gaussian, Update
from aolink.estimation.kalman.predict import predict
from aolink.estimation.model.base import ExposureModel, InputResponse, over_steps
from aolink.estimation.model.exposure_model import exposure_model
from aolink.estimation.moments.windowed import WindowedMoments
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, single
from aolink.estimation.pixels.likelihood import PixelView, reduction
from aolink.estimation.pixels.modes import Modes, modes_of, without_repeats
from aolink.numerics.arrays import BoolArray, FloatArray, Indices, IntArray
from aolink.numerics.workers import in_threads, thread_count
from aolink.optics.camera import effective_noise_density
from aolink.optics.sensor import BaseSensor
from aolink.rig import Plant

CARRIED = 4
"""Most Gaussians that go on to the next exposure."""
FREE = 0.01
"""They are merged further while a merger costs less than this, in nats."""
COUNTS = 0.01
"""A mode of a smaller share of the posterior may be wide, ..."""
NEGLIGIBLE = 1e-6
"""... and one of a smaller share than this is dropped."""
REPORTED = 0.05
"""A second mode of this share of the posterior is reported as another path."""
# Largest variance of the prediction without measurements, relative to that of the plant's prior and noise.
_WIDEST = 1e6
# Chunks of axes: what NumPy computes for them together fits into the cache; compiled code has fewer calls to pay for.
_AT_ONCE = 32
_AT_ONCE_COMPILED = 450


class Found(NamedTuple):
    """What a frame shows of some axes."""

    posterior: GaussianMixture
    """Of the reduced coefficients t."""
    moments: Update
    """The update with windowed moments, whose innovation is reported."""
    within_gate: BoolArray
    """Whether the chi-square of pixels and prior together, at the best mode, passes the gate, (axes,)."""
    residual: FloatArray
    """As in `Posterior`, (axes, 2)."""
    log_evidence: FloatArray
    """Log-likelihood of the pixels by Laplace's method, (axes,)."""
    is_multimodal: BoolArray
    """(axes,)"""


class ProfileFilter(Filter):
    """A mixture for each axis, carried from exposure to exposure. ``gate`` says whether frames that are too far from
    their prediction are left out."""

    def __init__(self, plant: Plant, sensor: BaseSensor, *, gate: bool = True) -> None:
        self.plant, self.sensor, self._gate = plant, sensor, gate
        self._moments = WindowedMoments(sensor, plant.n_outputs)
        axes = plant.axes
        start = Gaussian(np.tile(plant.initial_mean, (axes, 1)), np.tile(plant.initial_covariance, (axes, 1, 1)))
        self.prior = single(start)
        # The prediction without any measurement.
        self._from_model_only = start
        self._missed = np.zeros(axes, dtype=np.int64)
        self._begun = np.zeros(axes, dtype=bool)

    def warm_up(self) -> None:
        """Update one axis with a dark exposure, so that what this compiles is compiled before the session."""
        one = slice(0, 1)
        model, outputs, pixels = exposure_model(self.plant, 2), self.plant.n_outputs, self.sensor.profile.pixels
        kind = Profile if outputs == 1 else SpotWindows
        shape = (1, pixels) if outputs == 1 else (1, outputs // 2, pixels, pixels)
        dark = kind(density=np.zeros(shape), mask=np.ones(shape, dtype=bool))
        response = model.response(np.zeros((2, self.plant.n_inputs * self.plant.axes)))
        view = PixelView(self.sensor, model, response, dark, reduction(model, self.sensor))
        two = GaussianMixture(*(np.repeat(each[one], 2, axis=1) for each in self.prior)).weighted(0.5)
        self.found(view.part(one), two)[0].reduced(1)

    @property
    def needs(self) -> Needs:
        return Needs(what="windows" if self.plant.n_outputs > 1 else "profile", least_usable=HALF)

    @property
    def orders(self) -> IntArray:
        return self._moments.moment_orders

    def bridge(self, inputs: FloatArray) -> None:
        if len(inputs):
            transition, noise, kick = over_steps(self.plant, inputs)
            self.prior = self.prior.mapped(transition, noise).moved(kick)
            self._from_model_only = self._unwatched(transition, noise, kick)

    def _unwatched(self, transition: FloatArray, noise: FloatArray, kick: FloatArray) -> Gaussian:
        """The prediction of `_from_model_only`; on an unstable plant it stops once it is so wide that it carries no
        information."""
        now, later = self._from_model_only, predict(self._from_model_only, transition, noise, kick)
        widest = _WIDEST * (np.trace(self.plant.initial_covariance) + np.trace(noise))
        grows = np.isfinite(later.mean).all(axis=1) & (np.einsum("aii->a", later.covariance) <= widest)
        return Gaussian(
            np.where(grows[:, None], later.mean, now.mean),
            np.where(grows[:, None, None], later.covariance, now.covariance),
        )

    def step(self, model: ExposureModel, response: InputResponse, measured: Profile | SpotWindows | None) -> Posterior:
        axes, reduced = self.plant.axes, reduction(model, self.sensor)
        lost = self._missed >= PATIENCE
        again = np.flatnonzero(lost)
        prior = self.prior.replaced(again, single(self._from_model_only.part(again)))
        predicted = reduced.prior(Gaussian(prior.mean, prior.covariance))
        posterior = GaussianMixture(prior.log_weight, predicted.mean, predicted.covariance)
        status = np.full(axes, int(Status.INPUT_INVALID), dtype=np.int64)
        m = 0 if measured is None else self._moments.n_measurements
        innovation, spread, nis = np.zeros((axes, m)), np.zeros((axes, m, m)), np.zeros(axes)
        is_multimodal, log_evidence, residual = np.zeros(axes, bool), np.full(axes, np.nan), np.zeros((axes, 2))
        if measured is not None:
            parts, views = self._parts(model, response, measured, prior)
            done = in_threads(lambda p: self._begin_or_go_on(views[p[0]].part(p), prior.part(p), p), parts)
            if parts:
                seen = np.concatenate(parts)
                for room, values in (
                    (innovation, [each.moments.innovation for each in done]),
                    (spread, [each.moments.innovation_covariance for each in done]),
                    (nis, [each.moments.nis for each in done]),
                    (log_evidence, [each.log_evidence for each in done]),
                    (residual, [each.residual for each in done]),
                ):
                    room[seen] = np.concatenate(values)
                # The pixels' own noise is left out of their likelihoods, being the same at all points of one camera.
                pixels = np.count_nonzero(measured.mask.reshape(axes, -1), axis=1)
                log_evidence -= 0.5 * pixels * math.log(effective_noise_density(self.sensor) / self.sensor.pixel_size)
                trusted = np.concatenate([each.within_gate for each in done]) | (not self._gate)
                self._begun[seen] |= trusted
                status[seen], self._missed[seen] = gate_status(trusted, lost[seen], self._missed[seen])
                new_posterior = GaussianMixture.stacked([each.posterior for each in done])
                posterior = posterior.replaced(seen[trusted], new_posterior.part(np.flatnonzero(trusted)))
                is_multimodal[seen] = trusted & np.concatenate([each.is_multimodal for each in done])
        after = posterior.mapped(reduced.end_rows, reduced.end_remainder).moved(response.end)
        self.prior = after.reduced(CARRIED, FREE)
        self._from_model_only = self._unwatched(model.transition, model.process_noise, response.end)
        return Posterior(
            coefficients=reduced.coefficients(posterior.gaussian), end=after.gaussian, status=status,
            innovation=innovation, innovation_covariance=spread, nis=nis, is_multimodal=is_multimodal,
            log_evidence=log_evidence, residual=residual,
        )  # fmt: skip

    def _parts(
        self, model: ExposureModel, response: InputResponse, measured: Profile | SpotWindows, prior: GaussianMixture
    ) -> tuple[list[Indices], dict[int, PixelView]]:
        """Axes that are computed together, and the view of each part by its first axis.

        Each axis gets the nodes in time that its own predicted path needs, whatever the other axes need.
        """
        reduced = reduction(model, self.sensor)
        usable = np.arange(self.plant.axes) if measured.usable is None else np.flatnonzero(measured.usable)
        level = reduced.resolution.of(model.seen_path(model.path(prior.gaussian.mean, response.path)))
        parts, views = [], {}
        for k in np.unique(level[usable]).tolist():
            view, alike = PixelView(self.sensor, model, response, measured, reduced, k), usable[level[usable] == k]
            at_once = min(_AT_ONCE_COMPILED if view.on_line else _AT_ONCE, -(-len(alike) // thread_count()))
            for j in range(0, len(alike), at_once):
                parts.append(alike[j : j + at_once])
                views[int(alike[j])] = view
        return parts, views

    def _begin_or_go_on(self, view: PixelView, prior: GaussianMixture, axes: Indices) -> Found:
        done = self.found(view, prior)
        assert done.moments.gate is not None
        m = self._moments.n_measurements
        factor = starts_wider(~(self._begun[axes] | done.within_gate), done.moments.gate, m, m) if self._gate else None
        if factor is None:
            return done
        return self.found(view, prior._replace(covariance=prior.covariance * factor[:, None, None, None]))

    def found(self, view: PixelView, prior: GaussianMixture) -> Found:
        """The posterior of some axes."""
        moments = self._by_moments(view, view.reduced.prior(prior.gaussian))
        modes = self._modes(view, prior, moments.posterior)
        log_share = modes.log_evidence - modes.total_evidence[:, None]
        bent = view.blur_of(modes.covariance) > view.reduced.least_blur
        wide = np.flatnonzero((bent & (log_share > math.log(COUNTS))).any(axis=1))
        log_share = np.where(log_share > math.log(NEGLIGIBLE), log_share, -np.inf)
        posterior = GaussianMixture(log_share, modes.mean, modes.covariance).ordered()
        posterior = posterior.replaced(wide, single(moments.posterior.part(wide)))
        best, pixels = (np.arange(len(view.y)), modes.best), np.count_nonzero(view.mask, axis=1)
        # At the truth it is chi-square of all pixels and coefficients, and where the objective is least it is less.
        most = 2 * special.gammainccinv((pixels + view.reduced.size) / 2, GATE_PROBABILITY)
        return Found(
            posterior, moments, modes.total[best] <= most, np.stack([modes.residual[best], pixels], axis=1),
            modes.total_evidence, (log_share > math.log(REPORTED)).sum(axis=1) > 1,
        )  # fmt: skip

    def _by_moments(self, view: PixelView, prior: Gaussian) -> Update:
        return self._moments.updated(view.dynamics, view.moment_nodes, prior, view.measured)

    def _modes(self, view: PixelView, prior: GaussianMixture, by_moments: Gaussian) -> Modes:
        """The modes for each component of the start state's prior; their log-evidence includes the components' weights.

        The heaviest component is searched at length, the others from one start each.
        """
        before = view.reduced.prior(Gaussian(prior.mean, prior.covariance))
        axes, count, _ = before.mean.shape
        there = np.nonzero(np.isfinite(prior.log_weight))
        rows, own = view.part(there[0]), Gaussian(before.mean[there], before.covariance[there])
        wide = by_moments if count == 1 else self._by_moments(rows, own).posterior
        heaviest = np.argmax(prior.log_weight, axis=1)[there[0]] == there[1]
        found = modes_of(rows, own, wide, heaviest)
        found = found._replace(log_evidence=found.log_evidence + prior.log_weight[there][:, None])
        if count == 1:
            return without_repeats(found)
        modes = Modes.none(axes, count * found.mean.shape[1], found.mean.shape[2])
        for room, each in zip(modes, found, strict=True):
            room.reshape(axes, count, *each.shape[1:])[there] = each
        return without_repeats(modes)
