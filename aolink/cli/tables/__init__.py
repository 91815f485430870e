"""What the command line prints: facts and tables, by subject."""

from aolink.cli.tables.recordings import batch, comparison, comparison_as_json, facts, recording_facts
from aolink.cli.tables.rigs import calibration, calibration_as_json, exposure_scan, slopes, slopes_as_json
from aolink.cli.tables.scores import score_all, scores, scores_as_json
from aolink.cli.tables.sessions import deblurred, deblurred_lines, demo_summary, session, session_as_json

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
