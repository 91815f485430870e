"""A Gaussian-sum filter: the recursion from exposure to exposure carries a Gaussian mixture.

Timing, gate and status are those of `BlurFilter`: an exposure corrects the state at its start, a gated measurement
leaves the prediction, and after several of them the filter starts again from the prediction without any measurement.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from aolink.estimation.compiled.modes import drop_repeats
from aolink.estimation.estimate import Status
from aolink.estimation.frames.frame_data import HALF, Needs, Profile, SpotWindows
from aolink.estimation.kalman.filter import PATIENCE, Filter, Posterior, gate_status
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.kalman.predict import predict
from aolink.estimation.model.base import ExposureModel, InputResponse, over_steps
from aolink.estimation.model.exposure_model import exposure_model
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, joined, single
from aolink.estimation.pixels.likelihood import PixelView, Reduction
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.numerics.workers import in_threads, thread_count
from aolink.optics.camera import effective_noise_density
from aolink.optics.sensor import BaseSensor
from aolink.rig import Plant

# Largest variance of the prediction without measurements, relative to that of the plant's prior and noise.
_WIDEST = 1e6
# Chunks of axes: what NumPy computes for them together fits into the cache; compiled code has fewer calls to pay for.
_AT_ONCE = 32
_AT_ONCE_COMPILED = 450


class Innovation(NamedTuple):
    """Innovation of the pixels, in the directions in which the prior lets them vary most."""

    value: FloatArray
    """(axes, k)"""
    covariance: FloatArray
    """(axes, k, k)"""
    nis: FloatArray
    """(axes,)"""
    within_gate: BoolArray
    """Whether the chi-square of pixels and prior together passes the gate, (axes,)."""


@dataclass(frozen=True, eq=False)
class MixtureUpdate:
    """The posterior after a frame."""

    posterior: GaussianMixture
    """The posterior of the reduced coefficients t."""
    coefficients: Gaussian
    """Its mean and covariance."""
    end: GaussianMixture
    """The posterior of the state at the exposure's end, without the response to the inputs."""
    innovation: Innovation
    log_evidence: FloatArray
    """Log-likelihood of the pixels, (axes,)."""
    several: BoolArray
    """Whether the posterior has several modes (more than one path explains the blur), (axes,)."""
    poor: BoolArray
    """Whether too few points of importance sampling count for it, so that it is wider, (axes,)."""


class MixtureUpdater(Protocol):
    """A way to update a mixture with the pixels of an exposure."""

    def reduction(self, model: ExposureModel, sensor: BaseSensor) -> Reduction:
        """The coefficients that it works with."""

    def update(self, view: PixelView, prior: GaussianMixture, unseen: Gaussian) -> MixtureUpdate:
        """The posterior of axes with a prior of their start states.

        ``unseen`` is the prediction of the start states without any measurement.
        """


