"""A calibration's values, written into the text of a rig file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import tomlkit

from aolink.calibration.measure import Calibration, Measured
from aolink.rig import CalibrationTable, Rig, parse_rig
from aolink.rig.edit import with_table, with_value

_COMMENT = "by `aolink calibrate`: standard deviations of the sensor's values, and what they come from"


def calibrated_text(text: str, rig: Rig, calibration: Calibration, sources: Sequence[str]) -> str:
    """The text of a rig file with the measured values and a table [calibration].

    Parameters
    ----------
    text:
        The file's text, whatever its line ends, which ``rig`` was read from.
    sources:
        The sources of the calibration, each beginning with its kind.
    """
    for key, value in calibration.values.items():
        text = with_value(text, key, tomlkit.value(written(value)), may_be_new=True)
    if calibration.hot_pixels:
        places = np.transpose(np.unravel_index(calibration.hot_pixels, rig.sensor.shape)).tolist()
        known = {*rig.sensor.defects, *map(tuple, places)}
        text = with_value(text, "sensor.defects", tomlkit.item(sorted(map(list, known))), may_be_new=True)
    text = with_table(text, "calibration", _updated_table(rig, calibration, sources), _COMMENT)
    parse_rig(text)
    return text


def written(measured: Measured) -> str:
    """A value to a hundredth of its standard deviation, or to six digits if it has none."""
    value, sd = measured.value, measured.sd
    digits = 6
    if value and math.isfinite(sd) and sd > 0:
        digits = max(3, math.floor(math.log10(abs(value))) - math.floor(math.log10(sd)) + 3)
    return f"{max(value, 0.0):.{min(digits, 17)}g}"


def _updated_table(rig: Rig, calibration: Calibration, sources: Sequence[str]) -> dict[str, Any]:
    """The table with the new values; values that were not measured this time stay as before."""
    table = rig.calibration or CalibrationTable()
    sds = {
        key.removeprefix("sensor.").replace(".", "_") + "_sd": None if math.isnan(sd) else float(f"{sd:.3g}")
        for key, sd in ((key, value.sd) for key, value in calibration.values.items())
    }
    frames = {f"{kind}_frames": n for kind, n in calibration.frames.items() if n}
    kept = [each for each in table.sources if not any(n and each.startswith(k) for k, n in calibration.frames.items())]
    changes: dict[str, Any] = {**sds, **frames, "sources": (*kept, *sources)}
    known = dataclasses.asdict(dataclasses.replace(table, **changes))
    return {name: list(value) if name == "sources" else value for name, value in known.items() if value is not None}
