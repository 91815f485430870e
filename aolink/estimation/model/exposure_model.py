"""One exposure: start state, end state and path as one joint Gaussian.

With z = (x(k0), xi), xi ~ N(0, I) the coefficients of the process noise inside the exposure,

    path = basis z + c(u),     x(k0 + N) = end_rows z + d(u) + remainder.

Every estimator is an update of z; they differ in what they observe, and in whether they model xi.

Where the plant says so (`UnmodelledSlopes`), xi begins with one coefficient for each output: the mean over the exposure
of the slopes v that the plant does not make, in their standard deviations. It moves the output for the whole exposure
and leaves the end state alone. What v does about its mean has no coefficient; it widens spots by its variance, and the
standard deviation of a path contains it.

The spot rests where theta(k) has it for the whole of a fast step, as the sum in Mishra & Wen (3) takes it. An exposure
that starts a part f of a step late loses as much of its first step and gains as much of the one after its last:
a mean over it is (1/N) [sum_i g(theta_i) + f g(theta_N) - f g(theta_0)]. Start state, end state and path stay those
of whole steps.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from aolink.numerics import batched
from aolink.numerics.covariance import psd_root
from aolink.plant.alike import alike_systems
from aolink.plant.lifting import input_response, lift, output_rows
from aolink.rig import Plant

FloatArray = NDArray[np.float64]

# Noise slower than this many half periods an exposure is modelled, per noise channel; fewer where fewer do.
_MOST_NOISE_MODES = 24
# Share of the noise path (rms) that may be left out.
_NOISE_LEFT_OUT = 0.02
_TIME_BLOCK = 256


@dataclass(frozen=True, kw_only=True, eq=False)
class InputResponse:
    """What the inputs of one exposure do, and what the moments need of it."""

    path: FloatArray
    """c, response of the outputs, (axes, n_outputs, n_steps)."""
    end: FloatArray
    """d, response of the end state, (axes, n_states)."""
    mean: FloatArray
    """Mean of c over the exposure, (axes, n_outputs)."""
    slope: FloatArray
    """b, mean of C A^i weighted with c_i, (axes, n_outputs, n_states)."""
    square: FloatArray
    """s, mean of c squared, (axes, n_outputs)."""

    def of(self, some: slice) -> InputResponse:
        """That of some of the axes."""
        return InputResponse(
            path=self.path[some], end=self.end[some], mean=self.mean[some], slope=self.slope[some],
            square=self.square[some],
        )  # fmt: skip


class ExposureModel:
    """The joint Gaussian of one exposure of a plant, precomputed; it holds no state."""

    def __init__(self, plant: Plant, n_steps: int) -> None:
        self.plant = plant
        self.n_steps = n_steps
        self.state_rows = output_rows(plant, n_steps)
        """C A^i, (n_outputs, n_steps, n_states)."""
        self.transition, self.process_noise = lift(plant, n_steps)
        self.mean_row = self.state_rows.mean(axis=1)
        """C-bar, (n_outputs, n_states)."""
        self.moved = 0.0
        """f/N: the share of the exposure that is in the step after its last, and not in its first."""
        self._set_unmodelled()
        # Many outputs are sums of few states, unless each has a slope of its own: what is computed then are paths of
        # the states.
        few = plant.n_outputs > plant.n_states and not self.n_unmodelled
        self._few = replace(plant, C=np.eye(plant.n_states)) if few else plant

    def _set_unmodelled(self) -> None:
        unmodelled = self.plant.unmodelled
        mean, rest = unmodelled.variances(self.n_steps) if unmodelled else (0.0, 0.0)
        self.n_unmodelled = self.plant.n_outputs if unmodelled else 0
        """Coefficients of `UnmodelledSlopes`, which come after the start state; the process noise comes after them."""
        self.unmodelled_sd = float(np.sqrt(mean))
        """Standard deviation of their means over the exposure, slope units."""
        self.unmodelled_rest = rest
        """Mean variance of them about these means, slope units squared."""

    def starting(self, offset: float) -> ExposureModel:
        """The same for exposures that start so far into their first fast step, in fast steps, 0 <= offset < 1."""
        if not 0 <= offset < 1:
            raise ValueError(f"an exposure starts from 0 to 1 fast step into its first one, not {offset:g}")
        _ = self._with_noise  # made once, for all offsets
        model = copy(self)
        model.moved = offset / self.n_steps
        first, last = self.plant.C, self.last_rows
        model.mean_row = self.mean_row + model.moved * (last - first)
        model.__dict__.pop("quadratic", None)  # it is another
        return model

    @cached_property
    def quadratic(self) -> FloatArray:
        """M = mean_i (C A^i)'(C A^i) for each output, (n_outputs, n_states, n_states)."""
        mean = np.einsum("oij,oik->ojk", self.state_rows, self.state_rows) / self.n_steps
        if not self.moved:
            return np.asarray(mean)
        first, last = self.plant.C, self.last_rows
        squares = last[:, :, None] * last[:, None, :] - first[:, :, None] * first[:, None, :]
        return np.asarray(mean + self.moved * squares)

    def times_quadratic(self, state: FloatArray) -> FloatArray:
        """M x for each output, states (axes, n_states) -> (axes, n_outputs, n_states)."""
        return np.asarray(np.matmul(self.quadratic, state[:, None, :, None])[..., 0])

    @cached_property
    def last_rows(self) -> FloatArray:
        """C A^N, outputs in the step after the last, (n_outputs, n_states)."""
        return np.asarray(self.plant.C @ self.transition)

    @property
    def rows_after(self) -> FloatArray:
        """What the coefficients make of the outputs in the step after the last, (n_outputs, n_coefficients)."""
        rows = np.asarray(self.plant.C @ self.end_rows)
        n = self.plant.n_states
        rows[:, n : n + self.n_unmodelled] = self.unmodelled_sd * np.eye(len(rows), self.n_unmodelled)
        return rows

    @property
    def n_coefficients(self) -> int:
        """States, unmodelled slopes and noise coefficients together."""
        return int(self.end_rows.shape[1])

    @property
    def basis(self) -> FloatArray:
        """Paths of the coefficients, (n_outputs, n_steps, n_coefficients); the first n_states are C A^i."""
        outputs, paths = self.factors
        return paths if outputs is None else np.tensordot(outputs, paths, axes=1)

    @property
    def factors(self) -> tuple[FloatArray | None, FloatArray]:
        """The basis as a product, where outputs are more than states: C, and paths of the states, (n_states, ...)."""
        return None if self._few is self.plant else self.plant.C, self._with_noise[0]

    @property
    def end_rows(self) -> FloatArray:
        """End states of the coefficients, (n_states, n_coefficients)."""
        return self._with_noise[1]

    @cached_property
    def end_remainder(self) -> FloatArray:
        """Covariance of what the noise coefficients leave out of the end state, (n_states, n_states)."""
        reached = self.end_rows[:, self.plant.n_states :]
        root = psd_root(self.process_noise - reached @ reached.T)
        return root @ root.T

    @cached_property
    def _with_noise(self) -> tuple[FloatArray, FloatArray]:
        """Start columns and noise columns of path and end state; of the states' paths where they are fewer.

        Each noise channel is a sum of cosines, of unit variance each and orthonormal over the fast steps.
        """
        plant, n_steps = self._few, self.n_steps
        rows = self.state_rows if plant is self.plant else output_rows(plant, n_steps)
        root = plant.B_w @ psd_root(plant.process_noise)
        impulse = rows @ root  # C A^i B_w, (n_outputs, n_steps, n_noises)
        energy = (np.arange(n_steps - 1, -1, -1)[:, None] * self._squares(impulse)).sum()
        paths, ends, found = [rows], [self.transition], 0.0
        if self.n_unmodelled:
            own = self.unmodelled_sd * np.eye(self.n_unmodelled)
            paths.append(np.repeat(own[:, None], n_steps, axis=1))
            ends.append(np.zeros((plant.n_states, self.n_unmodelled)))
        phase = np.pi * (np.arange(n_steps) + 0.5) / n_steps
        driven = [replace(plant, B=column[:, None], axes=1) for column in root.T]
        for m in range(min(_MOST_NOISE_MODES, n_steps)):
            if energy - found <= _NOISE_LEFT_OUT**2 * energy:
                break
            cosine = np.cos(m * phase) * np.sqrt((2 if m else 1) / n_steps)
            channels = [input_response(channel, cosine[None, :, None]) for channel in driven]
            paths.append(np.stack([path[0] for path, _ in channels], axis=-1))
            ends.append(np.stack([end[0] for _, end in channels], axis=-1))
            found += float(self._squares(paths[-1]).sum())
        return np.concatenate(paths, axis=2), np.concatenate(ends, axis=1)

    def _squares(self, paths: FloatArray) -> FloatArray:
        """What sums up to the sum of squares over outputs, from `_few` plant's paths, (., n_steps, n)."""
        if self._few is self.plant:
            return paths**2
        C = self.plant.C
        return np.asarray(paths * np.tensordot(C.T @ C, paths, axes=1))

    def response(self, inputs: FloatArray) -> InputResponse:
        """Response to the inputs of an exposure, (n_steps, axes * n_inputs)."""
        return self.responses(inputs[None])

    def responses(self, inputs: FloatArray) -> InputResponse:
        """`response` of many exposures, (exposures, n_steps, axes * n_inputs), the axes of one after those of another.

        Each is to the same bits as alone, for a fraction of the calls.
        """
        path, end = input_response(self.plant, by_axis(self.plant, inputs))
        if not path.any():
            none = np.zeros(path.shape[:2])
            slope = np.zeros((*path.shape[:2], self.plant.n_states))
            return InputResponse(path=path, end=end, mean=none, slope=slope, square=none)
        mean, square = batched.mean_over_path(path), batched.mean_over_path(path * path)
        if self._few is self.plant:
            # Column by column, so that the products lie in memory as they are summed.
            columns = [batched.mean_over_path(path * column) for column in self._columns[: self.plant.n_states]]
            slope = np.stack(columns, axis=-1)
        else:
            slope = np.matmul(path[:, :, None], self.state_rows)[:, :, 0] / self.n_steps
        if self.moved:
            # Inputs have done nothing yet in the first step.
            late = self.moved * self.last_response(end)
            mean, square = mean + late, square + late * late / self.moved
            slope = slope + late[..., None] * self.last_rows
        return InputResponse(path=path, end=batched.batch_last(end), mean=mean, slope=slope, square=square)

    def last_response(self, end: FloatArray) -> FloatArray:
        """c_N, response of the outputs in the step after the last to that of the end state, (axes, n_outputs)."""
        return batched.matvec(self.plant.C, end)

    def cross_quadratic(self, first: int, second: int) -> FloatArray:
        """Symmetric M with mean(theta_1 theta_2) = x'Mx for two outputs without inputs, (n_states, n_states)."""
        product = self.state_rows[first].T @ self.state_rows[second] / self.n_steps
        if self.moved:
            C, last = self.plant.C, self.last_rows
            product = product + self.moved * (np.outer(last[first], last[second]) - np.outer(C[first], C[second]))
        return np.asarray((product + product.T) / 2)

    def cross_response(self, response: InputResponse, first: int, second: int) -> tuple[FloatArray, FloatArray]:
        """What inputs add to the mean product of two outputs: slope (axes, n_states) and constant (axes,)."""
        c, rows = response.path, self.state_rows
        both = c[:, first, None] * rows[second].T + c[:, second, None] * rows[first].T
        slope, product = batched.mean_over_path(both), batched.mean_over_path(c[:, first] * c[:, second])
        if self.moved:
            late, last = self.last_response(response.end), self.last_rows
            mixed = late[:, first, None] * last[second] + late[:, second, None] * last[first]
            slope, product = slope + self.moved * mixed, product + self.moved * late[:, first] * late[:, second]
        return slope, product

    def path(self, coefficients: FloatArray, input_path: FloatArray) -> FloatArray:
        """basis @ coefficients + c; coefficients (axes, any first ones), c and result (axes, n_outputs, n_steps)."""
        path = input_path.copy()
        if self._few is not self.plant:
            paths = self._with_noise[0][..., : coefficients.shape[1]]
            states = np.matmul(paths, coefficients[:, None, :, None])[..., 0]
            return np.asarray(path + np.matmul(self.plant.C, states))
        for j in range(coefficients.shape[1]):
            path += self._columns[j] * coefficients[:, j, None, None]
        return path

    def path_sd(self, covariance: FloatArray) -> FloatArray:
        """Standard deviation of the path, (axes, n_outputs, n_steps), from (axes, n_coefficients, n_coefficients)."""
        count = covariance.shape[1]
        covariance = np.ascontiguousarray(covariance)[:, None]
        if self._few is not self.plant:
            C, paths = np.ascontiguousarray(self.plant.C.T), self._with_noise[0].swapaxes(0, 1)[..., :count]
            of_states = np.matmul(np.matmul(paths, covariance), paths.swapaxes(1, 2))  # at each step
            each = [np.maximum((np.matmul(of_states[:, k], C) * C).sum(axis=1), 0.0) for k in range(self.n_steps)]
            return np.asarray(np.sqrt(np.stack(each, axis=-1)))
        variance = np.empty((len(covariance), self.plant.n_outputs, self.n_steps))
        basis = self.state_rows if count <= self.plant.n_states else self.basis
        for start in range(0, self.n_steps, _TIME_BLOCK):
            rows = np.ascontiguousarray(basis[:, start : start + _TIME_BLOCK, :count])
            variance[..., start : start + _TIME_BLOCK] = batched.dot(batched.matmul(rows, covariance), rows)
        if count > self.plant.n_states:
            variance += self.unmodelled_rest
        return np.sqrt(np.maximum(variance, 0.0))

    @cached_property
    def _columns(self) -> FloatArray:
        """The basis column by column, (n_coefficients, n_outputs, n_steps)."""
        return np.ascontiguousarray(self.basis.transpose(2, 0, 1))


