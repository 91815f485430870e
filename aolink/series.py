"""The class `Series`: exposures of one rig and their estimates, from a recording or in memory."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol, overload

import numpy as np

from aolink.errors import RecordingError
from aolink.estimation.estimate import Estimate
from aolink.exposure import Exposure
from aolink.rig import Rig
from aolink.units import duration

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

_READ_THROUGH = 32
"""Exposures between two wanted ones that are read and left out: to begin anew behind them would take longer."""


@dataclass(eq=False, slots=True)
class Step:
    """An exposure of a series with what belongs to it."""

    number: int
    """Its number in the source, counted from 0; frames that cannot be used have numbers too."""
    exposure: Exposure
    estimates: dict[str, Estimate] = field(default_factory=dict)
    """Its estimates by the estimators' names, of those that have one."""
    skipped: set[str] = field(default_factory=set)
    """Names of the estimators that had no time for it in the session."""
    time_ns: int = 0
    """Log time of the message that completed it, ns; 0 where there is no log."""


Also = Mapping[str, Callable[[str, int, Any], None]]
"""Functions that get a recording's messages as they are read, by topic: topic, log time in ns, message."""
NOTHING: Also = MappingProxyType({})


class Source(Protocol):
    """What a series is read from, in one pass for any run of exposures."""

    @property
    def rig(self) -> Rig: ...
    @property
    def path(self) -> Any: ...
    @property
    def metadata(self) -> dict[str, str]: ...
    @property
    def estimators(self) -> list[str]: ...
    @property
    def has_truth(self) -> bool: ...
    @property
    def damage(self) -> str: ...
    def __len__(self) -> int: ...
    def steps(
        self, names: Sequence[str] = (), start: int = 0, stop: int | None = None, *, also: Also = NOTHING
    ) -> Iterator[Step]: ...


