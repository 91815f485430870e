"""The exposure model of a plant of many alike systems, such as a membrane's actuators, without its dense arrays.

Column j of the basis is a pattern over the outputs times a course in time: path[o, k] = sum_j P[o, j] z[j] f[k, j].
Start states have the pattern of their actuator and one of few courses, C_1 A_1^k. The noise of all actuators within
the exposure is a Kronecker product of what the outputs make of the actuators and of what the fast steps make of an
actuator's noise; the singular values of it are the products of theirs, and the largest are kept.

What is left out of the noise path is at most `NOISE_LEFT_OUT` of it, rms over outputs and steps; the patterns being
orthogonal that is exact up to the cosines' own remainder, which is counted in. It is added back: to the end
covariance as a whole, to the path's variance for each output, spread over the steps. A dense basis of 144 actuators
and 200 outputs would take 2 GB, this takes 2 MB.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from aolink import tiles
from aolink.estimation import stacked
from aolink.estimation.exposure_model import ExposureModel, InputResponse, by_axis
from aolink.plant import AlikeSystems, input_response, lift, output_rows
from aolink.rig import Plant

FloatArray = NDArray[np.float64]
Indices = NDArray[np.intp]

NOISE_LEFT_OUT = 0.05
"""Largest share of the noise path (rms) that a factored basis leaves out."""
# Cosines in which the noise of one actuator is looked for.
_COSINES = 64


@dataclass(frozen=True, eq=False)
class _Factors:
    patterns: FloatArray
    functions: FloatArray
    course_of: Indices
    end_rows: FloatArray
    after: FloatArray
    left_out: FloatArray


class FactoredModel(ExposureModel):
    """`ExposureModel` of alike systems side by side; `basis` is not needed for anything, and made where asked for."""

    def __init__(self, plant: Plant, n_steps: int, systems: AlikeSystems) -> None:
        self.plant, self.n_steps, self.systems = plant, n_steps, systems
        self.transition, self.process_noise = lift(plant, n_steps)
        self.moved = 0.0
        self.state_courses = output_rows(systems.one, n_steps)[0]
        """C_1 A_1^k of one system, (n_steps, n)."""
        self.mean_row = self._of_states(self.state_courses.mean(axis=0))

    def _of_states(self, each: FloatArray) -> FloatArray:
        """Rows over the plant's states from what one system has, (n,) or for each output (n_outputs, n)."""
        gains, order = self.systems.gains, self.systems.order
        out = np.empty((len(gains), self.plant.n_states))
        out[:, order] = gains[:, :, None] * (each if each.ndim == 1 else each[:, None, :])
        return out

    @property
    def state_rows(self) -> FloatArray:  # type: ignore[override] # dense, for whoever asks
        """C A^i, (n_outputs, n_steps, n_states)."""
        return self.basis[..., : self.plant.n_states]

    @property
    def basis(self) -> FloatArray:
        """The dense basis, (n_outputs, n_steps, n_coefficients)."""
        return np.asarray(self.patterns[:, None] * self.courses)

    @property
    def factors(self) -> tuple[FloatArray | None, FloatArray]:
        """Patterns and courses of the coefficients, (n_outputs, n_coefficients) and (n_steps, n_coefficients)."""
        return self.patterns, self.courses

    @cached_property
    def _factors(self) -> _Factors:
        systems, n_steps, n = self.systems, self.n_steps, self.plant.n_states
        one = systems.one
        count = min(_COSINES, n_steps)
        phase = np.pi * (np.arange(n_steps) + 0.5) / n_steps
        m = np.arange(count)
        cosines = np.cos(m[:, None] * phase) * np.sqrt(np.where(m, 2, 1) / n_steps)[:, None]
        driven = Plant(**(vars(one) | {"B": one.B_w}))
        paths, ends = input_response(driven, cosines[:, :, None])
        left, values, turned = np.linalg.svd(paths[:, 0].T, full_matrices=False)
        across, sizes, along = np.linalg.svd(systems.gains * systems.noise_sd, full_matrices=False)
        # Energy of one noise over all steps, what the cosines leave out of it included.
        impulse = self.state_courses @ one.B_w[:, 0]
        energy = float((np.arange(n_steps - 1, -1, -1) * impulse**2).sum())
        total = energy * float((sizes**2).sum())
        products = np.outer(sizes**2, values**2)
        largest = np.argsort(-products, axis=None, kind="stable")
        found = np.cumsum(products.ravel()[largest])
        enough = np.flatnonzero(total - found <= NOISE_LEFT_OUT**2 * total)
        kept = largest[: enough[0] + 1] if len(enough) else largest
        kept = kept if total else kept[:0]
        space, time = np.unravel_index(kept, products.shape)

        distinct = int(time.max()) + 1 if len(time) else 0
        functions = np.concatenate([self.state_courses, left[:, :distinct] * values[:distinct]], axis=1)
        patterns = np.empty((len(systems.gains), n + len(kept)))
        which = np.empty(n + len(kept), dtype=np.intp)
        for s in range(systems.order.shape[1]):
            patterns[:, systems.order[:, s]], which[systems.order[:, s]] = systems.gains, s
        patterns[:, n:], which[n:] = across[:, space] * sizes[space], systems.order.shape[1] + time
        rows = np.zeros((n, n + len(kept)))
        rows[:, :n] = self.transition
        pushed = (turned @ ends)[time]  # of one system, (kept, n)
        rows[systems.order, n:] = (systems.noise_sd * along[space]).T[:, None] * pushed.T
        noise = ((systems.gains * systems.noise_sd) ** 2).sum(axis=1) * energy / n_steps
        left_out = noise - (patterns[:, n:] ** 2) @ (values[time] ** 2) / n_steps
        after = np.append(one.C @ self.transition_of_one, (turned @ ends)[:distinct] @ one.C[0])
        return _Factors(patterns, functions, which, rows, after, np.maximum(left_out, 0.0))

    @property
    def transition_of_one(self) -> FloatArray:
        """A_1^N, (n, n)."""
        own = self.systems.order[0]
        return self.transition[np.ix_(own, own)]

    @property
    def patterns(self) -> FloatArray:
        """P, (n_outputs, n_coefficients)."""
        return self._factors.patterns

    @property
    def functions(self) -> FloatArray:
        """The distinct courses, (n_steps, m)."""
        return self._factors.functions

    @property
    def course_of(self) -> Indices:
        """The course of each coefficient, (n_coefficients,)."""
        return self._factors.course_of

    @property
    def after(self) -> FloatArray:
        """The distinct courses in the step after the last, (m,)."""
        return self._factors.after

    @property
    def left_out(self) -> FloatArray:
        """Variance of the path that the basis leaves out, mean over the steps, slope units squared, (n_outputs,)."""
        return self._factors.left_out

    @property
    def noise_left_out(self) -> float:
        """Share of the noise path that the basis leaves out, rms over outputs and steps."""
        kept = ((self.patterns**2).sum(axis=0) * (self.courses**2).mean(axis=0))[self.plant.n_states :].sum()
        total = kept + self.left_out.sum()
        return math.sqrt(float(self.left_out.sum() / total)) if total else 0.0

    @property
    def courses(self) -> FloatArray:
        """f, (n_steps, n_coefficients)."""
        return self.functions[:, self.course_of]

    @property
    def _with_noise(self) -> tuple[FloatArray, FloatArray]:
        return self.functions, self._factors.end_rows

    def columns(self, count: int) -> list[Indices]:
        """Which of the first ``count`` coefficients have each of the distinct courses."""
        return [np.flatnonzero(self.course_of[:count] == c) for c in range(self.functions.shape[1])]

    def responses(self, inputs: Sequence[FloatArray]) -> list[InputResponse]:
        """`response` of many exposures."""
        return [self._response(each) for each in inputs]

    def _response(self, inputs: FloatArray) -> InputResponse:
        path, end = input_response(self.plant, by_axis(self.plant, inputs))
        mean, square = stacked.mean_over_path(path), stacked.mean_over_path(path * path)
        slope = self._mean_slopes(path)
        if self.moved:
            last = self.last_response(end)
            mean, square = mean + self.moved * last, square + self.moved * last * last
            slope = slope + self.moved * last[..., None] * self.last_rows
        return InputResponse(path=path, end=end, mean=mean, slope=slope, square=square)

    def _mean_slopes(self, path: FloatArray) -> FloatArray:
        """Mean of each output times the rows of its states over the fast steps, (axes, n_outputs, n_states)."""
        return np.stack([self._of_states(tiles.matmul(each, self.state_courses) / self.n_steps) for each in path])

    def times_quadratic(self, state: FloatArray) -> FloatArray:
        """M x for each output, (axes, n_outputs, n_states)."""
        path = self.path(state, np.zeros((len(state), self.plant.n_outputs, self.n_steps)))
        slope = self._mean_slopes(path)
        if self.moved:
            C, last = self.plant.C, self.last_rows
            for rows, sign in ((last, 1), (C, -1)):
                slope += sign * self.moved * stacked.long_matmul(state, rows.T)[..., None] * rows
        return slope

    def path(self, coefficients: FloatArray, input_path: FloatArray) -> FloatArray:
        """basis @ coefficients + c, as of `ExposureModel`."""
        count = coefficients.shape[1]
        patterns, courses = self.patterns[:, :count], self.courses[:, :count]
        return input_path + np.stack([tiles.matmul(patterns * z, courses.T) for z in coefficients])

    def path_sd(self, covariance: FloatArray) -> FloatArray:
        """Standard deviation of the path, as of `ExposureModel`; with process noise in it, also what is left out."""
        variance = ((self.functions @ self.of_outputs(covariance)) * self.functions).sum(axis=3)
        if covariance.shape[1] > self.plant.n_states:
            variance += self.left_out[:, None]
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def of_outputs(self, covariance: FloatArray) -> FloatArray:
        """Covariance of the courses' shares of each output's path, (axes, n_outputs, m, m)."""
        count, m = covariance.shape[1], self.functions.shape[1]
        out = np.zeros((len(covariance), self.plant.n_outputs, m, m))
        for axis, P in enumerate(covariance):
            columns = self.columns(count)
            for c, own in enumerate(columns):
                for d, other in enumerate(columns[: c + 1]):
                    block = tiles.matmul(self.patterns[:, own], P[np.ix_(own, other)])
                    out[axis, :, c, d] = out[axis, :, d, c] = (block * self.patterns[:, other]).sum(axis=1)
        return out
