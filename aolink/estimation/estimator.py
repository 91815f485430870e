"""One estimator on one rig: it predicts over gaps between exposures and makes an `Estimate` of each posterior."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from aolink.errors import EstimatorError
from aolink.estimation.alignment import Shifted, considered, matters, share_of_shift
from aolink.estimation.batch import Batch
from aolink.estimation.estimate import Estimate, Status, as_recorded
from aolink.estimation.frames.measure import MeasuredFrame, Measurements
from aolink.estimation.judge import Judge
from aolink.estimation.kalman.filter import Filter, Posterior
from aolink.estimation.model.base import ExposureModel
from aolink.exposure import Exposure
from aolink.rig import Rig


class Estimator:
    """One estimator on one rig: exposures in, estimates out, in the order in which they come.

    It has no clock and does no input or output: the same exposures give the same estimates, bit for bit. Estimates have
    its ``name``; ``filter`` is that of this rig, such as a `BlurFilter`.
    """

    def __init__(self, rig: Rig, name: str, filter: Filter) -> None:
        self.rig, self.name, self.filter = rig, name, filter
        self.is_multimodal: NDArray[np.bool_] | None = None
        """Axes whose last posterior has several modes (more than one path explains the blur), (axes,); None if the
        filter does not search for modes."""
        self.posterior: Posterior | None = None
        """The filter's last posterior, of an exposure that it took by itself."""
        self.judge: Judge | None = Judge(rig, filter.orders)
        """Judges whether the model fits; None in copies whose estimates are not those that are given."""
        self._next_step: int | None = None
        self._last_input = np.zeros(rig.n_inputs)
        self._copies: tuple[float, list[tuple[Estimator, Shifted]]] | None = None
        # From the first exposure on that needs them, copies with inputs of later and of earlier fast steps, with the
        # share of a standard deviation in their shift.

    def step(self, exposure: Exposure) -> Estimate:
        """The estimate of an exposure, from its frame and all earlier ones."""
        (estimate,) = self.steps(Batch(self.rig, [exposure]))
        return estimate

    def steps(self, batch: Batch) -> Iterator[Estimate]:
        """The estimates of a batch of exposures, one after the other, the same bits as by `step`.

        Raises EstimatorError where the rig has numbers that cannot be computed with.
        """
        try:
            for estimate in self._steps(batch):
                assert self.posterior is not None
                yield estimate if self.judge is None else self.judge.take(estimate, self.posterior.residual)
        except (ArithmeticError, np.linalg.LinAlgError) as error:
            raise EstimatorError(
                f"{self.name} cannot compute with this rig: {error}; are its numbers too large or too small?"
            ) from error

    def _steps(self, batch: Batch) -> Iterator[Estimate]:
        step_ns = self.rig.timing.fast_step_ns
        if self._copies is None:
            for k, exposure in enumerate(batch.exposures):
                if matters(exposure, step_ns):
                    if k:
                        yield from self.steps_as_aligned(Batch(self.rig, batch.exposures[:k]))
                        batch = Batch(self.rig, batch.exposures[k:])
                    share = share_of_shift(exposure, step_ns)
                    shared = {id(part): part for part in (self.rig, self.rig.plant, self.rig.sensor)}
                    both = [(copy.deepcopy(self, dict(shared)), Shifted(each, step_ns)) for each in (share, -share)]
                    for copied, _ in both:
                        copied.judge = None
                    self._copies = share, both
                    break
        made = self.steps_as_aligned(batch)
        if self._copies is None:
            yield from made
            return
        share, both = self._copies
        later, earlier = (each.steps(Batch(self.rig, list(map(shifted, batch.exposures)))) for each, shifted in both)
        yield from considered(batch.exposures, made, later, earlier, share, step_ns)

    def steps_as_aligned(self, batch: Batch) -> Iterator[Estimate]:
        """`steps` as if the exposures' alignment had no error."""
        measured = Measurements(self.rig, batch.exposures, self.filter.needs)
        k = 0
        while k < len(batch.exposures):
            done = self._run(batch, measured, k)
            if done is None:
                yield self._stepped(batch, k, measured[k])
                k += 1
                continue
            for posterior in done:
                exposure = batch.exposures[k]
                self._next_step, self._last_input = exposure.first_step + exposure.n_steps, exposure.inputs[-1]
                yield self._estimate(exposure, batch.model_of(k), posterior, [])
                k += 1

    def _run(self, batch: Batch, measured: Measurements, first: int) -> list[Posterior] | None:
        """Run the filter at once over the exposures from ``first`` to the next gap or flaw; None where it cannot."""
        row, moments = measured.rows[first], measured.moments
        if batch.model is None or moments is None or row < 0:
            return None
        end, next_step = first, self._next_step
        for exposure in batch.exposures[first:]:
            follows = next_step in (None, exposure.first_step) and not len(exposure.lead_inputs)
            if not (follows and batch.finite[end] and measured.rows[end] == row + end - first):
                break
            end, next_step = end + 1, exposure.first_step + exposure.n_steps
        if end == first:
            return None
        axes = self.rig.plant.axes
        responses = batch.responses.of(slice(first * axes, end * axes))
        return self.filter.run(batch.model, responses, measured.some(row, row + end - first))

    def _stepped(self, batch: Batch, k: int, measured: MeasuredFrame) -> Estimate:
        """The estimate of exposure k, which may have gaps and flaws."""
        exposure, model = batch.exposures[k], batch.model_of(k)
        reasons = self._bridge(exposure, batch.finite[k])
        taken, remark = measured
        posterior = self.filter.step(model, batch.response_to(k), taken)
        return self._estimate(exposure, model, posterior, [*([remark] if remark else []), *reasons])

    def _estimate(
        self, exposure: Exposure, model: ExposureModel, posterior: Posterior, reasons: Sequence[str]
    ) -> Estimate:
        self.is_multimodal, self.posterior = posterior.is_multimodal, posterior
        n, covariance = self.rig.plant.n_states, as_recorded(posterior.coefficients.covariance)
        return Estimate(
            estimator=self.name, frame_id=exposure.frame_id, first_step=exposure.first_step, n_steps=exposure.n_steps,
            inputs=exposure.inputs, model=model, status=_worst(posterior.status),
            reason="; ".join([*reasons, *_status_reasons(posterior)]),
            start_state=posterior.start.mean, start_covariance=covariance[:, :n, :n], end_state=posterior.end.mean,
            end_covariance=as_recorded(posterior.end.covariance), coefficients=posterior.coefficients.mean,
            coefficient_covariance=covariance, innovation=posterior.innovation,
            innovation_covariance=posterior.innovation_covariance, nis=posterior.nis,
        )  # fmt: skip

    def _bridge(self, exposure: Exposure, finite: bool) -> list[str]:
        """Predict to the start of an exposure; returns reasons to doubt its step numbers or inputs.

        ``finite`` says whether its inputs are all numbers.
        """
        lead, reasons = exposure.lead_inputs, []
        gap = len(lead) if self._next_step is None else exposure.first_step - self._next_step
        if gap < 0:
            reasons.append(f"it starts at step {exposure.first_step}, before {self._next_step}: taken as the next")
            gap = 0
        elif gap > len(lead):
            reasons.append(f"inputs of {gap - len(lead)} of the {gap} steps before it are not known: held")
            lead = np.concatenate([np.tile(self._last_input, (gap - len(lead), 1)), lead])
        self.filter.bridge(lead[len(lead) - gap :])
        if not (finite and np.isfinite(lead).all()):
            reasons.append("an input is not a number: taken as zero")
        self._next_step = exposure.first_step + exposure.n_steps
        self._last_input = exposure.inputs[-1]
        return reasons