class Series(Sequence[Exposure]):
    """Exposures in order, with the estimates that were made of them; nothing is read before it is used.

    ``len(series)``, ``series[7]`` and a loop give exposures. ``series[-10:]``, ``series[::2]``, ``series[[3, 8]]`` and
    ``series[mask]`` are series too: these exposures and their estimates, the same bits as in the whole. Estimators that
    are run on a part begin anew there.
    """

    def __init__(self, source: Source, numbers: Sequence[int] | None = None) -> None:
        self.source = source
        self._numbers = numbers
        self.rig = source.rig
        self.path = source.path
        """The file of the exposures."""
        self.metadata = source.metadata
        """Facts about the session."""

    @property
    def numbers(self) -> Sequence[int]:
        """Numbers of these exposures in the source, counted from 0."""
        return range(len(self.source)) if self._numbers is None else self._numbers

    @property
    def estimators(self) -> list[str]:
        """Names of the estimators whose results are there."""
        return self.source.estimators

    @property
    def has_truth(self) -> bool:
        """Whether the truth is known, for some exposures at least."""
        return self.source.has_truth

    def __len__(self) -> int:
        return len(self.numbers)

    def __bool__(self) -> bool:
        return True  # an empty recording is a recording

    @overload
    def __getitem__(self, index: int) -> Exposure: ...
    @overload
    def __getitem__(self, index: slice | Sequence[int] | NDArray[Any]) -> Series: ...
    def __getitem__(self, index: int | slice | Sequence[int] | NDArray[Any]) -> Exposure | Series:
        """An exposure by its number, or a part of the series, by a slice, a list of numbers or a mask.

        Raises
        ------
        RecordingError
            The exposure is damaged.
        IndexError
            There is no such number, or the mask has another length.
        ValueError
            The numbers do not increase: a series is read forwards.
        """
        if isinstance(index, int | np.integer):
            number = self.numbers[int(index)]
            if (step := next(self.source.steps((), number, number + 1), None)) is None:
                why = self.source.damage or "it is not whole"
                raise RecordingError(f"exposure {number} of {self.path} cannot be read: {why}")
            return step.exposure
        if isinstance(index, slice):
            chosen: Sequence[int] = self.numbers[index]
            forwards = index.step is None or index.step > 0
        else:
            wanted = np.asarray(index)
            if wanted.dtype == bool and wanted.shape != (len(self),):
                raise IndexError(f"a mask of this series has {len(self)} values, one for each exposure")
            places = np.flatnonzero(wanted) if wanted.dtype == bool else wanted
            chosen = [self.numbers[k] for k in places.tolist()]
            forwards = all(a < b for a, b in pairwise(chosen))
        if not forwards:
            raise ValueError("a series is read forwards: give numbers that increase, and turn its list round")
        return Series(self.source, chosen)

    def __iter__(self) -> Iterator[Exposure]:
        return (step.exposure for step in self.steps())

    def exposures(self) -> Iterator[Exposure]:
        """The exposures, one after the other."""
        return iter(self)

    def walk(self, estimators: Sequence[str] | None = None) -> Iterator[tuple[Exposure, dict[str, Estimate]]]:
        """The exposures in one pass, each with its estimates by name: of all estimators, or of those that are named.

        An exposure may have none of an estimator. Raises RecordingError where there are no estimates of such a name.
        """
        return ((step.exposure, step.estimates) for step in self.steps(self.named(estimators)))

    def steps(self, names: Sequence[str] = (), *, also: Also = NOTHING) -> Iterator[Step]:
        """The exposures in one pass, each with its estimates by these names and with all that is known of it.

        Functions in ``also`` get the messages of a recording's other topics, by topic, as they are read; of a part of
        a recording these may include messages from before and after it.
        """
        wanted = self.numbers if isinstance(self.numbers, range) else frozenset(self.numbers)
        for start, stop in self._runs():
            yield from (each for each in self.source.steps(names, start, stop, also=also) if each.number in wanted)

    def _runs(self) -> Iterator[tuple[int, int]]:
        """First number and end of each part of the source that is read through."""
        numbers, first = self.numbers, 0
        if isinstance(numbers, range) and numbers.step <= _READ_THROUGH:
            if numbers:
                yield numbers[0], numbers[-1] + 1
            return
        for k, number in enumerate(numbers):
            if k + 1 == len(numbers) or numbers[k + 1] - number > _READ_THROUGH:
                yield numbers[first], number + 1
                first = k + 1

    def estimates(self, name: str | None = None) -> list[Estimate]:
        """The estimates by an estimator's name, in order; without a name those of the only estimator there is.

        Raises RecordingError if there are none of that name, or several estimators and no name.
        """
        if name is None:
            if len(self.estimators) != 1:
                raise RecordingError(f"{self.path} has estimates of {', '.join(self.estimators) or 'none'}: name one")
            (name,) = self.estimators
        return [found[name] for _, found in self.walk([name]) if name in found]

    def named(self, estimators: Sequence[str] | None) -> list[str]:
        """The names themselves, or those of all estimators for None. Raises RecordingError for one that is not here."""
        for name in estimators or ():
            if name not in self.estimators:
                known = ", ".join(self.estimators) or "none"
                raise RecordingError(
                    f"{self.path} holds no estimates of {name} (it has: {known}): `aolink estimate` makes them"
                )
        return self.estimators if estimators is None else list(dict.fromkeys(estimators))

    def to_pandas(self, estimators: Sequence[str] | None = None, *, paths: bool = False) -> pd.DataFrame:
        """A table with a row for each exposure and axis, indexed by time (UTC).

        The columns are those of `aolink.exporting.table.rows`, for all estimators or for those that are named. With
        ``paths``, a long table of the paths instead: a row for each fast step, axis and name (``truth`` or an
        estimator), with ``value`` and ``sd`` in slope units.

        Raises
        ------
        RecordingError
            There are no estimates of such a name.
        ExportError
            There is no exposure, or pandas is missing.
        """
        table = _above("exporting.table")
        frame: pd.DataFrame = (table.paths_to_pandas if paths else table.to_pandas)(self, estimators)
        return frame

    def to_xarray(self, estimators: Sequence[str] | None = None) -> xr.Dataset:
        """The whole series as one dataset along ``time`` (UTC): frames, inputs, truth, and estimates along
        ``estimator``.

        The variables are those of `aolink.exporting.arrays`, all in memory: take a slice of a long recording.

        Raises
        ------
        RecordingError
            There are no estimates of such a name.
        ExportError
            There is no exposure, the exposures have different sizes, it would be too large, or xarray is missing.
        """
        dataset: xr.Dataset = _above("exporting.arrays").to_xarray(self, estimators)
        return dataset

    def plot(
        self, estimators: Sequence[str] | None = None, *, output: int = 0, axes: tuple[Axes, Axes] | None = None
    ) -> tuple[Axes, Axes]:
        """Draw with matplotlib the camera's blur of one output with the paths over it, and the NIS of the estimates.

        Parameters
        ----------
        estimators:
            Estimators whose paths and NIS are drawn; all by default.
        output:
            Number of the output (a row of a path).
        axes:
            The two axes to draw on; by default those of a new figure.

        Returns
        -------
        The axes with the paths, and those with the NIS.

        Raises
        ------
        RecordingError
            There are no estimates of such a name.
        ExportError
            There is no exposure or no such output, or matplotlib is missing.
        """
        drawn: tuple[Axes, Axes] = _above("plotting.session").plot_series(self, estimators, output=output, axes=axes)
        return drawn

    def facts(self) -> dict[str, str]:
        """A summary of the series, in words."""
        timing, (rows, columns) = self.rig.timing, self.rig.sensor.shape
        length = duration(timing.exposure_steps * timing.fast_step_s)
        period = duration(timing.frame_period_steps * timing.fast_step_s)
        return {
            "exposures": f"{len(self)} of {timing.exposure_steps} fast steps ({length}), one every {period}",
            "frames": f"{rows} x {columns} pixels",
            "rig": f"{self.rig.name}: {self.rig.size()}",
            "estimates": ", ".join(self.estimators) or "none",
            "truth": "known" if self.has_truth else "not known",
        }

    def __repr__(self) -> str:
        estimators = f", estimates of {', '.join(self.estimators)}" if self.estimators else ""
        truth = ", truth" if self.has_truth else ""
        return f"<{type(self).__name__} {self.title()}: {len(self)} exposures, rig {self.rig.name}{estimators}{truth}>"

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{name}</th><td>{escape(text)}</td></tr>" for name, text in self.facts().items())
        return f"<table><caption>{type(self).__name__} {escape(self.title())}</caption>{rows}</table>"

    def title(self) -> str:
        """What it is called where it is shown."""
        numbers, part = self._numbers, ""
        if isinstance(numbers, range):
            part = f"[{numbers.start}:{numbers.stop}{f':{numbers.step}' if numbers.step > 1 else ''}]"
        elif numbers is not None:
            part = f"[{len(numbers)} of {len(self.source)}]"
        return f"{self.path.name}{part}"


