"""The class `Series`: exposures of one rig and their estimates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from html import escape
from typing import Any, overload

from aolink.errors import RecordingError
from aolink.estimation.estimate import Estimate
from aolink.exposure import Exposure
from aolink.rig import Rig
from aolink.units import duration


class Series(ABC):
    """Exposures in order, with the estimates that were made of them; nothing is read before it is used.

    ``len(series)``, ``series[7]``, ``series[-10:]`` and a loop over it give exposures. A slice is a series too.
    """

    rig: Rig
    path: Any
    """The file of the exposures: a path, or the location of one behind a URL."""
    metadata: dict[str, str]
    """Facts about the session."""

    @property
    @abstractmethod
    def estimators(self) -> list[str]:
        """Names of the estimators whose results are there."""

    @property
    @abstractmethod
    def has_truth(self) -> bool:
        """Whether the truth is known, for some exposures at least."""

    @abstractmethod
    def exposures(self) -> Iterator[Exposure]:
        """The exposures, one after the other."""

    @abstractmethod
    def iter_estimates(self, name: str) -> Iterator[Estimate]:
        """An estimator's estimates of these exposures in their order; an exposure may have none."""

    @abstractmethod
    def __len__(self) -> int: ...

    @overload
    def __getitem__(self, index: int) -> Exposure: ...
    @overload
    def __getitem__(self, index: slice) -> Series: ...
    @abstractmethod
    def __getitem__(self, index: int | slice) -> Exposure | Series: ...

    def __bool__(self) -> bool:
        return True  # an empty recording is a recording

    def __iter__(self) -> Iterator[Exposure]:
        return self.exposures()

    def estimates(self, name: str) -> list[Estimate]:
        """The estimates by an estimator's name, in order. Raises RecordingError if there are none of that name."""
        self.named([name])
        return list(self.iter_estimates(name))

    def with_estimates(self, names: Sequence[str]) -> Iterator[tuple[Exposure, list[Estimate | None]]]:
        """The exposures, each with its estimates by the estimators ``names``, with None for a missing estimate."""
        left = [self.iter_estimates(name) for name in names]
        ahead = [next(each, None) for each in left]
        for exposure in self.exposures():
            its = [each if each is not None and each.frame_id == exposure.frame_id else None for each in ahead]
            ahead = [old if its[k] is None else next(left[k], None) for k, old in enumerate(ahead)]
            yield exposure, its

    def named(self, estimators: Sequence[str] | None) -> list[str]:
        """The names themselves, or those of all estimators for None. Raises RecordingError for one that is not here."""
        for name in estimators or ():
            if name not in self.estimators:
                known = ", ".join(self.estimators) or "none"
                raise RecordingError(
                    f"{self.path} holds no estimates of {name} (it has: {known}): `aolink estimate` makes them"
                )
        return self.estimators if estimators is None else list(dict.fromkeys(estimators))

    def facts(self) -> dict[str, str]:
        """A summary of the series, in words."""
        timing, (rows, columns) = self.rig.timing, self.rig.sensor.shape
        length = duration(timing.exposure_steps * timing.fast_step_s)
        period = duration(timing.frame_period_steps * timing.fast_step_s)
        return {
            "exposures": f"{len(self)} of {timing.exposure_steps} fast steps ({length}), one every {period}",
            "frames": f"{rows} x {columns} pixels",
            "rig": f"{self.rig.name}: {self.rig.n_inputs} inputs, {self.rig.n_outputs} outputs",
            "estimates": ", ".join(self.estimators) or "none",
            "truth": "known" if self.has_truth else "not known",
        }

    def __repr__(self) -> str:
        estimators = f", estimates of {', '.join(self.estimators)}" if self.estimators else ""
        truth = ", truth" if self.has_truth else ""
        return f"<{self.title()}: {len(self)} exposures, rig {self.rig.name}{estimators}{truth}>"

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{name}</th><td>{escape(text)}</td></tr>" for name, text in self.facts().items())
        return f"<table><caption>{escape(self.title())}</caption>{rows}</table>"

    def title(self) -> str:
        """What it is called where it is shown."""
        return f"Recording {self.path.name}"
