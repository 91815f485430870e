"""What the command line prints: facts and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from aolink.estimation import Estimate
from aolink.estimation.score import Score, score
from aolink.recording import schemas_pb2 as pb
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.session import Report

if TYPE_CHECKING:
    from aolink.demo import DemoResult

_LATENCY_STEPS = (
    ("exposure end to first byte", "exposure_end_ns", "first_byte_ns"),
    ("first byte to frame complete", "first_byte_ns", "complete_ns"),
    ("frame complete to estimated", "complete_ns", "estimated_ns"),
    ("estimated to next command sent", "estimated_ns", "command_sent_ns"),
    ("command sent to acknowledged", "command_sent_ns", "command_acknowledged_ns"),
)


def score_all(recording: Recording, estimates: Mapping[str, Sequence[Estimate]]) -> dict[str, Score]:
    """Score estimates against the truth in their recording, by estimator."""
    exposures = list(recording.exposures())
    return {name: score(exposures, values) for name, values in estimates.items()}


def recording_facts(recording: Recording) -> dict[str, Any]:
    """What `aolink info` says of a recording."""
    duration_s = (recording.end_ns - recording.start_ns) / 1e9
    return {
        "file": str(recording.path),
        "bytes": recording.path.stat().st_size,
        "complete": recording.complete,
        "duration_s": duration_s,
        "messages": dict(sorted(recording.counts.items())),
        "truth": topics.TRUTH in recording.counts,
        "estimators": recording.estimators,
        **recording.metadata,
    }


def facts(values: Mapping[str, Any]) -> Table:
    """Name and value, line by line."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in values.items():
        if isinstance(value, Mapping):
            value = ", ".join(f"{key} {count}" for key, count in value.items())
        elif isinstance(value, list):
            value = " ".join(value) or "none"
        table.add_row(name, escape(str(value)))
    if not values.get("complete", True):
        table.add_row("note", "the file does not end as a recording should: it was cut off, this is what is whole")
    return table
