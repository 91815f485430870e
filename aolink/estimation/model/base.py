"""One exposure: start state, end state and path as one joint Gaussian.

With z = (x(k0), xi), xi ~ N(0, I) the coefficients of the process noise inside the exposure,

    path = basis z + c(u),     x(k0 + N) = end_rows z + d(u) + remainder.

Every estimator is an update of z; they differ in what they observe, and in whether they model xi.

Where the plant says so (`UnmodelledSlopes`), xi begins with one coefficient for each output: the mean over the exposure
of the slopes v that the plant does not make, in their standard deviations. It moves the output for the whole exposure
and leaves the end state alone. The variation of v about its mean has no coefficient; it widens spots by its variance,
and the standard deviation of a path contains it.

The spot rests at theta(k) for the whole of fast step k, as in the sum of Mishra & Wen (12). An exposure that starts a
part f of a step late loses that part of its first step and gains the same part of the one after its last: a mean over
it is (1/N) [sum_i g(theta_i) + f g(theta_N) - f g(theta_0)]. Start state, end state and path stay those of whole steps.

Where the camera sees the outputs one after the other (`Plant.delays`), the path covers all steps from the first one's
interval to the last one's, and a mean is that over the output's own interval, of whole steps.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray
from aolink.plant.lifting import input_response, lift
from aolink.rig import Plant


@dataclass(frozen=True, kw_only=True, eq=False)
class InputResponse:
    """The response of outputs and end state to the inputs of one exposure, and the means over it that moments need."""

    end: FloatArray
    """d, response of the end state, (axes, n_states)."""
    mean: FloatArray
    """Mean of c over the exposure, (axes, n_outputs)."""
    slope: FloatArray
    """b, mean of C A^i weighted with c_i, (axes, n_outputs, n_states)."""
    square: FloatArray
    """s, mean of c squared, (axes, n_outputs)."""
    whole: Callable[[], FloatArray]
    """A function that gives c: the paper's estimators need only its means."""

    @cached_property
    def path(self) -> FloatArray:
        """c, response of the outputs, (axes, n_outputs, n_steps)."""
        return self.whole()

    def of(self, some: slice) -> InputResponse:
        """The response of some of the axes."""
        return InputResponse(
            end=self.end[some], mean=self.mean[some], slope=self.slope[some], square=self.square[some],
            whole=lambda: self.path[some],
        )  # fmt: skip


class Dynamics(NamedTuple):
    """How an error of an exposure's coefficients goes on to the next exposure."""

    transition: FloatArray
    """A^N, (n_states, n_states)."""
    end_rows: FloatArray
    """End states of the coefficients, (n_states, n)."""
    gram: FloatArray
    """Mean of (C A^i)'(C A^i) over the steps, summed over the outputs, (n_states, n_states)."""


