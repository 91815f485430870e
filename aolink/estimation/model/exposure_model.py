"""The model of exposures of a plant, made once, and the paths of its coefficients."""

from __future__ import annotations

from functools import lru_cache

from aolink.estimation.model.base import ExposureModel, by_axis, numbers
from aolink.estimation.model.dense import DenseModel
from aolink.estimation.model.factored import FactoredModel
from aolink.numerics.arrays import FloatArray
from aolink.plant.alike import alike_systems
from aolink.plant.lifting import input_response
from aolink.rig import Plant


def exposure_model(plant: Plant, n_steps: int, offset: float = 0.0) -> ExposureModel:
    """The model of exposures of ``n_steps`` fast steps that start ``offset`` of a step into their first, made once."""
    return _starting(plant, n_steps, float(offset)) if offset else _on_a_step(plant, n_steps)


@lru_cache(maxsize=64)
def _starting(plant: Plant, n_steps: int, offset: float) -> ExposureModel:
    return _on_a_step(plant, n_steps).starting(offset)


@lru_cache(maxsize=256)  # more than the estimators that a scan of frequencies runs side by side
def _on_a_step(plant: Plant, n_steps: int) -> ExposureModel:
    systems = alike_systems(plant)
    return DenseModel(plant, n_steps) if systems is None else FactoredModel(plant, n_steps, systems)


def path_from_coefficients(
    model: ExposureModel, coefficients: FloatArray, covariance: FloatArray, inputs: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Path and its standard deviation, both (axes * n_outputs, n_steps), from coefficients of ``model.basis``, (axes,
    n_states) or more of its columns, their covariance, (axes, n, n), and the exposure's inputs, (n_steps, axes *
    n_inputs). An exposure of another length has a model of its own.
    """
    return path_of(model, coefficients, inputs), path_sd_of(model, covariance, len(inputs))


def path_of(model: ExposureModel, coefficients: FloatArray, inputs: FloatArray) -> FloatArray:
    """The path of `path_from_coefficients`; many times as fast as its standard deviation on a plant of many states."""
    plant, model = model.plant, _of_length(model, len(inputs))
    input_path, _ = input_response(plant, by_axis(plant, numbers(inputs)))
    return model.path(coefficients, input_path).reshape(-1, model.n_steps)


def path_sd_of(model: ExposureModel, covariance: FloatArray, n_steps: int) -> FloatArray:
    """The standard deviation of `path_from_coefficients`."""
    return _of_length(model, n_steps).path_sd(covariance).reshape(-1, n_steps)


def _of_length(model: ExposureModel, n_steps: int) -> ExposureModel:
    return model if n_steps == model.n_steps else exposure_model(model.plant, n_steps)
