"""What the command line prints: facts and tables, by subject."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from aolink.tables.recordings import batch, comparison, comparison_as_json, facts, recording_facts
    from aolink.tables.rigs import calibration, calibration_as_json, exposure_scan, slopes, slopes_as_json
    from aolink.tables.scores import score_all, scores, scores_as_json
    from aolink.tables.sessions import deblurred, deblurred_lines, demo_summary, session, session_as_json

__all__ = [
    "batch",
    "calibration",
    "calibration_as_json",
    "comparison",
    "comparison_as_json",
    "deblurred",
    "deblurred_lines",
    "demo_summary",
    "exposure_scan",
    "facts",
    "recording_facts",
    "score_all",
    "scores",
    "scores_as_json",
    "session",
    "session_as_json",
    "slopes",
    "slopes_as_json",
]

_SUBJECT = {
    "batch": "recordings",
    "calibration": "rigs",
    "calibration_as_json": "rigs",
    "comparison": "recordings",
    "comparison_as_json": "recordings",
    "deblurred": "sessions",
    "deblurred_lines": "sessions",
    "demo_summary": "sessions",
    "exposure_scan": "rigs",
    "facts": "recordings",
    "recording_facts": "recordings",
    "score_all": "scores",
    "scores": "scores",
    "scores_as_json": "scores",
    "session": "sessions",
    "session_as_json": "sessions",
    "slopes": "rigs",
    "slopes_as_json": "rigs",
}
"""The module of each: only what is used is imported, for all of it takes a second of processor time."""


def __getattr__(name: str) -> Any:
    if name not in _SUBJECT:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_SUBJECT[name]}"), name)
