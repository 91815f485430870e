"""What all that is exported shares: what must be there, the clock, the facts that go along."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from importlib.metadata import version
from typing import Any

from aolink.errors import ExportError
from aolink.estimation.estimate import Estimate
from aolink.exposure import Exposure
from aolink.series import Series

Progress = Callable[[int], None]
"""Is told how many exposures have been read."""


def no_progress(exposures: int) -> None:
    """Tell nobody."""


def needed(module: str, extra: str, what: str) -> Any:
    """A module of an optional package. Raises ExportError that names the extra where it is missing."""
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise ExportError(f"{what} needs {package}: pip install 'aolink[{extra}]'") from None


def together(
    series: Series, names: Sequence[str], progress: Progress = no_progress
) -> Iterator[tuple[Exposure, list[Estimate | None]]]:
    """What `Series.with_estimates` gives. Raises ExportError where there is no exposure."""
    number = 0
    for number, both in enumerate(series.with_estimates(names), 1):
        yield both
        progress(number)
    if not number:
        raise ExportError(f"{series.path} holds no exposure to export; `aolink info` says what it holds")


def clock_of(first: Exposure) -> str:
    """Which of an exposure's times a series counts by, as the first one has it; '' where there is none.

    The start on the host's clock where it is known, else when the frame came, else the device's clock.
    """
    clocks = ("host_start_ns", "host_receive_ns", "device_start_ns")
    return next((name for name in clocks if getattr(first, name)), "")


def time_ns(series: Series, exposure: Exposure, clock: str) -> int:
    """An exposure's time by that clock, ns since 1970; without one, fast steps times their length."""
    return int(getattr(exposure, clock)) if clock else exposure.first_step * series.rig.timing.fast_step_ns


def check_frame(series: Series, exposure: Exposure) -> None:
    """Raise ExportError for a frame that is not of the rig's sensor."""
    if exposure.pixels.shape != series.rig.sensor.shape:
        raise ExportError(
            f"frame {exposure.frame_id} of {series.path} has {exposure.pixels.shape} pixels, the sensor of the rig file"
            f" in it {series.rig.sensor.shape}: it was recorded with another rig file"
        )


def facts(series: Series) -> dict[str, str]:
    """Where it all comes from: what every export carries along, if it can."""
    return {
        "recording": series.path.name,
        "rig": series.rig.name,
        "rig_digest": series.rig.digest,
        "session": json.dumps(series.metadata),
        "exported_by": f"aolink {version('aolink')}",
    }
