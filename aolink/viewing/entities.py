"""The entities' paths, for the functions that send entities and for the layout that shows them.

An entity that shows a topic's messages has the topic's name.
"""

from __future__ import annotations

from aolink.recording import topics


def of(topic: str) -> str:
    """The entity of a topic, without the slashes about it."""
    return topic.strip("/")


FRAME = of(topics.IMAGE)
SCENE = of(topics.SCENE)
TRUE_SCENE = "scene/true"
RESTORED_SCENE = of(topics.RESTORED_SCENE)
RESTORED_SPOTS = of(topics.RESTORED_SPOTS)
SCENES = (SCENE, RESTORED_SCENE, TRUE_SCENE)
"""The entities of the scene, in this order."""
PAGE = "camera/history"
CENTROIDS = f"{PAGE}/centroid"
ROW_NOW = f"{PAGE}/now"
PROFILE = "profile"

PATH = "path"
STATE = "state"
NIS = "nis"
PATH_ERROR = "error/path"
RMS_ERROR = "error/path_rms"
END_ERROR = "error/end"
RESIDUAL = "residual"
ESTIMATE = of(topics.ESTIMATE)
"""Columns for tables; nothing of them is drawn."""
PUPIL = "pupil"

COMMAND = of(topics.COMMAND)
APPLIED = of(topics.APPLIED)
LOG = of(topics.LOG)
STATUS = "status"
WARNINGS = "warnings"
SESSION = "session"


def mean(path: str) -> str:
    """The estimates without their bands."""
    return f"{path}/mean"


def band(path: str) -> str:
    """The lines that are some standard deviations from the estimates."""
    return f"{path}/band"
