"""Estimation: the motion inside each exposure, from its blur. Pure: no time, no files, no ports."""

from aolink.estimation.estimate import Estimate, Status
from aolink.estimation.estimators import ESTIMATOR_NAMES, Driver, Estimator, Options, make_estimator, run
from aolink.estimation.exposure_model import ExposureModel, exposure_model, path_from_coefficients
from aolink.estimation.score import Consistency, Score, score

__all__ = [
    "ESTIMATOR_NAMES",
    "Consistency",
    "Driver",
    "Estimate",
    "Estimator",
    "ExposureModel",
    "Options",
    "Score",
    "Status",
    "exposure_model",
    "make_estimator",
    "path_from_coefficients",
    "run",
    "score",
]
