"""All spots of one plant with hundreds of states, as a function of the coefficients of a factored model.

A spot's pixels depend on its own two paths, and each path, apart from its response to the inputs, on the shares of m
courses in it. So the Jacobian of its pixels is small, (pixels, 2 m), and the information J' R^-1 J that the frame has
on all coefficients is a sum over spots of small blocks between the rows of two patterns: nothing is as large as pixels
times coefficients.

The noise coefficients are ordered, the largest first. Those that move the spots visibly, given the width of the kernel,
are kept, as in `aolink.estimation.pixels.likelihood`; the remaining ones widen the kernel.
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
from itertools import pairwise
from types import ModuleType

import numpy as np

from aolink.estimation.model.base import InputResponse
from aolink.estimation.model.exposure_model import exposure_model
from aolink.estimation.model.factored import FactoredModel
from aolink.estimation.model.quadrature import QuadraturePaths, QuadratureRule, Resolution, resolution
from aolink.numerics.arrays import FloatArray
from aolink.numerics.covariance import psd_root
from aolink.numerics.single_thread import gram, information_matrix, matmul_one_thread
from aolink.optics.sensor import SpotSensor

# Rms of the noise path that is left out, in standard deviations of the kernel: half of what one spot alone may leave
# out, because many spots show a displacement of all of them more accurately.
LEFT_OUT = 0.05
# Random draws of all coefficients, to find the number of nodes.
_DRAWS = 4


class JointPaths:
    """Paths of all spots at quadrature nodes, from the first ``size`` coefficients.

    The sensor's kernel, pixels and noise set the number of nodes and of coefficients. ``left_out`` is the rms of the
    noise path that may be left out, in standard deviations of the kernel.
    """

    def __init__(self, model: FactoredModel, sensor: SpotSensor, left_out: float = LEFT_OUT) -> None:
        self.model, self.left_out = model, left_out
        n = model.plant.n_states + model.n_unmodelled
        variance = float(np.linalg.eigvalsh(sensor.kernel.covariance)[0])
        energy = (model.patterns[:, n:] ** 2).sum(axis=0) * (model.functions**2).mean(axis=0)[model.course_of[n:]]
        rest = np.append(np.cumsum(energy[::-1])[::-1], 0.0) + model.noise.left_out.sum()
        enough = np.flatnonzero(rest <= left_out**2 * variance * model.plant.n_outputs)
        kept = int(enough[0]) if len(enough) else len(energy)
        self.widening = float(rest[kept]) / model.plant.n_outputs + model.unmodelled_rest
        """Mean variance of the part of the path that is left out, by which the kernel is widened."""
        self.size = n + kept
        """Number of coefficients."""
        course_of = model.course_of[: self.size]
        used = int(course_of.max()) + 1
        self.order = np.argsort(course_of, kind="stable")
        self.patterns = np.ascontiguousarray(model.patterns[:, : self.size])
        """(n_outputs, size)"""
        self._gram = gram(self.patterns)
        # In the order of courses.
        self._patterns, self._course_of = np.ascontiguousarray(self.patterns[:, self.order]), course_of[self.order]
        self._starts = np.append(0, np.cumsum(np.bincount(course_of)))
        self._slices = [slice(start, end) for start, end in pairwise(self._starts.tolist())]
        self.course_of = course_of
        self._functions = model.functions[:, :used]
        self.resolution = self._resolution(variance, sensor)
        self.functions, self.weights = self._at(self.resolution.levels[0])
        """The courses at the nodes, (nodes, m), and each node's share of the exposure, (nodes,)."""
        self.inputs = np.zeros((model.plant.n_outputs, len(self.weights)))
        """The response to the inputs, (n_outputs, nodes)."""

    def _resolution(self, variance: float, sensor: SpotSensor) -> Resolution:
        """Number of nodes, which does not depend on where in a step an exposure starts."""
        if not self.model.moved:
            return resolution(self._from_model_only(), variance, sensor.profile)
        model = exposure_model(self.model.plant, self.model.n_steps)
        assert isinstance(model, FactoredModel)
        return joint_paths(model, sensor, self.left_out).resolution

    def _from_model_only(self) -> FloatArray:
        """Random paths of the outputs by the plant's prior, (paths, n_steps)."""
        z = np.random.default_rng(0).standard_normal((_DRAWS, self.size))
        n = self.model.plant.n_states
        z[:, :n] = z[:, :n] @ psd_root(self.model.plant.initial_covariance).T
        return np.concatenate([self.shares(each) @ self._functions.T for each in z])

    def _at(self, q: QuadratureRule) -> tuple[FloatArray, FloatArray]:
        """Courses and weights of nodes."""
        functions, weights, moved = np.ascontiguousarray(q.at(self._functions.T).T), q.weights, self.model.moved
        if not moved:
            return functions, weights
        # This share of the exposure is not in its first step but in the one after its last.
        after = self.model.after[: functions.shape[1]]
        return np.vstack([functions, self._functions[0], after]), np.append(weights, [-moved, moved])

    def foreseen(self, mean: FloatArray, response: InputResponse, axis: int) -> JointPaths:
        """The same with the response to an exposure's inputs, and as many nodes as a path about this mean needs.

        ``mean`` is that of the coefficients before the exposure, (size,).
        """
        paths, path = copy(self), response.path[axis]
        expected = self.shares(mean) @ self._functions.T + path
        q = self.resolution.levels[int(self.resolution.of(expected[None])[0])]
        paths.functions, paths.weights = self._at(q)
        paths.inputs = q.at(path)
        if self.model.moved:
            late = [path[:, 0], self.model.last_response(response.end)[axis]]
            paths.inputs = np.concatenate([paths.inputs, np.stack(late, axis=1)], axis=1)
        return paths

    @property
    def spots(self) -> int:
        return len(self.patterns) // 2

    def shares(self, t: FloatArray) -> FloatArray:
        """The courses' shares of each output's path, (n_outputs, m)."""
        return np.asarray(np.add.reduceat(self._patterns * t[self.order], self._starts[:-1], axis=1))

    def positions(self, t: FloatArray) -> FloatArray:
        """Positions of the spots at the nodes, (spots, 2, nodes)."""
        path = matmul_one_thread(self.shares(t), np.ascontiguousarray(self.functions.T)) + self.inputs
        return path.reshape(self.spots, 2, -1)

    def score(self, of_shares: FloatArray) -> FloatArray:
        """Derivative by the coefficients from that by the courses' shares, (spots, 2, m) -> (size,)."""
        return np.asarray((self.patterns * of_shares.reshape(len(self.patterns), -1)[:, self.course_of]).sum(axis=0))

    def information(self, of_shares: FloatArray) -> FloatArray:
        """Information on the coefficients from that on each spot's shares, (spots, 2, m, 2, m) -> (size, size)."""
        lower, out = np.empty((self.size, self.size)), np.empty((self.size, self.size))
        of_shares = np.ascontiguousarray(of_shares)
        for c, own in enumerate(self._slices):
            informed = np.empty((len(self.patterns), own.stop))
            compiled_loops().informed(of_shares, self._patterns, self._course_of, c, informed)
            lower[own, : own.stop] = matmul_one_thread(self._patterns[:, own].T, informed)
        compiled_loops().spread_out(lower, self.order, out)
        return out

    def spread(self, covariance: FloatArray) -> FloatArray:
        """Covariance of the shares of each spot, x before y, from that of the coefficients, (spots, 2 m, 2 m)."""
        m = self.functions.shape[1]
        out = np.empty((self.spots, 2, m, 2, m))
        by_course = self._sorted(covariance)
        for c, own in enumerate(self._slices):
            left = matmul_one_thread(self._patterns[:, own], by_course[own, : own.stop])
            compiled_loops().spread_of(left, self._patterns, self._starts, c, out)
        return out.reshape(self.spots, 2 * m, 2 * m)

    def _sorted(self, matrix: FloatArray) -> FloatArray:
        """Rows and columns (size, size) in the order of courses."""
        out = np.empty((self.size, self.size))
        compiled_loops().taken(np.ascontiguousarray(matrix), self.order, out)
        return out

    def of_one_spot(self) -> QuadraturePaths:
        """The shares of a spot as coefficients of a basis of its own; each spot is an axis."""
        nodes, m = self.functions.shape
        basis = np.zeros((2, nodes, 2, m))
        basis[0, :, 0] = basis[1, :, 1] = self.functions
        return QuadraturePaths(
            basis=basis.reshape(2, nodes, 2 * m), weights=self.weights,
            inputs=self.inputs.reshape(self.spots, 2, nodes), widening=self.model.unmodelled_rest,
        )  # fmt: skip

    def rms_spread(self, state_covariance: FloatArray) -> float:
        """Standard deviation of the paths before the exposure, rms over outputs and nodes."""
        summed = self._sorted(self._gram * self.prior_covariance(state_covariance))
        first = self._starts[:-1]
        own = np.add.reduceat(np.add.reduceat(summed, first, axis=0), first, axis=1)
        variance = (self.weights * ((self.functions @ own) * self.functions).sum(axis=1)).sum()
        return float(np.sqrt(max(variance, 0.0) / len(self.patterns)))

    def prior_covariance(self, state_covariance: FloatArray) -> FloatArray:
        """The coefficients' covariance before the exposure, (size, size)."""
        n = len(state_covariance)
        out = np.eye(self.size)
        out[:n, :n] = state_covariance
        return out

    def prior_information(self, state_covariance: FloatArray) -> FloatArray:
        """Inverse of the coefficients' covariance before the exposure, (size, size)."""
        return self.prior_covariance(information_matrix(state_covariance))


@lru_cache(maxsize=1)
def compiled_loops() -> ModuleType:
    """The compiled loops, loaded at the first plant of many equal systems: Numba alone takes half a second."""
    from aolink.estimation.compiled import joint

    return joint


joint_paths = lru_cache(maxsize=16)(JointPaths)
"""`JointPaths`, made once."""
