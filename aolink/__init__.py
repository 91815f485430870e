"""aolink: a logged hardware-in-the-loop pipeline for adaptive optics and any loop closed through a slow camera.

>>> import aolink
>>> series = aolink.estimate(aolink.simulate("section-vi", n_exposures=3, seed=1), "moments")
>>> series.estimates()[0].path.shape
(1, 200)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aolink.errors import AolinkError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from aolink.estimation import Estimate
    from aolink.recording.compare import compare
    from aolink.recording.reader import Recording
    from aolink.rig import Rig, load_rig
    from aolink.series import Series
    from aolink.session import record
    from aolink.session.replay import replay
    from aolink.viewing.feed import show as view

    __version__: str

__all__ = [
    "AolinkError", "Rig", "compare", "estimate", "exposures", "load_rig", "read", "record", "replay", "simulate",
    "smooth", "view",
]  # fmt: skip


if not TYPE_CHECKING:  # the type checker would accept any name
    _AT_FIRST_USE = {
        "Rig": "rig", "load_rig": "rig", "record": "session", "replay": "session.replay",
        "compare": "recording.compare", "view": "viewing.feed",
    }  # fmt: skip

    def __getattr__(name: str) -> Any:
        """Load names that need SciPy, and the version, at their first use, so that a command handles signals before
        that."""
        if name in _AT_FIRST_USE:
            from importlib import import_module

            return getattr(import_module(f"aolink.{_AT_FIRST_USE[name]}"), "show" if name == "view" else name)
        if name == "__version__":
            from importlib.metadata import version

            return version("aolink")
        raise AttributeError(f"module 'aolink' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def read(path: str | Path, side: Sequence[str | Path] = (), *, rig: Rig | str | Path | None = None) -> Recording:
    """Open a recording: a series of exposures, read when they are used.

    ``len(recording)``, ``recording[7]`` and a loop give exposures, ``recording[-10:]`` a part, ``recording.walk()`` the
    exposures with their estimates; ``to_pandas()``, ``to_xarray()`` and ``plot()`` are for notebooks.

    Parameters
    ----------
    path:
        The file.
    side:
        Side files of the recording, whose estimates replace its own by the same names.
    rig:
        A rig, a rig file or the name of one that comes with aolink, instead of the recording's own for new estimates.

    Returns
    -------
    An `aolink.series.Series` of exposures; `aolink.exposure.Exposure` states the shape and unit of each field.

    Raises
    ------
    RecordingError
        The file cannot be read, or is not a recording of aolink; or a side file is not of this recording.
    RigError
        The rig file cannot be read, or cannot stand in for the recording's own.
    """
    from aolink.arguments import path as path_of
    from aolink.recording.reader import Recording
    from aolink.rig import rig_of

    return Recording(path_of(path, "path"), side=side, rig=None if rig is None else rig_of(rig))


def simulate(rig: Rig | str | Path, n_exposures: int, seed: int | None = None) -> Series:
    """Exposures of a simulated rig with their truth, in memory: the model behind `aolink sim`, without a wire.

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
    An `aolink.series.Series` of exposures, each with its ``truth``.

    Raises
    ------
    RigError
        The rig file cannot be read or cannot work.
    """
    from aolink.arguments import whole_number
    from aolink.rig import rig_of
    from aolink.series import in_memory
    from aolink.simulation.model import simulate as simulate_exposures

    rig, count = rig_of(rig), whole_number(n_exposures, "n_exposures")
    return in_memory(rig, simulate_exposures(rig, count, None if seed is None else whole_number(seed, "seed")))


def exposures(
    frames: NDArray[Any], rig: Rig | str | Path, inputs: NDArray[Any] | None = None,
    start_steps: Sequence[int] | None = None,
) -> Series:  # fmt: skip
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
    An `aolink.series.Series` of exposures without truth, whose ``frame_id`` counts from 1.

    Raises
    ------
    ImportingError
        The arrays do not fit the rig or each other; the message says what was expected.
    RigError
        The rig file cannot be read or cannot work.
    """
    from aolink.importing.exposures import exposures as made
    from aolink.rig import rig_of

    return made(frames, rig_of(rig), inputs, start_steps)


def estimate(exposures: Series | str | Path, estimators: str | Sequence[str]) -> Series:
    """Estimates of the motion inside each exposure.

    Parameters
    ----------
    exposures:
        The result of `simulate`, `exposures` or `read`, a part of it, or the path of a recording.
    estimators:
        One or several of `aolink.estimation.ESTIMATOR_NAMES`, which options may follow: ``"o3:second_order"``.

    Returns
    -------
    The same series with the new estimates beside, or instead of, its own: ``estimates(name)`` lists them, ``walk()``
    gives them with their exposures. Paths are in slope units and states in the plant's units;
    `aolink.estimation.Estimate` states the shape of each field. An exposure that cannot be used has a prediction, whose
    ``status`` and ``reason`` say so.

    Raises
    ------
    EstimatorError
        There is no such estimator or option, it cannot work on this rig, or ``exposures`` are none of these.
    RecordingError
        ``exposures`` is a path, and no recording can be read from it.
    """
    from aolink.arguments import names
    from aolink.estimation import run
    from aolink.series import with_estimates

    series = _opened(exposures)
    return with_estimates(series, run(series.rig, series, names(estimators, "estimators")))


def smooth(series: Series | str | Path, lag: int | None = None, *, estimators: str | Sequence[str] = ()) -> Series:
    """The same series with estimates that are each corrected by later exposures: the Rauch-Tung-Striebel smoother.

    It works offline only.

    Parameters
    ----------
    series:
        The result of `estimate`, or a recording with estimates.
    lag:
        Number of later exposures that correct each; None: all of them.
    estimators:
        The estimators whose estimates are smoothed; all by default.

    Returns
    -------
    The series with other states, paths and covariances; status, innovation and NIS are kept.

    Raises
    ------
    EstimatorError
        An exposure has no estimate, the lag is negative, or ``series`` is none of these.
    RecordingError
        There are no such estimates, or no recording can be read from the path.
    """
    from aolink.arguments import names as names_of
    from aolink.errors import EstimatorError
    from aolink.estimation import smooth as smooth_estimates
    from aolink.series import with_estimates

    if lag is not None and not isinstance(lag, int):
        raise EstimatorError(
            "smooth takes a series with its estimates, as estimate gives it: aolink.smooth(series, lag=3)"
        )
    opened = _opened(series)
    names = opened.named(names_of(estimators, "estimators") or None)
    walked = list(opened.walk(names))
    of_each = {name: [found[name] for _, found in walked if name in found] for name in names}
    plant, all_exposures = opened.rig.plant, [exposure for exposure, _ in walked]
    made: dict[str, list[Estimate]] = {
        name: smooth_estimates(plant, all_exposures, estimates, lag) for name, estimates in of_each.items()
    }
    return with_estimates(opened, made)


def _opened(exposures: Series | str | Path) -> Series:
    """A series that is given, or read from a path."""
    from aolink.errors import EstimatorError
    from aolink.series import Series

    if isinstance(exposures, str | Path):
        exposures = read(exposures)
    if not isinstance(exposures, Series):
        raise EstimatorError(
            "exposures must know their rig, as those of aolink.simulate, aolink.exposures and aolink.read do, or be the"
            f" path of a recording, found {type(exposures).__name__}: give aolink.exposures(frames, rig) for arrays"
        )
    return exposures
