"""aolink: a logged hardware-in-the-loop pipeline for adaptive optics and any loop closed through a slow camera.

>>> import aolink
>>> exposures = aolink.simulate("section-vi", n_exposures=3, seed=1)
>>> estimates = aolink.estimate(exposures, "o3")
>>> estimates[0].path.shape
(1, 200)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aolink.errors import AolinkError

if TYPE_CHECKING:
    from aolink.estimation import Estimate
    from aolink.exposure import Exposures
    from aolink.recording.reader import Recording
    from aolink.rig import Rig, load_rig

    __version__: str

__all__ = ["AolinkError", "Rig", "estimate", "load_rig", "read", "simulate", "smooth"]


if not TYPE_CHECKING:  # the type checker would believe in any name

    def __getattr__(name: str) -> Any:
        """What needs SciPy, or a search for the version, is loaded when it is used: a command hears signals before."""
        if name in ("Rig", "load_rig"):
            import aolink.rig

            return getattr(aolink.rig, name)
        if name == "__version__":
            from importlib.metadata import version

            return version("aolink")
        raise AttributeError(f"module 'aolink' has no attribute {name!r}")


def read(path: str | Path, side: Sequence[str | Path] = ()) -> Recording:
    """Open a recording: what it gives when iterated over are its exposures, read one after the other.

    Parameters
    ----------
    path:
        A file, or a URL that fsspec knows (``pip install 'aolink[remote]'``).
    side:
        Side files of it, whose estimates stand in the place of its own.

    Raises
    ------
    RecordingError
        It cannot be read, or is not a recording of aolink; a side file is not of this recording.
    """
    from aolink.recording.reader import Recording

    return Recording(path, side=side)


def simulate(rig: Rig | str | Path, n_exposures: int, seed: int | None = None) -> Exposures:
    """Exposures of a simulated rig with their truth, in memory: the model behind `aolink rig`, without a wire.

    Parameters
    ----------
    rig:
        A rig, a rig file, or the name of one that comes with aolink.
    n_exposures:
        How many.
    seed:
        Instead of the rig file's own.

    Raises
    ------
    RigError
        The rig file cannot be read or cannot work.
    """
    from aolink.exposure import Exposures
    from aolink.rig import Rig, load_rig
    from aolink.simulation.model import simulate as simulate_exposures

    rig = rig if isinstance(rig, Rig) else load_rig(rig)
    return Exposures(rig, tuple(simulate_exposures(rig, n_exposures, seed)))


def estimate(exposures: Exposures | Recording | str | Path, estimator: str) -> list[Estimate]:
    """Estimates of the motion inside each exposure.

    Parameters
    ----------
    exposures:
        What `simulate` gave, or a recording or its path.
    estimator:
        One of `aolink.estimation.ESTIMATOR_NAMES`.

    Raises
    ------
    EstimatorError
        There is no such estimator.
    """
    from aolink.estimation import Driver
    from aolink.exposure import Exposures

    if isinstance(exposures, str | Path):
        exposures = read(exposures)
    series = exposures if isinstance(exposures, Exposures) else exposures.exposures()
    driver = Driver(exposures.rig, [estimator])
    return [result for _, (result,) in driver.steps(series)]


def smooth(exposures: Exposures | Recording | str | Path, estimates: list[Estimate]) -> list[Estimate]:
    """Estimates of `estimate` corrected by all that came later: offline, with the same fields.

    Parameters
    ----------
    exposures:
        What `estimate` was given.
    estimates:
        What it gave.

    Raises
    ------
    EstimatorError
        The estimates are not those of the exposures.
    """
    from aolink.estimation import smooth as smooth_estimates
    from aolink.exposure import Exposures

    if isinstance(exposures, str | Path):
        exposures = read(exposures)
    series = exposures if isinstance(exposures, Exposures) else list(exposures.exposures())
    return smooth_estimates(exposures.rig.plant, series, estimates)
