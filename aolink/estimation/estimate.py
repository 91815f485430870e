"""The class `Estimate`: the result of an estimator for one exposure; and sums of its outputs."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Literal

import numpy as np

from aolink.estimation.model.base import ExposureModel
from aolink.estimation.model.exposure_model import path_of, path_sd_of
from aolink.estimation.verdict import Verdict
from aolink.numerics.arrays import FloatArray
from aolink.numerics.covariance import from_correlation_steps, in_correlation_steps, psd_root
from aolink.plain import plain_data


class Status(enum.IntEnum):
    """The use of the measurement in an estimate. The numbers are those of the recording's schema."""

    OK = 0
    """The measurement was used."""
    GATED = 1
    """The measurement was too far from its prediction and was not used."""
    DIVERGED = 2
    """Several measurements in a row were gated: the filter no longer trusts its own covariance."""
    REINITIALISED = 3
    """The filter started again from the plant's prior."""
    INPUT_INVALID = 4
    """The exposure could not be used, or not for some axes; the reason says why. These axes are predicted."""
    PREDICTED = 5
    """The estimator takes no measurements (`open-loop`)."""


@dataclass(frozen=True, eq=False)
class AlignmentError:
    """The change of an estimate by one standard deviation of the exposure's alignment with the mirror's steps.

    The error comes from the clocks' comparison: neighbouring exposures, and all axes, have it in common.
    """

    steps: float
    """The standard deviation, fast steps; positive for an exposure that starts later than it is said to."""
    coefficients: FloatArray
    """Change of the coefficients, (axes, n_coefficients)."""
    end_state: FloatArray
    """Change of the end state, (axes, n_states)."""

    def added_to(self, covariance: FloatArray, name: Literal["coefficients", "end_state"]) -> FloatArray:
        """A covariance (axes, n, n) of the first n of these numbers, with this error in it."""
        change = getattr(self, name)[:, : covariance.shape[-1]]
        return np.asarray(covariance + change[:, :, None] * change[:, None, :])


@plain_data
class Estimate:
    """Start state, end state and path of one exposure, with their covariances.

    The three are jointly Gaussian. The path is kept as coefficients of the exposure basis
    (`aolink.estimation.ExposureModel.basis`): path = basis @ coefficients + response to the inputs. It is computed
    when it is first read: for 1800 axes that takes longer than the estimation. The arrays must not be changed.
    """

    estimator: str
    frame_id: int
    first_step: int
    n_steps: int
    status: Status
    reason: str
    """The reason why the status is not OK, the data that the estimate lacked, and what to know of the posterior (it has
    several modes, or was made in another than the usual way); otherwise empty."""
    start_state: FloatArray
    """State at the exposure's first fast step, (axes, n_states)."""
    start_covariance: FloatArray
    """(axes, n_states, n_states)"""
    end_state: FloatArray
    """State one fast step after the exposure's last, from which control goes on, (axes, n_states)."""
    end_covariance: FloatArray
    """(axes, n_states, n_states)"""
    coefficients: FloatArray
    """Coefficients of the exposure basis; the first n_states are the start state, (axes, n_coefficients)."""
    coefficient_covariance: FloatArray
    """(axes, n_coefficients, n_coefficients); without the error of the exposure's alignment except for its second
    order; the other two covariances and the path's contain it."""
    inputs: FloatArray
    """Inputs during the exposure; their response is part of the path, (n_steps, n_inputs)."""
    model: ExposureModel = field(compare=False, repr=False)
    """Model of the exposure, whose basis the coefficients belong to."""
    innovation: FloatArray
    """Measurement minus its prediction, (axes, n_measurements)."""
    innovation_covariance: FloatArray
    """(axes, n_measurements, n_measurements); for more than 32 measurements its diagonal, (axes, n_measurements)."""
    nis: FloatArray
    """Normalised innovation squared, (axes,); zero for an axis of which nothing was measured.

    Chi-square with n_measurements degrees of freedom where model and covariances are right.
    """
    alignment: AlignmentError | None = field(default=None, compare=False)
    """The effect of the alignment's error, where camera and mirror count by different clocks."""
    verdict: Verdict | None = field(default=None, compare=False)
    """Whether the model fits, by the exposures up to this one; None where that is not judged.
    Where it does not fit, the covariances are those of the filter times ``verdict.widening`` squared."""

    @cached_property
    def path(self) -> FloatArray:
        """Output at each fast step of the exposure, slope units, (n_outputs, n_steps)."""
        return path_of(self.model, self.coefficients, self.inputs)

    @cached_property
    def path_sd(self) -> FloatArray:
        """Standard deviation of the path, slope units, (n_outputs, n_steps)."""
        sd = path_sd_of(self.model, self.coefficient_covariance, len(self.inputs))
        return sd if self.alignment is None else np.hypot(sd, self.alignment_path())

    def path_covariance(self, outputs: Sequence[int] | None = None) -> FloatArray:
        """Covariance of the path over its fast steps, slope units squared.

        ``outputs`` are the numbers of those wanted, such as those of one spot's x and y. All of them by default: with
        many outputs that is a very large matrix.

        Returns
        -------
        (k n_steps, k n_steps) for k outputs, all steps of the first one first: what `aolink.restoration.motion_psf`
        takes. Its diagonal is ``path_sd`` squared. The part of the path that the exposure's basis leaves out is on the
        diagonal alone.
        """
        chosen = range(len(self.path)) if outputs is None else outputs
        _, root = motion(self, np.eye(len(self.path))[list(chosen)], psd_root(self.coefficient_covariance))
        covariance = root @ root.T
        np.fill_diagonal(covariance, self.path_sd[list(chosen)].ravel() ** 2)
        return np.asarray(covariance)

    def alignment_path(self) -> FloatArray:
        """Change of the path by one standard deviation of the alignment's error, (n_outputs, n_steps).

        A later exposure sees the effect of later inputs: the path changes by its coefficients and by the response to
        the change of the inputs.
        """
        if self.alignment is None:
            return np.zeros_like(self.path)
        rate = np.gradient(self.inputs, axis=0) if len(self.inputs) > 1 else np.zeros_like(self.inputs)
        return path_of(self.model, self.alignment.coefficients, self.alignment.steps * rate)


