"""aolink: a logged hardware-in-the-loop pipeline for adaptive optics and any loop closed through a slow camera.

>>> import aolink
>>> exposures = aolink.simulate("section-vi", n_exposures=3, seed=1)
>>> estimates = aolink.estimate(exposures, "moments")
>>> estimates[0].path.shape
(1, 200)
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aolink.errors import AolinkError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from aolink.estimation import Estimate
    from aolink.exposure import Exposure, Exposures
    from aolink.notebook import NotebookRecording
    from aolink.rig import Rig, load_rig
    from aolink.series import Series

    __version__: str

__all__ = ["AolinkError", "Rig", "estimate", "exposures", "load_rig", "read", "simulate", "smooth"]


if not TYPE_CHECKING:  # the type checker would accept any name

    def __getattr__(name: str) -> Any:
        """Load names that need SciPy, and the version, at their first use, so that a command handles signals before
        that."""
        if name in ("Rig", "load_rig"):
            import aolink.rig

            return getattr(aolink.rig, name)
        if name == "__version__":
            from importlib.metadata import version

            return version("aolink")
        raise AttributeError(f"module 'aolink' has no attribute {name!r}")


def read(path: str | Path, side: Sequence[str | Path] = ()) -> NotebookRecording:
    """Open a recording: a series of exposures, read when they are used.

    ``len(recording)``, ``recording[7]``, ``recording[-10:]`` and a loop give exposures; ``to_pandas()``,
    ``to_xarray()`` and ``plot()`` are for notebooks, and include the estimates in the file.

    Parameters
    ----------
    path:
        A file, or a URL that fsspec knows (``pip install 'aolink[remote]'``).
    side:
        Side files of the recording, whose estimates replace its own by the same names.

    Returns
    -------
    A `Recording`, which is an `aolink.series.Series` of exposures; `aolink.exposure.Exposure` states the shape and unit
    of each field.

    Raises
    ------
    RecordingError
        The file cannot be read, or is not a recording of aolink; or a side file is not of this recording.
    """
    from aolink.notebook import NotebookRecording

    return NotebookRecording(path, side=side)


def simulate(rig: Rig | str | Path, n_exposures: int, seed: int | None = None) -> Exposures:
    """Exposures of a simulated rig with their truth, in memory: the model behind `aolink rig`, without a wire.

    Parameters
    ----------
    rig:
        A rig, a rig file, or the name of one that comes with aolink.
    n_exposures:
        Number of exposures.
    seed:
        Seed of all random numbers; that of the rig file where None.

    Returns
    -------
    A sequence of `aolink.exposure.Exposure`, each with its ``truth``, and with ``rig``, the rig that they are from.

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


def exposures(
    frames: NDArray[Any], rig: Rig | str | Path, inputs: NDArray[Any] | None = None,
    start_steps: Sequence[int] | None = None,
) -> Exposures:  # fmt: skip
    """Exposures of frames in memory, to `estimate` and `smooth` them.

    Parameters
    ----------
    frames:
        Counts of the rig's camera, (exposures, rows, columns): whole numbers of any type, from 0 to full scale.
    rig:
        A rig, a rig file, or the name of one that comes with aolink.
    inputs:
        Inputs that the mirror held in each fast step from step 0 on, in the mirror's units, (steps, n_inputs), up to
        the end of the last exposure at least; None: its parked input.
    start_steps:
        Fast step at which each exposure starts, (exposures,), in order and without overlap; None: the first starts at
        step 0, each other one a frame period after the one before.

    Returns
    -------
    A sequence of `aolink.exposure.Exposure` without truth, whose ``frame_id`` counts from 1.

    Raises
    ------
    ImportingError
        The arrays do not fit the rig or each other; the message says what was expected.
    RigError
        The rig file cannot be read or cannot work.
    """
    from aolink.importing.exposures import exposures as made
    from aolink.rig import Rig, load_rig

    return made(frames, rig if isinstance(rig, Rig) else load_rig(rig), inputs, start_steps)


def estimate(exposures: Exposures | Series | str | Path, estimator: str) -> list[Estimate]:
    """Estimates of the motion inside each exposure, in their order.

    Parameters
    ----------
    exposures:
        The result of `simulate` or `exposures`, or a recording, a slice of one, or its path.
    estimator:
        One of `aolink.estimation.ESTIMATOR_NAMES`, which options may follow: ``"moments:orders=012"``.

    Returns
    -------
    One estimate for each exposure. Paths are in slope units and states in the plant's units;
    `aolink.estimation.Estimate` states the shape of each field. An exposure that cannot be used has a prediction, whose
    ``status`` and ``reason`` say so.

    Raises
    ------
    EstimatorError
        There is no such estimator or option, it cannot work on this rig, or ``exposures`` are none of these.
    RecordingError
        ``exposures`` is a path, and no recording can be read from it.
    """
    from aolink.estimation import Driver

    rig, series = _opened(exposures)
    return [result for _, (result,) in Driver(rig, [estimator]).steps(series)]


def smooth(
    exposures: Exposures | Series | str | Path, estimates: list[Estimate], lag: int | None = None
) -> list[Estimate]:
    """Estimates of `estimate`, each corrected by later exposures. It works offline only.

    It is the Rauch-Tung-Striebel smoother, or backward simulation for estimators that carry a Gaussian mixture.

    Parameters
    ----------
    exposures:
        The exposures that `estimate` was given.
    estimates:
        Its result for them.
    lag:
        Number of later exposures that correct each; None: all of them.

    Returns
    -------
    One estimate for each given one, with other states, paths and covariances; status, innovation and NIS are kept.

    Raises
    ------
    EstimatorError
        The estimates are not those of the exposures, the lag is negative, or ``exposures`` are none of these.
    RecordingError
        ``exposures`` is a path, and no recording can be read from it.
    """
    from aolink.estimation import smooth as smooth_estimates

    rig, series = _opened(exposures)
    return smooth_estimates(rig.plant, list(series), estimates, lag)


def _opened(exposures: Exposures | Series | str | Path) -> tuple[Rig, Iterable[Exposure]]:
    """The rig of exposures, and the exposures one after the other."""
    from aolink.errors import EstimatorError
    from aolink.exposure import Exposures
    from aolink.series import Series

    if isinstance(exposures, str | Path):
        exposures = read(exposures)
    if isinstance(exposures, Exposures):
        return exposures.rig, exposures
    if isinstance(exposures, Series):
        return exposures.rig, exposures.exposures()
    raise EstimatorError(
        "exposures must know their rig, as those of aolink.simulate, aolink.exposures and aolink.read do, or be the"
        f" path of a recording, found {type(exposures).__name__}: give aolink.exposures(frames, rig) for arrays"
    )
