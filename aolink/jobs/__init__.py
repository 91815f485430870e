"""Whole jobs that commands do: the demo, a calibration, many recordings at once."""