def exposure_model(plant: Plant, n_steps: int, offset: float = 0.0) -> ExposureModel:
    """The model of exposures of so many fast steps that start ``offset`` of a step into their first, made once."""
    return _made_once(plant, n_steps, float(offset))


@lru_cache(maxsize=16)
def _made_once(plant: Plant, n_steps: int, offset: float) -> ExposureModel:
    from aolink.estimation.model.factored import FactoredModel  # which is one

    if offset:
        return exposure_model(plant, n_steps).starting(offset)
    systems = alike_systems(plant)
    return ExposureModel(plant, n_steps) if systems is None else FactoredModel(plant, n_steps, systems)


def by_axis(plant: Plant, inputs: FloatArray) -> FloatArray:
    """Inputs of the rig as each copy of the plant has them, (k, axes * n_inputs) -> (axes, k, n_inputs).

    Of several exposures, (exposures, k, axes * n_inputs) -> (exposures * axes, k, n_inputs). What is not a number is
    taken as zero: it must not poison every estimate that follows.
    """
    known = np.isfinite(inputs)
    finite = inputs if known.all() else np.where(known, inputs, 0.0)
    split = finite.reshape(-1, inputs.shape[-2], plant.axes, plant.n_inputs).transpose(0, 2, 1, 3)
    return split.reshape(-1, inputs.shape[-2], plant.n_inputs)


def path_from_coefficients(
    model: ExposureModel, coefficients: FloatArray, covariance: FloatArray, inputs: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Path and its standard deviation, both (axes * n_outputs, n_steps).

    Estimators and the reader of recordings both come here, so that a recorded estimate unfolds to the
    bits that the estimator gave.

    Parameters
    ----------
    coefficients:
        Of ``model.basis``, (axes, n_states) or more of its columns.
    covariance:
        Of the coefficients, (axes, n, n).
    inputs:
        The exposure's, (n_steps, axes * n_inputs); an exposure of another length has a model of its own.
    """
    plant = model.plant
    if len(inputs) != model.n_steps:
        model = exposure_model(plant, len(inputs))
    input_path, _ = input_response(plant, by_axis(plant, inputs))
    shape = (plant.axes * plant.n_outputs, model.n_steps)
    return model.path(coefficients, input_path).reshape(shape), model.path_sd(covariance).reshape(shape)
