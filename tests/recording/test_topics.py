"""The table of topics says of each message what the rest of aolink relies on."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

import aolink
from aolink.recording import topics
from aolink.recording.topics import TOPICS, Topic
from aolink.viewing import devices

PACKAGE = Path(aolink.__file__).parent


@pytest.mark.parametrize("row", TOPICS, ids=lambda row: row.name)
def test_a_message_has_the_fields_by_which_it_belongs(row: Topic) -> None:
    fields = set(row.message.DESCRIPTOR.fields_by_name)
    if row.after:
        assert topics.named(row.after).belongs_to == row.belongs_to == "exposure"
    elif row.belongs_to != "time":
        assert fields >= ({"frame_id"} if row.belongs_to == "exposure" else {"first_step", "n_steps"})


def test_every_function_that_shows_messages_of_devices_is_in_the_table() -> None:
    shown = [row.shown_by for row in TOPICS if row.shown_by.startswith("devices.")]
    assert sorted(shown) == [f"devices.{name}" for name in sorted(vars(devices)) if name.startswith("log_")]


@pytest.mark.parametrize("row", TOPICS, ids=lambda row: row.name)
def test_every_topic_is_shown_by_a_function_of_the_viewer(row: Topic) -> None:
    module, function = row.shown_by.split(".")
    assert callable(getattr(importlib.import_module(f"aolink.viewing.{module}"), function))


def test_nothing_shows_a_topic_that_is_not_in_the_table() -> None:
    assert topics.named("/somebody/elses").shown_by == ""


def test_an_estimators_topic_is_found_by_its_prefix() -> None:
    assert topics.named(topics.estimate_topic("o1")).name == topics.ESTIMATE
    assert topics.named(topics.estimation_topic("o1")).name == topics.ESTIMATION
    assert topics.named("/somebody/elses").name == ""


def test_a_message_of_another_kind_belongs_to_its_time_alone() -> None:
    other = topics.named(topics.LOG).message()
    assert topics.find(topics.LATENCY, other).belongs_to == "time"
    assert topics.find(topics.LATENCY, None).belongs_to == "time"


def test_topics_are_written_in_the_table_alone() -> None:
    """Every other module of aolink names them by the table, with their slashes and, as entities of Rerun, without."""
    names = {row.name for row in TOPICS}
    entities = tuple(name.strip("/") for name in names if "/" in name.strip("/"))
    for path in PACKAGE.rglob("*.py"):
        if path.name.endswith("_pb2.py") or path == PACKAGE / "recording" / "topics.py":
            continue
        found = list(ast.walk(ast.parse(path.read_text())))
        parts = [part for each in found if isinstance(each, ast.JoinedStr) for part in each.values]  # of other paths
        texts = {each for each in found if isinstance(each, ast.Constant) and isinstance(each.value, str)}
        assert not {each.value for each in texts - {*parts}} & names, path
        assert not [each.value for each in texts if str(each.value).startswith(entities)], path


def test_the_page_for_other_software_names_every_topic() -> None:
    page = (PACKAGE.parent / "recordings" / "FORMAT.md").read_text()
    for row in TOPICS:
        assert f"`{row.name}" in page or (row.name.startswith(topics.RESTORED) and f"`{topics.RESTORED}" in page)