# From good to bad; an estimate has the worst status of its axes.
_BY_GRAVITY = (Status.PREDICTED, Status.OK, Status.REINITIALISED, Status.GATED, Status.DIVERGED, Status.INPUT_INVALID)


def _worst(status: NDArray[np.int64]) -> Status:
    counts = np.bincount(status)
    return max((Status(int(s)) for s in np.flatnonzero(counts)), key=_BY_GRAVITY.index)


def _status_reasons(posterior: Posterior) -> list[str]:
    """The statuses of the axes, and how many have several modes, in words."""
    words = {
        Status.GATED: "too far from the prediction, not used",
        Status.DIVERGED: "too far from the prediction several times in a row: it starts again",
        Status.REINITIALISED: "started again from the plant's own motion, without what earlier frames had shown",
    }
    counts = np.bincount(posterior.status, minlength=len(Status))
    axes = len(posterior.status)
    reasons = []
    for status, text in words.items():
        if counts[status]:
            nis = f"NIS {posterior.nis[posterior.status == status].max():.3g}"
            reasons.append(f"{nis}, {text}" if axes == 1 else f"{counts[status]} of {axes} axes: {nis}, {text}")
    if posterior.is_multimodal is not None and posterior.is_multimodal.any():
        of = "" if axes == 1 else f"{int(posterior.is_multimodal.sum())} of {axes} axes: "
        reasons.append(f"{of}more than one path explains the blur")
    if posterior.remark:
        reasons.append(posterior.remark)
    return reasons
