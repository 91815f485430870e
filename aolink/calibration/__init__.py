"""Calibration of the sensor from its own frames, and the writing of its values into a rig file. The subpackage is pure:
it takes arrays and text; the session around it is the job `calibrate`.

To add a value: a field of `measure.Calibration` with its standard deviation, its key in `Calibration.values`, and a
field for the standard deviation in `CalibrationTable`, named like the key with ``_sd``. A value that the frames do not
determine is None, with a sentence in ``notes``.
"""

from aolink.calibration.measure import KINDS, Calibration, Frames, Kind, Measured, calibrate
from aolink.calibration.rig_text import calibrated_text
from aolink.calibration.spot import Spot

__all__ = ["KINDS", "Calibration", "Frames", "Kind", "Measured", "Spot", "calibrate", "calibrated_text"]