class MixtureFilter(Filter):
    """A mixture for each axis, carried from exposure to exposure: ``updater`` updates it with a frame. ``gate`` says
    whether frames that are too far from their prediction are left out."""

    def __init__(self, plant: Plant, sensor: BaseSensor, updater: MixtureUpdater, *, gate: bool = True) -> None:
        self.plant, self.sensor, self._updater, self._gate = plant, sensor, updater, gate
        axes = plant.axes
        start = Gaussian(np.tile(plant.initial_mean, (axes, 1)), np.tile(plant.initial_covariance, (axes, 1, 1)))
        self.prior = single(start)
        # The prediction without any measurement.
        self._unseen = self.prior.gaussian
        self._missed = np.zeros(axes, dtype=np.int64)

    def warm_up(self, updater: MixtureUpdater) -> None:
        """Update one axis with a dark exposure, so that what this compiles is compiled before the session."""
        one = slice(0, 1)
        twice = joined(self.prior.part(one), self.prior.part(one))
        twice.reduced(1)
        drop_repeats(twice.mean, twice.covariance, 1.0, *(np.zeros((1, 2)) for _ in range(3)))
        model, outputs, pixels = exposure_model(self.plant, 2), self.plant.n_outputs, self.sensor.profile.pixels
        kind = Profile if outputs == 1 else SpotWindows
        shape = (1, pixels) if outputs == 1 else (1, outputs // 2, pixels, pixels)
        dark = kind(density=np.zeros(shape), mask=np.ones(shape, dtype=bool))
        response = model.response(np.zeros((2, self.plant.n_inputs * self.plant.axes)))
        view = PixelView(self.sensor, model, response, dark, updater.reduction(model, self.sensor))
        updater.update(view.part(one), self.prior.part(one), self._unseen.part(one))

    @property
    def needs(self) -> Needs:
        return Needs(what="windows" if self.plant.n_outputs > 1 else "profile", least_usable=HALF)

    def bridge(self, inputs: FloatArray) -> None:
        if len(inputs):
            over = over_steps(self.plant, inputs)
            self.prior, self._unseen = _moved(self.prior, *over), self._unwatched(*over)

    def _unwatched(self, transition: FloatArray, noise: FloatArray, kick: FloatArray) -> Gaussian:
        """The prediction of `_unseen`; on an unstable plant it stops once it is so wide that it carries no
        information."""
        now, later = self._unseen, predict(self._unseen, transition, noise, kick)
        widest = _WIDEST * (np.trace(self.plant.initial_covariance) + np.trace(noise))
        grows = np.isfinite(later.mean).all(axis=1) & (np.einsum("aii->a", later.covariance) <= widest)
        return Gaussian(
            np.where(grows[:, None], later.mean, now.mean),
            np.where(grows[:, None, None], later.covariance, now.covariance),
        )

    def step(self, model: ExposureModel, response: InputResponse, measured: Profile | SpotWindows | None) -> Posterior:
        axes = self.plant.axes
        reduced = self._updater.reduction(model, self.sensor)
        lost = self._missed >= PATIENCE
        prior = _chosen(lost, single(self._unseen), self.prior)
        status = np.full(axes, int(Status.INPUT_INVALID), dtype=np.int64)
        new = _spread([], np.zeros(0, dtype=np.intp), axes)
        several, poor = np.zeros(axes, dtype=bool), np.zeros(axes, dtype=bool)
        log_evidence = np.full(axes, np.nan)
        done: list[MixtureUpdate] = []
        likeliest = np.zeros((axes, reduced.size))
        took = np.zeros(0, dtype=np.intp)
        if measured is not None:
            usable = np.arange(axes) if measured.usable is None else np.flatnonzero(measured.usable)
            # Each axis gets the nodes that its own path needs, whatever the other axes need.
            level = reduced.resolution.of(model.seen_path(model.path(prior.gaussian.mean, response.path)))
            views, parts = {}, []
            for k in np.unique(level[usable]).tolist():
                views[k] = PixelView(self.sensor, model, response, measured, reduced, k)
                alike = usable[level[usable] == k]
                at_once = _AT_ONCE_COMPILED if views[k].on_line else _AT_ONCE
                at_once = min(at_once, -(-len(alike) // thread_count()))
                parts += [alike[j : j + at_once] for j in range(0, len(alike), at_once)]
            seen = np.concatenate([usable[:0], *parts])

            def updated(p: Indices) -> MixtureUpdate:
                view = views[int(level[p[0]])].part(p)
                u = self._updater.update(view, prior.part(p), self._unseen.part(p))
                return replace(u, coefficients=reduced.coefficients(u.coefficients))

            done = in_threads(updated, parts)
            for p, each in zip(parts, done, strict=True):
                likeliest[p] = each.posterior.likeliest
            new = _spread([each.innovation for each in done], seen, axes)
            log_evidence[seen] = np.concatenate([log_evidence[:0], *(each.log_evidence for each in done)])
            # The pixels' own noise is left out of their likelihoods, being the same at all points of one camera.
            pixels = np.count_nonzero(measured.mask.reshape(axes, -1), axis=1)
            log_evidence -= 0.5 * pixels * math.log(effective_noise_density(self.sensor) / self.sensor.pixel_size)
            trusted = new.within_gate[seen] | (not self._gate)
            took = seen[trusted]
            status[seen], self._missed[seen] = gate_status(trusted, lost[seen], self._missed[seen])
        if not np.array_equal(took, np.arange(axes)):
            coefficients = reduced.coefficients(reduced.prior(prior.gaussian))
            end = _moved(prior, model.transition, model.process_noise, response.end)
            rest = np.setdiff1d(np.arange(axes), took)
            likeliest[rest] = 0.0
            likeliest[rest, : self.plant.n_states] = prior.part(rest).likeliest
        if len(took):
            most = max(each.end.mean.shape[1] for each in done)
            after = [np.concatenate(each) for each in zip(*(_arrays(d, most) for d in done), strict=True)]
            if len(took) < len(trusted):
                after = [each[trusted] for each in after]
            kicked = GaussianMixture(after[0], after[1] + response.end[took][:, None], after[2])
            several[took], poor[took] = after[5], after[6]
            if np.array_equal(took, np.arange(axes)):
                coefficients, end = Gaussian(after[3], after[4]), kicked
            else:
                coefficients.mean[took], coefficients.covariance[took] = after[3], after[4]
                end = end.replaced(took, kicked)
        self.prior = end
        self._unseen = self._unwatched(model.transition, model.process_noise, response.end)
        return Posterior(
            coefficients=coefficients, end=end.gaussian, status=status, innovation=new.value,
            innovation_covariance=new.covariance, nis=new.nis, several=several,
            remark=_remark(poor), log_evidence=log_evidence, likeliest=likeliest,
        )  # fmt: skip


def _remark(poor: BoolArray) -> str:
    of = "" if len(poor) == 1 else f"{int(poor.sum())} of {len(poor)} axes: "
    return f"{of}too few of the paths tried fit the blur: the estimate is wider for it" if poor.any() else ""


def _arrays(done: MixtureUpdate, components: int) -> tuple[NDArray[Any], ...]:
    e, c = done.end.with_components(components), done.coefficients
    return (e.log_weight, e.mean, e.covariance, c.mean, c.covariance, done.several, done.poor)


def _spread(parts: Sequence[Innovation], seen: Indices, axes: int) -> Innovation:
    """Innovations of these axes in their places; zero, with a covariance of zero, for the others."""
    k = parts[0].value.shape[1] if parts else 0
    out = Innovation(np.zeros((axes, k)), np.zeros((axes, k, k)), np.zeros(axes), np.zeros(axes, dtype=bool))
    for room, *each in zip(out, *parts, strict=True) if parts else ():
        room[seen] = np.concatenate(each)
    return out


def _moved(h: GaussianMixture, transition: FloatArray, noise: FloatArray, kick: FloatArray) -> GaussianMixture:
    """x -> A x + d, P -> A P A' + Q for each component."""
    after = h.mapped(transition, noise)
    return after._replace(mean=after.mean + kick[:, None])


def _chosen(which: BoolArray, first: GaussianMixture, second: GaussianMixture) -> GaussianMixture:
    rows = np.flatnonzero(which)
    return second.replaced(rows, first.part(rows)) if len(rows) else second