COMPARED = (*(each.name for each in fields(Estimate) if each.compare), "path", "path_sd")
"""Fields that agree in two estimates that are the same."""


LARGE = 256
"""Covariances of more rows are rounded, so that recordings keep them in a fifteenth of the bytes of doubles."""


def as_recorded(covariance: FloatArray) -> FloatArray:
    """Covariances (axes, n, n) as recordings keep them: large ones in steps of correlation, others as they are.

    See `in_correlation_steps`: standard deviations of 700 rows grow by 2e-4 of themselves, and correlations are off by
    5e-7 at most.
    """
    return from_correlation_steps(*in_correlation_steps(covariance)) if covariance.shape[-1] > LARGE else covariance


def motion(estimate: Estimate, mix: FloatArray, roots: FloatArray, *, after: int = 0) -> tuple[FloatArray, FloatArray]:
    """Weighted sums of an estimate's outputs at each fast step, and a root of their covariance.

    Parameters
    ----------
    mix:
        Weights of the outputs, (k, n_outputs).
    roots:
        `psd_root` of the estimate's coefficient covariances.
    after:
        How many steps after the last are added: those of the model, with the last input held.

    Returns
    -------
    (k, n_steps), and R of the covariance R R', (k n_steps, n), slope units; the covariance without the path's share
    that the exposure's basis leaves out. With ``after`` n_steps is as many more.
    """
    model, path = estimate.model, estimate.path
    if after:
        path = np.concatenate([path, _path_after(estimate, after)], axis=1)
    axes, count = estimate.coefficient_covariance.shape[:2]
    weights = mix.reshape(len(mix), axes, -1)
    each = [np.zeros((len(mix) * path.shape[1], 0))]
    if estimate.alignment is not None:
        change = mix @ estimate.alignment_path()
        each.append(np.concatenate([change, np.repeat(change[:, -1:], after, axis=1)], axis=1).reshape(-1, 1))
    for axis in range(axes):
        if weights[:, axis].any():
            rows = model.mixed_rows(weights[:, axis], count)
            outputs = weights[:, axis] @ model.plant.C
            for _ in range(after):
                rows = np.concatenate([rows, (outputs @ model.end_rows[:, :count])[:, None]], axis=1)
                outputs = outputs @ model.plant.A
            each.append(rows.reshape(-1, count) @ roots[axis])
    return mix @ path, np.concatenate(each, axis=1)


def _path_after(estimate: Estimate, steps: int) -> FloatArray:
    """The outputs in the steps after the last, (axes * n_outputs, steps), with the last input held."""
    plant, state = estimate.model.plant, estimate.end_state
    held = estimate.inputs[-1].reshape(plant.axes, plant.n_inputs) @ plant.B.T
    out = []
    for _ in range(steps):
        out.append((plant.C @ state[..., None]).reshape(-1))
        state = (plant.A @ state[..., None])[..., 0] + held
    return np.stack(out, axis=1)
