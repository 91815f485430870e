"""The common part of all exports: the checks, the clock, the facts about the session."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from importlib.metadata import version
from typing import Any

from aolink.errors import ExportError
from aolink.estimation.estimate import Estimate
from aolink.exposure import Exposure
from aolink.extensions import install_command
from aolink.series import Series

Progress = Callable[[int], None]
"""A function that is called with the number of exposures read."""


def no_progress(exposures: int) -> None:
    """Ignore the progress."""


def needed(module: str, extra: str, what: str) -> Any:
    """A module of an optional package. Raises ExportError that names the extra where it is missing."""
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise ExportError(f"{what} needs {package}: {install_command(extra)}") from None
    except UnicodeDecodeError as error:  # matplotlib reads a matplotlibrc of the current folder
        raise ExportError(f"{module} cannot be loaded: a file of settings is no text ({error})") from None


def together(
    series: Series, names: Sequence[str], progress: Progress = no_progress
) -> Iterator[tuple[Exposure, dict[str, Estimate]]]:
    """The exposures and estimates of `Series.walk`. Raises ExportError where there is no exposure."""
    number = 0
    for number, both in enumerate(series.walk(names), 1):
        yield both
        progress(number)
    if not number:
        raise ExportError(f"{series.path} holds no exposure to export; `aolink info` says what it holds")


def clock_of(first: Exposure) -> str:
    """The field of an exposure's time that a series uses, chosen by the first exposure; '' where there is none.

    It is the start on the host's clock where that is known, otherwise the arrival of the frame, otherwise the start on
    the device's clock.
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
    """Facts about the origin of the data, which every export that can holds."""
    return {
        "recording": series.path.name,
        "rig": series.rig.name,
        "rig_digest": series.rig.digest,
        "session": json.dumps(series.metadata),
        "exported_by": f"aolink {version('aolink')}",
    }
