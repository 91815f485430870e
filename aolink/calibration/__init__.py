"""Calibration of the sensor from its own frames, and the writing of its values into a rig file. The subpackage is pure:
it takes arrays and text."""

from aolink.calibration.measure import KINDS, Calibration, Frames, Kind, Measured, calibrate
from aolink.calibration.rig_text import calibrated_text
from aolink.calibration.spot import Spot

__all__ = ["KINDS", "Calibration", "Frames", "Kind", "Measured", "Spot", "calibrate", "calibrated_text"]
