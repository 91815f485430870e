"""Long sessions on simulated time: what the loop holds does not grow with them, whoever never answers."""

from __future__ import annotations

import gc
import os
import signal
import types
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from aolink.exposure import Exposure
from aolink.recording import schemas_pb2 as schemas
from aolink.recording import topics
from aolink.recording.lead import Lead
from aolink.recording.reader import Recording
from aolink.recording.writer import RecordingWriter
from aolink.rig import Rig, parse_rig
from aolink.session.estimating import BesideTheLoop
from aolink.session.report import LatencyBook, Report
from aolink.wire import messages_pb2 as pb
from tests.control.rigs import DRIFT, small_rig
from tests.kinds import messages_of
from tests.session.simulated_time import Run, SimulatedTimeHub, run_session
from tests.session.test_beside import children

RIG = parse_rig(small_rig(DRIFT).toml.replace("exposure_steps = 40", "exposure_steps = 20"))
LOSSY = parse_rig(f"{RIG.toml}\n[simulation.faults]\npacket_loss_rate = 0.25\ncommand_loss_rate = 0.25\n")
BOUNDED = {
    "report.latencies": 10_000, "delay_ms": 10_000, "_gate._sent": 4096,
    "_flights": 64 * 6, "_skipped._rows": 10_000, "loop._sent": 1000, "loop._held": 1000, "loop._limited": 1000,
}  # fmt: skip
"""What grows for a while, by the end of its name, and up to how many items."""
OTHERS = (types.ModuleType, type, types.CodeType, types.FrameType, RecordingWriter, SimulatedTimeHub, Exposure)


def held(thing: object) -> dict[str, int]:
    """Numbers of items in all containers that a thing holds, directly or through others, by the way to them."""
    seen, todo, found = set[int](), [("", thing)], dict[str, int]()
    while todo:
        name, each = todo.pop()
        if id(each) in seen or isinstance(each, OTHERS) or name.endswith(("_estimating.offer", "_show", "__globals__")):
            continue
        seen.add(id(each))
        if isinstance(each, dict | list | deque | set | bytearray):
            found[name] = found.get(name, 0) + len(each)
        if isinstance(each, types.FunctionType):
            todo += [(name, cell) for cell in each.__closure__ or ()]
        elif hasattr(each, "__dict__") and not isinstance(each, types.MethodType):
            todo += [(f"{name}.{key}", value) for key, value in vars(each).items()]
        else:
            todo += [(name, inner) for inner in gc.get_referents(each)]
    return found


def long_session(
    folder: Path, rig: Rig, hub: SimulatedTimeHub | None = None, exposures: int = 400, more_latencies: int = 0,
    **options: Any,
) -> Run:  # fmt: skip
    """A session whose loop holds no more at its end than in the middle."""
    bounded = BOUNDED | {"_latencies._open": more_latencies, "_latencies._blocks": more_latencies}
    hub, seen = hub or SimulatedTimeHub(rig, 1), dict[int, dict[str, int]]()

    def progress(done: int) -> None:
        for part in (exposures * 3 // 10, exposures * 6 // 10):
            if done >= part and part not in seen:
                seen[part] = held(hub.loop)

    run = run_session(hub, rig, folder / "a.mcap", exposures, progress=progress, **options)
    before, after = seen.values()
    more = {name: (before.get(name, 0), count) for name, count in after.items() if count > before.get(name, 0) + 30}
    for name, (_, count) in more.items():
        assert count <= max((most for end, most in bounded.items() if name.endswith(end)), default=0), more
    return run


@contextmanager
def stopped_estimator(rig: Rig, name: str) -> Iterator[BesideTheLoop]:
    """An estimator that hangs from its first exposure on."""
    with BesideTheLoop(rig, [name]) as beside:
        beside.get_ready(lambda: False)
        (process,) = children(os.getpid(), "estimator_process")
        os.kill(process, signal.SIGSTOP)
        yield beside


@pytest.mark.slow
def test_a_camera_alone(tmp_path: Path) -> None:
    run = long_session(tmp_path, RIG, alone=True, estimators=["o1"])
    latencies = messages_of(schemas.Latency, Recording(run.path), topics.LATENCY)
    assert [each.frame_id for each in latencies] == [each.frame_id for each in run.exposures]


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["", "integrator"])
def test_a_mirror_some_of_whose_answers_and_reports_are_lost(tmp_path: Path, controller: str) -> None:
    """Some blocks are never answered: the account lets them go."""
    run = long_session(tmp_path, LOSSY, exposures=300, controller=controller)
    assert bool(run.report.commands.by_answer.get("NONE")) == bool(controller)


@pytest.mark.rare
def test_an_estimator_that_never_answers(tmp_path: Path) -> None:
    """It serves the controller, which hears nothing."""
    with stopped_estimator(RIG, "o1") as beside:
        run = long_session(tmp_path, RIG, exposures=200, beside=beside, controller="lqg", estimators=["o1"])
    assert run.report.ended == "complete"
    assert run.report.estimation["o1"].skipped == 200


@pytest.mark.rare
@pytest.mark.parametrize("controller", ["", "integrator"])
def test_a_mirror_that_reports_nothing(tmp_path: Path, controller: str) -> None:
    """It acknowledges its commands: the exposures come with what was commanded."""
    hub = SimulatedTimeHub(RIG, 1)
    hub.change("mirror", lambda message: None if isinstance(message, pb.Applied) else message)
    run = long_session(tmp_path, RIG, hub, 500, 1000, controller=controller)
    assert run.report.ended == "complete"
    assert {each.inputs_assumed for each in run.exposures} == {20}
    assert run.report.commands.commanded == run.report.commands.not_reported + run.report.commands.superseded


def test_without_a_mirror_a_latency_ends_with_its_estimate() -> None:
    recorded: list[tuple[int, int]] = []
    book = LatencyBook(
        Report(), lambda now, latency: recorded.append((latency.estimated_ns, now)), commanded=False
    )  # fmt: skip
    for frame in (1, 2):
        book.frame(schemas.Latency(frame_id=frame))
    book.estimated(2, 25, 25)
    book.estimated(2, 27, 27)
    book.estimated(1, 0, 30)
    assert recorded == [(25, 25), (0, 30)]


def test_a_latency_whose_command_never_comes_ends_some_time() -> None:
    recorded: list[int] = []
    book = LatencyBook(Report(), lambda now, latency: recorded.append(latency.frame_id), commanded=True)
    for frame in range(1, 5001):
        book.frame(schemas.Latency(frame_id=frame, complete_ns=frame))
        book.estimated(frame, frame, frame)
    assert 3000 < len(recorded) < 5000
    assert recorded == sorted(recorded)
    book.close(6000)
    assert recorded == list(range(1, 5001))


def test_a_part_of_a_recording_keeps_no_more_than_an_exposure_looks_back() -> None:
    lead, message = Lead(), pb.CommandBlock(n_steps=1000)
    for first_step in range(0, 10_000_000, 1000):
        message = pb.CommandBlock(first_step=first_step, n_steps=1000)
        lead.add(topics.COMMAND, message, 0, 1)
    assert 90 < len(list(lead.messages())) <= 101
