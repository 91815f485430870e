"""Calibration of the sensor from its own frames, and how its values get into a rig file. Pure: arrays and text."""

from aolink.calibration.measure import KINDS, Calibration, Frames, Kind, Measured, calibrate
from aolink.calibration.rig_text import calibrated_text
from aolink.calibration.spot import Spot

__all__ = ["KINDS", "Calibration", "Frames", "Kind", "Measured", "Spot", "calibrate", "calibrated_text"]
