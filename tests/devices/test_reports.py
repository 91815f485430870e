"""What a mirror has reported: each fast step is handed on once, and what is missing is asked for again."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.devices.reports import AppliedReports
from aolink.wire import messages_pb2 as pb

STEP_NS = 1_000_000


def report(first: int, end: int) -> pb.Applied:
    return pb.Applied(
        block_id=1, first_step=first, n_steps=end - first, u=[float(k) for k in range(first, end) for _ in range(2)],
        device_ns=end * STEP_NS,
    )  # fmt: skip


def reports_from(first_step: int = 0, patience_ns: int = 1000) -> AppliedReports:
    reports = AppliedReports(STEP_NS, patience_ns)
    reports.begin(first_step)
    return reports


def test_a_gap_is_awaited_and_asked_for_until_it_is_filled() -> None:
    reports = reports_from()
    assert reports.take(report(0, 10), 0) == [report(0, 10)]
    awaited, later = reports.take(report(20, 30), 5)
    assert awaited == pb.Applied(first_step=10, n_steps=10, source=pb.Applied.AWAITED)
    assert later == report(20, 30)
    assert reports.next_due_ns(100) == 5
    assert reports.ask(5, 100) == ([pb.AppliedQuery(first_step=10, n_steps=10)], [])
    assert reports.next_due_ns(100) == 105
    assert reports.ask(104, 100) == ([], [])
    assert reports.take(report(10, 14), 50) == [report(10, 14)]
    assert reports.ask(50, 100) == ([pb.AppliedQuery(first_step=14, n_steps=6)], [])  # at once: the line is there
    assert reports.take(report(14, 20), 60) == [report(14, 20)]
    assert reports.next_due_ns(100) is None
    assert reports.asked == 2


def test_what_came_before_is_not_handed_on_again() -> None:
    reports = reports_from()
    reports.take(report(0, 10), 0)
    assert reports.take(report(0, 10), 0) == []
    assert reports.take(report(5, 15), 0) == [report(10, 15)]
    assert reports.take(report(2, 3), 0) == []


def test_what_is_before_the_session_is_none_of_it() -> None:
    reports = reports_from(100)
    assert reports.take(report(0, 50), 0) == [report(0, 50)]
    assert reports.take(report(90, 110), 0) == [report(90, 110)]
    assert reports.next_due_ns(1) is None


def test_a_report_is_given_up_after_its_time_but_not_before_three_tries() -> None:
    reports = reports_from()
    reports.take(report(10, 20), 0)
    gone = pb.Applied(first_step=0, n_steps=10, source=pb.Applied.NOT_REPORTED)
    for now in (0, 5000, 10_000):  # a host that was held up
        queries, given_up = reports.ask(now, 100)
        assert (len(queries), given_up) == (1, [])
    assert reports.ask(10_100, 100) == ([], [gone])
    assert reports.take(report(0, 10), 10_200) == []  # too late: it was said not to be reported
    assert reports.next_due_ns(100) is None


def test_at_the_end_everything_is_asked_for() -> None:
    reports = reports_from()
    reports.take(report(0, 10), 0)
    assert reports.expect_until(10, 7) == []
    assert reports.expect_until(25, 7) == [pb.Applied(first_step=10, n_steps=15, source=pb.Applied.AWAITED)]
    assert reports.ask(7, 1)[0] == [pb.AppliedQuery(first_step=10, n_steps=15)]


@given(st.lists(st.tuples(st.integers(1, 20), st.booleans()), max_size=30), st.integers(0, 2**32), st.floats(0, 0.9))
def test_every_step_is_handed_on_once_with_what_was_held(runs: list[tuple[int, bool]], seed: int, loss: float) -> None:
    """Reports are lost, queries and answers too; answers are cut anywhere and come twice."""
    chance, reports = random.Random(seed), reports_from(patience_ns=10**9)
    seen: list[int] = []
    end = 0

    def hear(message: pb.Applied) -> None:
        for new in reports.take(message, 0):
            if new.source == pb.Applied.AWAITED:
                continue
            steps = range(new.first_step, new.first_step + new.n_steps)
            assert list(new.u) == [float(k) for k in steps for _ in range(2)]
            assert new.device_ns == steps.stop * STEP_NS
            seen.extend(steps)

    for n_steps, lost in runs:
        if not lost:
            hear(report(end, end + n_steps))
        end += n_steps
    reports.expect_until(end, 0)
    for _ in range(10_000):
        queries, given_up = reports.ask(0, 0)
        assert not given_up
        if not queries:
            break
        for asked in queries:
            if chance.random() >= loss:
                answer = report(asked.first_step, asked.first_step + chance.randint(1, asked.n_steps))
                for _ in range(chance.randint(1, 2)):
                    hear(answer)
    assert sorted(seen) == list(range(end))


@pytest.mark.parametrize("first", [0, 3])
def test_begin_counts_once(first: int) -> None:
    reports = reports_from(first)
    reports.begin(50)
    assert reports.expect_until(5, 0) == [pb.Applied(first_step=first, n_steps=5 - first, source=pb.Applied.AWAITED)]
