"""The exposure model of a plant of many equal systems, such as a membrane's actuators, without its dense arrays.

Column j of the basis is a pattern over the outputs times a course in time: path[o, k] = sum_j P[o, j] z[j] f[k, j].
Start states have the pattern of their actuator and one of few courses, C_1 A_1^k. The path of all actuators' noise is
a Kronecker product of two matrices, actuators to outputs and an actuator's noise to its path; its singular values are
the products of theirs, and the largest are kept.

At most `NOISE_LEFT_OUT` of the noise path is left out, rms over outputs and steps, the patterns being orthogonal; what
the cosines leave out is included. It is added back: to the end covariance in full, to the variance of each output's
path as a mean over the steps. With 2 % instead of 5 % left out and half as many coefficients again, `profile` on the
rig membrane-12x12 gets no better. The dense basis of 144 actuators, 200 outputs and 200 steps would take 0.6 GB, this
takes 2 MB (row `membrane_in_real_time` of tools/bench).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from aolink.estimation.model.base import ExposureModel, InputResponse, by_axis
from aolink.numerics import batched, single_thread
from aolink.numerics.arrays import FloatArray, Indices
from aolink.plant.alike import AlikeSystems
from aolink.plant.lifting import input_response, lift, output_rows
from aolink.rig import Plant

NOISE_LEFT_OUT = 0.05
"""Largest share of the noise path (rms) that a factored basis leaves out."""
# Number of cosines in which the noise of one actuator is expanded.
_COSINES = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseFactors:
    """The process noise of one exposure as patterns times courses, the largest first."""

    patterns: FloatArray
    """(n_outputs, k)"""
    course_of: Indices
    """Number of each coefficient's course, (k,)."""
    courses: FloatArray
    """Paths of one system, (n_steps, m)."""
    after: FloatArray
    """The courses in the step after the last, (m,)."""
    ends: FloatArray
    """End states of the coefficients, (n_states, k)."""
    end_remainder: FloatArray
    """Covariance of the end state that the coefficients leave out, (n_states, n_states)."""
    left_out: FloatArray
    """Variance of the path that the coefficients leave out, mean over the steps, slope units squared, (n_outputs,)."""


def noise_factors(systems: AlikeSystems, n_steps: int) -> NoiseFactors:
    """The largest factors of the noise path, which leave out at most `NOISE_LEFT_OUT` of it."""
    one, sd = systems.one, systems.noise_sd
    m = np.arange(min(_COSINES, n_steps))
    phase = np.pi * (np.arange(n_steps) + 0.5) / n_steps
    cosines = np.cos(m[:, None] * phase) * np.sqrt(np.where(m, 2, 1) / n_steps)[:, None]
    paths, ends = input_response(replace(one, B=one.B_w), cosines[:, :, None])
    courses, values, turned = np.linalg.svd(paths[:, 0].T, full_matrices=False)
    across, sizes, _ = np.linalg.svd(systems.gains * sd, full_matrices=False)
    along = np.linalg.svd(systems.gains * sd)[2]  # all directions of the systems, those that are not seen as well

    # Energy of one noise over all steps, with what the cosines leave out of it.
    impulse = output_rows(one, n_steps)[0] @ one.B_w[:, 0]
    energy = float((np.arange(n_steps - 1, -1, -1) * impulse**2).sum())
    total = energy * float((sizes**2).sum())
    products = np.outer(sizes**2, values**2)
    largest = np.argsort(-products, axis=None, kind="stable")
    missing = total - np.cumsum(products.ravel()[largest])
    count = 0 if not total else 1 + int(np.argmax(np.append(missing, 0.0) <= NOISE_LEFT_OUT**2 * total))
    space, time = np.unravel_index(largest[:count], products.shape)

    distinct = int(time.max(initial=-1)) + 1
    pushed = turned @ ends  # of one system, (cosines, n)
    patterns = across[:, space] * sizes[space]
    rows = np.empty((systems.order.size, len(space)))
    rows[systems.order] = (sd * along[space]).T[:, None] * pushed[time].T
    # Direction by direction of the systems: what a small covariance leaves out has no rounding below zero.
    rest = np.repeat(lift(one, n_steps)[1][None], len(along), axis=0)
    np.subtract.at(rest, space, pushed[time, :, None] * pushed[time, None, :])
    sizes_of_rest, vectors = np.linalg.eigh(rest)
    roots = vectors * np.sqrt(np.maximum(sizes_of_rest, 0.0))[:, None]
    root = np.empty((systems.order.size, roots.shape[0] * roots.shape[2]))
    root[systems.order] = np.einsum("ia,ise->asie", along * sd, roots).reshape(*systems.order.shape, -1)
    noise = ((systems.gains * sd) ** 2).sum(axis=1) * energy / n_steps
    return NoiseFactors(
        patterns=patterns, course_of=time, courses=courses[:, :distinct] * values[:distinct],
        after=pushed[:distinct] @ one.C[0], ends=rows, end_remainder=single_thread.gram(np.ascontiguousarray(root.T)),
        left_out=np.maximum(noise - patterns**2 @ values[time] ** 2 / n_steps, 0.0),
    )  # fmt: skip


