"""Jobs, the work of commands that need several subpackages: the demo, a calibration, many recordings at once."""
