"""Estimation: the motion inside each exposure, from its blur. Pure: no time, no files, no ports."""

from aolink.estimation.driver import Driver, run
from aolink.estimation.estimate import Estimate, Status
from aolink.estimation.frames.moments import Measurement, measure_moments
from aolink.estimation.frames.plane_moments import measure_moments_2d
from aolink.estimation.kalman.filter import BlurFilter
from aolink.estimation.kalman.observation import PathMoments
from aolink.estimation.model.exposure_model import ExposureModel, exposure_model, path_from_coefficients
from aolink.estimation.moments.spots import SpotWindows, WindowedSpots
from aolink.estimation.moments.windowed import Profile, WindowedMoments
from aolink.estimation.options import Engine, Options
from aolink.estimation.registry import ESTIMATOR_NAMES, Estimator, make_estimator
from aolink.estimation.score import Consistency, Score, Scorer, score
from aolink.estimation.smoother import smooth

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
