"""Estimation of the motion inside each exposure, from its blur. The subpackage is pure: no time, no files, no ports."""

from typing import TYPE_CHECKING, Any

from aolink.estimation.score import Consistency, Score, Scorer, score  # at once: one has the name of its module

if TYPE_CHECKING:
    from aolink.estimation.driver import Driver, run
    from aolink.estimation.estimate import Estimate, Status
    from aolink.estimation.estimator import Estimator
    from aolink.estimation.frames.frame_data import Measurement, Needs, Profile, SpotWindows
    from aolink.estimation.frames.moments import measure_moments
    from aolink.estimation.frames.plane_moments import measure_moments_2d
    from aolink.estimation.kalman.filter import BlurFilter, Filter, Posterior
    from aolink.estimation.kalman.gaussian import Gaussian, Update
    from aolink.estimation.kalman.path_moments import PathMoments
    from aolink.estimation.kalman.update import joseph_update
    from aolink.estimation.model.base import ExposureModel
    from aolink.estimation.model.exposure_model import exposure_model, path_from_coefficients
    from aolink.estimation.moments.windowed import WindowedMoments
    from aolink.estimation.options import Engine, Options
    from aolink.estimation.registry import EstimatorRow, estimator_row, estimator_rows, make_estimator
    from aolink.estimation.smoother import smooth

    ESTIMATOR_NAMES: tuple[str, ...]
    """The names that `make_estimator` knows, by rank."""
else:  # the type checker would accept any name
    from aolink.names import at_first_use

    _load = at_first_use(
        __name__,
        {
            "driver": "Driver run",
            "estimate": "Estimate Status",
            "estimator": "Estimator",
            "frames.frame_data": "Measurement Needs Profile SpotWindows",
            "frames.moments": "measure_moments",
            "frames.plane_moments": "measure_moments_2d",
            "kalman.filter": "BlurFilter Filter Posterior",
            "kalman.gaussian": "Gaussian Update",
            "kalman.path_moments": "PathMoments",
            "kalman.update": "joseph_update",
            "model.base": "ExposureModel",
            "model.exposure_model": "exposure_model path_from_coefficients",
            "moments.windowed": "WindowedMoments",
            "options": "Engine Options",
            "registry": "EstimatorRow estimator_row estimator_rows make_estimator",
            "smoother": "smooth",
        },
    )

    def __getattr__(name: str) -> Any:
        """Search other packages for estimators, too, but only when all names are asked for."""
        if name == "ESTIMATOR_NAMES":
            from aolink.estimation.registry import estimator_rows

            return tuple(row.name for row in estimator_rows())
        return _load(name)


__all__ = [
    "ESTIMATOR_NAMES", "BlurFilter", "Consistency", "Driver", "Engine", "Estimate", "Estimator", "EstimatorRow",
    "ExposureModel", "Filter", "Gaussian", "Measurement", "Needs", "Options", "PathMoments", "Posterior", "Profile",
    "Score", "Scorer", "SpotWindows", "Status", "Update", "WindowedMoments", "estimator_row",
    "estimator_rows", "exposure_model", "joseph_update", "make_estimator", "measure_moments", "measure_moments_2d",
    "path_from_coefficients", "run", "score", "smooth",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
