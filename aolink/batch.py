"""The function that estimates one recording in one call, for batches on any engine.

`aolink/pages/many_recordings.md` shows how.

>>> from aolink.batch import Settings
>>> Settings(estimator="moments").estimator
'moments'
"""

from aolink.jobs.tables import COLUMNS, EXPOSURE_COLUMNS
from aolink.jobs.unit import Model, Settings, estimate_file

__all__ = ["COLUMNS", "EXPOSURE_COLUMNS", "Model", "Settings", "estimate_file"]
