"""Estimation: the motion inside each exposure, from its blur. Pure: no time, no files, no ports."""

from aolink.estimation.driver import Driver, run
from aolink.estimation.estimate import Estimate, Status
from aolink.estimation.estimators import ESTIMATOR_NAMES, Estimator, make_estimator
from aolink.estimation.exposure_model import ExposureModel, exposure_model, path_from_coefficients
from aolink.estimation.filter import BlurFilter
from aolink.estimation.moments import Measurement, measure_moments
from aolink.estimation.moments2d import measure_moments_2d
from aolink.estimation.observation import PathMoments
from aolink.estimation.options import Engine, Options
from aolink.estimation.score import Consistency, Score, Scorer, score
from aolink.estimation.smoother import smooth
from aolink.estimation.windowed import Profile, WindowedMoments
from aolink.estimation.windowed_spots import SpotWindows, WindowedSpots

__all__ = [
    "ESTIMATOR_NAMES",
    "BlurFilter",
    "Consistency",
    "Driver",
    "Engine",
    "Estimate",
    "Estimator",
    "ExposureModel",
    "Measurement",
    "Options",
    "PathMoments",
    "Profile",
    "Score",
    "Scorer",
    "SpotWindows",
    "Status",
    "WindowedMoments",
    "WindowedSpots",
    "exposure_model",
    "make_estimator",
    "measure_moments",
    "measure_moments_2d",
    "path_from_coefficients",
    "run",
    "score",
    "smooth",
]
