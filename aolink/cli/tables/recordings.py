"""Tables about recordings: the content of one, the differences of two, the results of many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.markup import escape
from rich.table import Table

from aolink.estimation.score import Unused
from aolink.recording.account import STEPS, Commands
from aolink.units import duration, with_unit

if TYPE_CHECKING:
    from aolink.recording.compare import TopicComparison


_DEVICES = ("camera", "mirror")
_ODD = (
    "rearmed", "ports_vanished", "steps_parked", "steps_clipped", "chunks_refused", "blocks_retransmitted",
    "cut", "part", "recorded_with", "estimated_from", "calibration",
)  # fmt: skip
"""Facts that a summary has where there are any."""


def summary(values: Mapping[str, Any]) -> Table:
    """What a session was, what was lost and what is odd, in some ten lines; `recording_facts` has all."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    session, gaps, counts = values["session"], values["gaps"], values["messages"]
    begun = (values["start_utc"] or f"{values['start_ns']} ns since 1970").replace("T", " ").replace("+00:00", " UTC")
    virtual = ", the rig's own time" if session.get("virtual_time") is True else ""
    devices = [f"{kind} {session[kind]}" for kind in _DEVICES if session.get(kind)]
    losses = [f"{name.replace('_', ' ')} {count}" for name, count in values["losses"].items()]
    if gaps["count"]:
        losses.append(f"{gaps['count']} gaps between frames, the longest of {gaps['longest_steps']} fast steps")
    odd = {name: session.get(name) for name in _ODD if session.get(name) not in (None, "", 0, "0")}
    rows = {
        "file": f"{values['file']}, {with_unit(values['bytes'], 'B')}",
        "recorded": f"{begun}{virtual}, {duration(values['duration_s'])}",
        "rig": str(session.get("rig", "not named")),
        "devices": "; ".join(devices),
        "lacks": "; ".join(f"{kind}: {session[f'{kind}_lacks']}" for kind in _DEVICES if session.get(f"{kind}_lacks")),
        "exposures": f"{counts.get('/camera/image', 0)}{', with their truth' if values['truth'] else ''}",
        "lost": ", ".join(losses) or "nothing",
        "steps": _steps(values["commands"]),
        "answers": "; ".join(Commands.of(values["commands"]).lines()),
        "estimates": ", ".join(f"{name} {each['count']}" for name, each in values["estimates"].items()) or "none",
        "unused": "\n".join(
            f"{name}: {Unused(**each).text(of['count'])}"
            for name, of in values["estimates"].items()
            for each in of["unused"]
        ),
        "verdict": "\n".join(
            f"{name}: {of['verdict']['text']}" for name, of in values["estimates"].items() if of.get("verdict")
        ),
        "damage": values["damage"],
        "odd": ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in odd.items()),
        "ended": "" if session.get("ended", "complete") == "complete" else str(session["ended"]),
        "warnings": str(session.get("warnings") or ""),
        "note": str(session.get("note") or ""),
    }
    for name, text in rows.items():
        if text:
            table.add_row(name, escape(text))
    return table


def _steps(commands: Mapping[str, Any]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {count}" for name in STEPS if (count := commands[name]))


def batch(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The results of many recordings and models, a row each."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    columns = ("recording", "model", "estimator", "exposures", "path_rmse", "end_rmse", "nis", "end_nees", "not_ok")
    for name in columns:
        table.add_column(name, justify="left" if name in columns[:3] else "right", no_wrap=True)
    for row in rows:
        if row["error"]:
            table.add_row(Path(row["recording"]).name, escape(row["model"]), row["estimator"], "failed")
            continue
        cells = [Path(row["recording"]).name if name == "recording" else row[name] for name in columns]
        table.add_row(*(escape(f"{cell:.4g}" if isinstance(cell, float) else str(cell or "")) for cell in cells))
    return table


def comparison(found: Mapping[str, TopicComparison]) -> Table:
    """The comparison topic by topic: how many messages were compared, and the first difference."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("topic", no_wrap=True)
    for name in ("compared", "differ"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("first difference")
    for topic, each in found.items():
        table.add_row(topic, str(each.compared), str(each.differ), escape(each.first))
    return table