class ExposureModel(ABC):
    """The joint Gaussian of one exposure of a plant, precomputed; it holds no state.

    `exposure_model` makes one: dense, or factored where the plant consists of many equal systems.
    """

    def __init__(self, plant: Plant, n_steps: int, mean_row: FloatArray) -> None:
        self.plant, self.n_steps = plant, n_steps
        self.transition, self.process_noise = lift(plant, n_steps)
        self.mean_row = mean_row
        """C-bar, (n_outputs, n_states)."""
        self.delays = plant.delays if n_steps > plant.last_delay else ()
        self.exposed_steps = n_steps - max(self.delays, default=0)
        """N, the exposure of one output; fewer than ``n_steps`` where the outputs have delays."""
        self.moved = 0.0
        """f/N: the share of the exposure that is in the step after its last, and not in its first."""
        unmodelled = plant.unmodelled
        mean, rest = unmodelled.variances(self.exposed_steps) if unmodelled else (0.0, 0.0)
        self.n_unmodelled = plant.n_outputs if unmodelled else 0
        """Coefficients of `UnmodelledSlopes`, which come after the start state; the process noise comes after them."""
        self.unmodelled_sd = float(np.sqrt(mean))
        """Standard deviation of their means over the exposure, slope units."""
        self.unmodelled_rest = rest
        """Mean variance of them about these means, slope units squared."""

    @property
    @abstractmethod
    def state_rows(self) -> FloatArray:
        """C A^i, (n_outputs, n_steps, n_states)."""

    @property
    @abstractmethod
    def basis(self) -> FloatArray:
        """Paths of the coefficients, (n_outputs, n_steps, n_coefficients); the first n_states are C A^i."""

    @property
    @abstractmethod
    def factors(self) -> tuple[FloatArray | None, FloatArray]:
        """The basis in the form of recordings: a matrix from factors to outputs, where there is one, and the
        factors."""

    @property
    @abstractmethod
    def end_rows(self) -> FloatArray:
        """End states of the coefficients, (n_states, n_coefficients)."""

    @property
    @abstractmethod
    def end_remainder(self) -> FloatArray:
        """Covariance of the part of the end state that the noise coefficients leave out, (n_states, n_states)."""

    @abstractmethod
    def mixed_rows(self, weights: FloatArray, count: int) -> FloatArray:
        """Sums of the outputs as the first ``count`` coefficients make them, weights (k, n_outputs).

        (k, n_steps, count)
        """

    @abstractmethod
    def responses(self, inputs: FloatArray) -> InputResponse:
        """The responses of `response` for many exposures, inputs (exposures, n_steps, axes * n_inputs), in a fraction
        of the calls.

        Inputs are numbers, as `numbers` gives them.
        The first axis has all axes of the first exposure, then of the second, with the same bits as for each alone.
        """

    @abstractmethod
    def times_quadratic(self, state: FloatArray) -> FloatArray:
        """M x for each output, states (axes, n_states) -> (axes, n_outputs, n_states)."""

    @abstractmethod
    def path(self, coefficients: FloatArray, input_path: FloatArray) -> FloatArray:
        """basis @ coefficients + c; coefficients (axes, any first ones), c and result (axes, n_outputs, n_steps)."""

    @abstractmethod
    def path_sd(self, covariance: FloatArray) -> FloatArray:
        """Standard deviation of the path, (axes, n_outputs, n_steps), from (axes, n_coefficients, n_coefficients)."""

    def starting(self, offset: float) -> Self:
        """The model for exposures that start ``offset`` of a fast step into their first one, 0 <= offset < 1."""
        if not 0 <= offset < 1:
            raise ValueError(f"an exposure starts from 0 to 1 fast step into its first one, not {offset:g}")
        if self.delays:  # they are rounded to whole steps
            return self
        _ = self.factors, self.end_rows  # made once, for all offsets
        model = copy(self)
        model.moved = offset / self.n_steps
        first, last = self.plant.C, self.last_rows
        model.mean_row = self.mean_row + model.moved * (last - first)
        model.__dict__.pop("quadratic", None)  # it depends on the offset
        return model

    @cached_property
    def quadratic(self) -> FloatArray:
        """M = mean_i (C A^i)'(C A^i) for each output, (n_outputs, n_states, n_states)."""
        rows = self.seen(self.state_rows)
        mean = np.einsum("oij,oik->ojk", rows, rows) / self.exposed_steps
        if not self.moved:
            return np.asarray(mean)
        first, last = self.plant.C, self.last_rows
        squares = last[:, :, None] * last[:, None, :] - first[:, :, None] * first[:, None, :]
        return np.asarray(mean + self.moved * squares)

    @cached_property
    def path_gram(self) -> FloatArray:
        """Mean of (C A^i)'(C A^i) over the steps, summed over the outputs, (n_states, n_states)."""
        return np.asarray(self.quadratic.sum(axis=0))

    @property
    def dynamics(self) -> Dynamics:
        """Of all its coefficients."""
        return Dynamics(self.transition, self.end_rows, self.path_gram)

    @cached_property
    def last_rows(self) -> FloatArray:
        """C A^N, outputs in the step after the last, (n_outputs, n_states)."""
        return np.asarray(self.plant.C @ self.transition)

    @property
    def rows_after(self) -> FloatArray:
        """Basis of the outputs in the step after the last, (n_outputs, n_coefficients)."""
        rows = np.asarray(self.plant.C @ self.end_rows)
        n = self.plant.n_states
        rows[:, n : n + self.n_unmodelled] = self.unmodelled_sd * np.eye(len(rows), self.n_unmodelled)
        return rows

    @property
    def n_coefficients(self) -> int:
        """States, unmodelled slopes and noise coefficients together."""
        return int(self.end_rows.shape[1])

    def seen(self, values: FloatArray) -> FloatArray:
        """The values of each output in its own interval, (..., n_outputs, n_steps, k) -> (..., n_outputs,
        exposed_steps, k)."""
        if not self.delays:
            return values
        own = [values[..., o, d : d + self.exposed_steps, :] for o, d in enumerate(self.delays)]
        return np.stack(own, axis=-3)

    def seen_path(self, path: FloatArray) -> FloatArray:
        """A path as `seen`, (..., n_outputs, n_steps)."""
        return self.seen(path[..., None])[..., 0]

    def response(self, inputs: FloatArray) -> InputResponse:
        """Response to the inputs of an exposure, (n_steps, axes * n_inputs)."""
        return self.responses(numbers(inputs[None]))

    def last_response(self, end: FloatArray) -> FloatArray:
        """c_N, response of the outputs in the step after the last to that of the end state, (axes, n_outputs)."""
        return batched.matvec(self.plant.C, end)


def over_steps(plant: Plant, inputs: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Transition, noise and response of the states over one or more steps with these inputs, (k, axes * n_inputs)."""
    _, kick = input_response(plant, by_axis(plant, numbers(inputs)))
    return *lift(plant, len(inputs)), kick


def numbers(inputs: FloatArray) -> FloatArray:
    """Inputs with zero for what is not a number: it must not poison every estimate that follows."""
    return inputs if are_numbers(inputs) else np.where(np.isfinite(inputs), inputs, 0.0)


def are_numbers(inputs: FloatArray) -> bool:
    """Whether no input is NaN or infinite: each extreme is NaN where one of them is.

    Twice as fast as `numpy.isfinite` for the megabytes of a thousand axes, which need an array for its answers.
    """
    return inputs.size == 0 or all(
        math.isfinite(extreme.reduce(inputs, axis=None)) for extreme in (np.minimum, np.maximum)
    )


def by_axis(plant: Plant, inputs: FloatArray) -> FloatArray:
    """Inputs of the rig as each copy of the plant has them, (k, axes * n_inputs) -> (axes, k, n_inputs).

    Inputs of several exposures are split alike, (exposures, k, axes * n_inputs) -> (exposures * axes, k, n_inputs).
    """
    split = inputs.reshape(-1, inputs.shape[-2], plant.axes, plant.n_inputs).transpose(0, 2, 1, 3)
    return split.reshape(-1, inputs.shape[-2], plant.n_inputs)