def _above(module: str) -> Any:
    """A module that is itself about series: it is loaded when a method needs it, and not before."""
    return import_module(f"aolink.{module}")


IN_MEMORY = Path("exposures in memory")
"""What a series is called that is from no file."""


@dataclass(frozen=True)
class _InMemory:
    """Exposures that were simulated, or made of arrays."""

    rig: Rig
    exposures: Sequence[Exposure]
    path: Path = IN_MEMORY
    metadata: dict[str, str] = field(default_factory=dict)
    damage: str = ""

    @property
    def estimators(self) -> list[str]:
        return []

    @property
    def has_truth(self) -> bool:
        return any(each.truth is not None for each in self.exposures)

    def __len__(self) -> int:
        return len(self.exposures)

    def steps(
        self, names: Sequence[str] = (), start: int = 0, stop: int | None = None, *, also: Also = NOTHING
    ) -> Iterator[Step]:
        return (Step(number, each) for number, each in enumerate(self.exposures[start:stop], start))


def in_memory(rig: Rig, exposures: Sequence[Exposure]) -> Series:
    """A series of exposures in memory."""
    return Series(_InMemory(rig, exposures))


class _WithEstimates:
    """A series with estimates in memory, which stand before its own of the same names."""

    def __init__(self, series: Series, made: Mapping[str, Sequence[Estimate]]) -> None:
        self.series, self.rig, self.path, self.metadata = series, series.rig, series.path, series.metadata
        self._made = {name: {each.frame_id: each for each in estimates} for name, estimates in made.items()}

    @property
    def estimators(self) -> list[str]:
        return list(dict.fromkeys([*self.series.estimators, *self._made]))

    @property
    def has_truth(self) -> bool:
        return self.series.has_truth

    @property
    def damage(self) -> str:
        return self.series.source.damage

    def __len__(self) -> int:
        return len(self.series)

    def steps(
        self, names: Sequence[str] = (), start: int = 0, stop: int | None = None, *, also: Also = NOTHING
    ) -> Iterator[Step]:
        for step in self.series[start:stop].steps([name for name in names if name not in self._made], also=also):
            step.number = bisect_left(self.series.numbers, step.number)
            frame_id = step.exposure.frame_id
            step.estimates |= {
                name: self._made[name][frame_id] for name in names if frame_id in self._made.get(name, {})
            }
            yield step


def with_estimates(series: Series, made: Mapping[str, Sequence[Estimate]]) -> Series:
    """The series with estimates of its exposures, by the estimators' names, beside those that it has."""
    return Series(_WithEstimates(series, made))