class FactoredModel(ExposureModel):
    """The `ExposureModel` of equal systems side by side."""

    def __init__(self, plant: Plant, n_steps: int, systems: AlikeSystems) -> None:
        self.systems = systems
        self.state_courses = output_rows(systems.one, n_steps)[0]
        """C_1 A_1^k of one system, (n_steps, n)."""
        super().__init__(plant, n_steps, self._of_states(self.state_courses.mean(axis=0)))

    def _of_states(self, each: FloatArray) -> FloatArray:
        """Rows over the plant's states from what one system has, (n,) or for each output (n_outputs, n)."""
        gains, order = self.systems.gains, self.systems.order
        out = np.empty((len(gains), order.size))
        out[:, order] = gains[:, :, None] * (each if each.ndim == 1 else each[:, None, :])
        return out

    @property
    def state_rows(self) -> FloatArray:
        """The dense array, computed where it is asked for."""
        return self.basis[..., : self.plant.n_states]

    @property
    def basis(self) -> FloatArray:
        """The dense array, computed where it is asked for."""
        return np.asarray(self.patterns[:, None] * self.courses)

    @property
    def factors(self) -> tuple[FloatArray | None, FloatArray]:
        """Patterns and courses of the coefficients, (n_outputs, n_coefficients) and (n_steps, n_coefficients)."""
        return self.patterns, self.courses

    def mixed_rows(self, weights: FloatArray, count: int) -> FloatArray:
        mixed = weights @ self.patterns
        return np.asarray(mixed[:, None, :count] * self.courses[:, :count])

    @cached_property
    def noise(self) -> NoiseFactors:
        """The process noise."""
        return noise_factors(self.systems, self.n_steps)

    @property
    def transition_of_one(self) -> FloatArray:
        """A_1^N, (n, n)."""
        own = self.systems.order[0]
        return self.transition[np.ix_(own, own)]

    @cached_property
    def patterns(self) -> FloatArray:
        """P, (n_outputs, n_coefficients)."""
        own = np.empty((len(self.systems.gains), self.plant.n_states))
        own[:, self.systems.order] = self.systems.gains[:, :, None]
        unmodelled = self.unmodelled_sd * np.eye(len(own), self.n_unmodelled)
        return np.concatenate([own, unmodelled, self.noise.patterns], axis=1)

    @cached_property
    def functions(self) -> FloatArray:
        """The distinct courses, (n_steps, m)."""
        still = np.ones((self.n_steps, min(self.n_unmodelled, 1)))
        return np.concatenate([self.state_courses, still, self.noise.courses], axis=1)

    @cached_property
    def after(self) -> FloatArray:
        """The distinct courses in the step after the last, (m,)."""
        still = np.ones(min(self.n_unmodelled, 1))
        return np.concatenate([self.systems.one.C[0] @ self.transition_of_one, still, self.noise.after])

    @cached_property
    def course_of(self) -> Indices:
        """The course of each coefficient, (n_coefficients,)."""
        each = self.systems.order.shape[1]
        own = np.empty(self.plant.n_states, dtype=np.intp)
        own[self.systems.order] = np.arange(each)
        still = np.full(self.n_unmodelled, each)
        return np.concatenate([own, still, each + min(self.n_unmodelled, 1) + self.noise.course_of])

    @property
    def end_remainder(self) -> FloatArray:
        return self.noise.end_remainder

    @property
    def courses(self) -> FloatArray:
        """f, (n_steps, n_coefficients)."""
        return self.functions[:, self.course_of]

    @cached_property
    def end_rows(self) -> FloatArray:
        unmodelled = np.zeros((len(self.transition), self.n_unmodelled))
        return np.concatenate([self.transition, unmodelled, self.noise.ends], axis=1)

    def columns(self, count: int) -> list[Indices]:
        """The numbers of those of the first ``count`` coefficients that have each of the distinct courses."""
        return [np.flatnonzero(self.course_of[:count] == c) for c in range(self.functions.shape[1])]

    def responses(self, inputs: FloatArray) -> InputResponse:
        path, end = input_response(self.plant, by_axis(self.plant, inputs))
        mean, square = batched.mean_over_path(path), batched.mean_over_path(path * path)
        slope = self._mean_slopes(path)
        if self.moved:
            last = self.last_response(end)
            mean, square = mean + self.moved * last, square + self.moved * last * last
            slope = slope + self.moved * last[..., None] * self.last_rows
        return InputResponse(end=end, mean=mean, slope=slope, square=square, whole=lambda: path)

    def _mean_slopes(self, path: FloatArray) -> FloatArray:
        """Mean of each output times the rows of its states over the fast steps, (axes, n_outputs, n_states)."""
        return np.stack(
            [self._of_states(single_thread.matmul(each, self.state_courses) / self.n_steps) for each in path]
        )

    def times_quadratic(self, state: FloatArray) -> FloatArray:
        path = self.path(state, np.zeros((len(state), self.plant.n_outputs, self.n_steps)))
        slope = self._mean_slopes(path)
        if self.moved:
            C, last = self.plant.C, self.last_rows
            for rows, sign in ((last, 1), (C, -1)):
                slope += sign * self.moved * batched.long_matmul(state, rows.T)[..., None] * rows
        return slope

    def path(self, coefficients: FloatArray, input_path: FloatArray) -> FloatArray:
        count = coefficients.shape[1]
        patterns, courses = self.patterns[:, :count], self.courses[:, :count]
        return input_path + np.stack([single_thread.matmul(patterns * z, courses.T) for z in coefficients])

    def path_sd(self, covariance: FloatArray) -> FloatArray:
        # With process noise in it, also what is left out.
        variance = ((self.functions @ self.of_outputs(covariance)) * self.functions).sum(axis=3)
        if covariance.shape[1] > self.plant.n_states:
            variance += self.noise.left_out[:, None] + self.unmodelled_rest
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def of_outputs(self, covariance: FloatArray) -> FloatArray:
        """Covariance of the courses' shares of each output's path, (axes, n_outputs, m, m)."""
        count, m = covariance.shape[1], self.functions.shape[1]
        out = np.zeros((len(covariance), self.plant.n_outputs, m, m))
        for axis, P in enumerate(covariance):
            columns = self.columns(count)
            for c, own in enumerate(columns):
                for d, other in enumerate(columns[: c + 1]):
                    block = single_thread.matmul(self.patterns[:, own], P[np.ix_(own, other)])
                    out[axis, :, c, d] = out[axis, :, d, c] = (block * self.patterns[:, other]).sum(axis=1)
        return out
