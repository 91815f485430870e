"""What recordings hold, how two of them compare, and what came of many."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.markup import escape
from rich.table import Table

from aolink.cli.tables.json import without_nan
from aolink.estimation import Status
from aolink.estimation.score import Unused, UnusedCounter
from aolink.recording import topics
from aolink.recording.schemas_pb2 import Estimate as EstimateMessage
from aolink.recording.schemas_pb2 import ExposureInfo
from aolink.units import duration, with_unit

if TYPE_CHECKING:
    from aolink.recording.compare import TopicComparison
    from aolink.recording.reader import Recording

_LOSSES = (
    "frames_lost", "frames_incomplete", "scenes_lost", "scenes_incomplete", "packets_missing", "packets_bad_crc",
    "packets_bad_framing", "packets_bad_payload", "chunks_refused", "steps_late", "steps_refused", "steps_not_reported",
    "steps_clipped", "steps_parked", "control_open_exposures", "control_late_exposures", "control_misfit_exposures",
)  # fmt: skip
"""What a session counts of what went wrong."""
_ENDS = ("commanded", "applied", "superseded", "late", "refused", "not_reported")
"""Steps that a session commanded, and how they ended: the first is the sum of the others."""


def recording_facts(recording: Recording) -> dict[str, Any]:
    """What `aolink info` says of a recording."""
    duration_s = (recording.end_ns - recording.start_ns) / 1e9
    gaps, estimates = _gaps_and_estimates(recording)
    return {
        "file": str(recording.path),
        "bytes": recording.size,
        "complete": recording.complete,
        "damage": recording.damage,
        "start_ns": recording.start_ns,
        "start_utc": _date(recording.start_ns),
        "duration_s": duration_s,
        "messages": dict(sorted(recording.counts.items())),
        "rates_per_s": {
            topic: round((count - 1) / duration_s, 3)
            for topic, count in sorted(recording.counts.items())
            if duration_s and count > 1
        },
        "gaps": gaps,
        "estimates": estimates,
        "commands": {
            end: int(steps) for end in _ENDS if (steps := recording.end_metadata.get(f"steps_{end}", "")).isdigit()
        },
        "losses": _losses(recording),
        "damaged_parts": [loss.text() for loss in recording.losses],
        "truth": topics.TRUTH in recording.counts,
        "session": {name: _typed(name, value) for name, value in recording.metadata.items()},
        "estimators": recording.estimators,
    }


def _date(time_ns: int) -> str | None:
    """A time on the host's clock as a date, ISO 8601; None for one that no calendar has."""
    try:
        return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(timespec="seconds")
    except (OverflowError, ValueError, OSError):
        return None


def _gaps_and_estimates(recording: Recording) -> tuple[dict[str, float], dict[str, Any]]:
    """Where the camera's frames are further apart than their period: how often, and the longest, in fast steps.

    And for each estimator how many estimates there are, and why some could not use their exposure.
    """
    period, last, gaps = recording.rig.timing.frame_period_steps, None, []
    names = recording.estimators
    counts, unused = dict.fromkeys(names, 0), {name: UnusedCounter() for name in names}
    for recorded in recording.messages(topics.EXPOSURE, *map(topics.estimate_topic, names)):
        message = recorded.message
        if isinstance(message, ExposureInfo):
            if last is not None and message.first_step - last != period:
                gaps.append(message.first_step - last - period)
            last = message.first_step
        elif isinstance(message, EstimateMessage):
            name = recorded.topic.removeprefix(topics.ESTIMATE)
            counts[name] += 1
            with contextlib.suppress(ValueError):  # a status that a later aolink has
                unused[name].add(Status(message.status), message.reason, message.frame_id)
    estimates = {name: {"count": n, "unused": [asdict(u) for u in unused[name].result()]} for name, n in counts.items()}
    return {"count": len(gaps), "longest_steps": max(gaps, default=0)}, estimates


def _losses(recording: Recording) -> dict[str, int]:
    """What was lost in the session, by cause; and in the file."""
    counted = {
        name: int(recording.metadata[name])
        for name in _LOSSES
        if recording.metadata.get(name, "0").isdigit() and int(recording.metadata.get(name, "0"))
    }
    for name, value in recording.metadata.items():  # exposures, by the estimator that had no time for them
        if name.startswith("skipped_") and value.isdigit() and int(value):
            counted[name] = int(value)
    if recording.losses:
        counted["parts_of_the_file"] = len(recording.losses)
    return counted


