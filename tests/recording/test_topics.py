"""The table of topics says of each message what the rest of aolink relies on."""

from __future__ import annotations

import importlib
import re

from aolink.recording import topics
from aolink.recording.topics import TOPICS


def test_a_message_has_the_fields_by_which_it_belongs() -> None:
    for row in TOPICS:
        fields = set(row.message.DESCRIPTOR.fields_by_name)
        if row.after:
            assert topics.named(row.after).belongs_to == row.belongs_to == "exposure"
        elif row.belongs_to != "time":
            assert fields >= ({"frame_id"} if row.belongs_to == "exposure" else {"first_step", "n_steps"})


def test_every_topic_is_drawn_by_its_curves_or_by_a_function_of_the_viewer() -> None:
    for row in TOPICS:
        assert row.curves or row.shown_by
        if row.shown_by:
            module, function = row.shown_by.split(".")
            assert callable(getattr(importlib.import_module(f"aolink.viewing.{module}"), function))


def test_a_curve_is_of_fields_that_its_message_has_and_says_its_unit() -> None:
    for row in TOPICS:
        for curve in row.curves:
            assert {curve.field, curve.since or curve.field} <= set(row.message.DESCRIPTOR.fields_by_name)
            assert re.fullmatch(r".+ \([^()]+\)", curve.view)


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