def _typed(name: str, value: str) -> Any:
    """A value of the metadata, which knows text only."""
    if name in ("note", "rig", "rig_digest", "camera", "mirror", "controller", "control"):
        return value
    with contextlib.suppress(ValueError):
        return without_nan(float(value) if not value.lstrip("-").isdigit() else int(value))
    return {"True": True, "False": False}.get(value, value)


def facts(values: Mapping[str, Any]) -> Table:
    """Name and value, line by line, in the units that people read; `recording_facts` has the numbers."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    virtual = " (the rig's own time)" if values["session"].get("virtual_time") is True else ""
    begun = (values["start_utc"] or f"{values['start_ns']} ns since 1970").replace("T", " ").replace("+00:00", " UTC")
    readable = {
        "file": values["file"], "size": with_unit(values["bytes"], "B"), "recorded": f"{begun}{virtual}",
        "duration": duration(values["duration_s"]),
    }  # fmt: skip
    left_out = {"bytes", "start_ns", "start_utc", "duration_s", "session", "estimators", "estimates"}
    flat = readable | {name: value for name, value in values.items() if name not in left_out}
    flat["estimates"] = ", ".join(f"{name} {each['count']}" for name, each in values["estimates"].items()) or "none"
    for name, value in (flat | {k: v for k, v in values["session"].items() if k != "estimators"}).items():
        if name in ("damage", "warnings", "commands", "camera_lacks", "mirror_lacks") and not value:
            continue
        if isinstance(value, Mapping):
            value = ", ".join(f"{key} {count}" for key, count in value.items()) or "none"
        elif isinstance(value, list):
            value = " ".join(value) or "none"
        table.add_row(*map(escape, _readable(name, value)))
        for line in _unused(values["estimates"]) if name == "estimates" else ():
            table.add_row("", escape(line))
    return table


def _readable(name: str, value: Any) -> tuple[str, str]:
    """A number whose name ends in its unit, with a unit that makes it short."""
    for ending, unit, factor in (("_ns", "s", 1e-9), ("_s", "s", 1.0), ("_ppm", "ppm", 1.0)):
        if name.endswith(ending) and isinstance(value, int | float):
            return name.removesuffix(ending), f"{value:.4g} ppm" if unit == "ppm" else with_unit(factor * value, unit)
    return name, str(value)


def _unused(estimates: Mapping[str, Any]) -> list[str]:
    return [f"{name}: {Unused(**each).text(of['count'])}" for name, of in estimates.items() for each in of["unused"]]


def batch(rows: Sequence[Mapping[str, Any]]) -> Table:
    """What came of many recordings and models, a row each."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    columns = ("recording", "model", "estimator", "exposures", "path_rmse", "end_rmse", "nis", "end_nees", "not_ok")
    for name in columns:
        table.add_column(name, justify="left" if name in columns[:3] else "right", no_wrap=True)
    for row in rows:
        if row["error"]:
            table.add_row(Path(row["recording"]).name, escape(row["model"]), "failed")
            continue
        cells = [Path(row["recording"]).name if name == "recording" else row[name] for name in columns]
        table.add_row(*(escape(f"{cell:.4g}" if isinstance(cell, float) else str(cell or "")) for cell in cells))
    return table


def comparison(found: Mapping[str, TopicComparison]) -> Table:
    """Topic by topic: how many messages were compared, and what differs first."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("topic", "field"):
        table.add_column(name, no_wrap=True)
    for name in ("compared", "differ", "largest", "relative"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("first")
    for topic, each in found.items():
        if each.same:
            table.add_row(topic, "", str(each.compared), "0", "", "", "")
        for name, field in each.fields.items():
            frame = f"frame {field.first.frame_id}: " if field.first.frame_id is not None else ""
            sizes = (f"{field.largest:.2g}", f"{field.largest_relative:.2g}")
            table.add_row(
                topic, name, str(each.compared), str(field.messages), *sizes, escape(frame + field.first.text)
            )
        for count, what, first in (
            (each.missing, "missing", each.first_missing),
            (each.added, "added", each.first_added),
        ):
            if count:
                table.add_row(topic, what, str(each.compared), str(count), "", "", escape(first))
    return table


def comparison_as_json(found: Mapping[str, TopicComparison], *, same_rig: bool) -> dict[str, Any]:
    """The same for scripts; a difference without a size is null."""
    same = same_rig and all(each.same for each in found.values())
    return dict(without_nan({"same": same, "same_rig": same_rig, "topics": {k: asdict(v) for k, v in found.items()}}))
