"""Estimation beside the recording: nothing stands between the wire and the file."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import pty
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import Message

from aolink.errors import EstimatorError
from aolink.estimation import Driver, make_estimator
from aolink.estimation.driver import SkippedInputs
from aolink.exposure import Exposure
from aolink.recording import schemas_pb2 as pb
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference, reestimate
from aolink.rig import load_rig, parse_rig
from aolink.session import Report, record
from aolink.session.estimating import BesideTheLoop, Outcome
from aolink.session.report import LatencyBook
from aolink.session.waiting import Waiting, most_waiting
from aolink.wire import messages_pb2 as wire
from tests.commands import simulated_rig
from tests.conftest import Session
from tests.kinds import messages_of
from tests.session.slow import SLOW, slow_installed

FAST = load_rig("section-vi-lively").toml.replace("exposure_steps = 200", "exposure_steps = 50")
"""A rig whose camera has 20 exposures a second."""
EXPOSURES = 40


@pytest.fixture(scope="module", autouse=True)
def with_slow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with slow_installed(tmp_path_factory.mktemp("installed")):
        yield


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rig") / "fast.toml"
    path.write_text(FAST)
    return path


@pytest.fixture(scope="module")
def loaded(rig_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session in real time with an estimator that is slower than the camera."""
    path, names = tmp_path_factory.mktemp("loaded") / "session.mcap", [SLOW, "o3"]
    with simulated_rig(rig_file, "--real-time") as ports:
        report = record(parse_rig(FAST), *ports, path, estimators=names, exposures=EXPOSURES)
    return Session(path, report)


@pytest.mark.slow
def test_a_slow_estimator_costs_no_frame_and_no_command(loaded: Session) -> None:
    report, recording = loaded.report, Recording(loaded.path)
    assert (report.ended, report.exposures, report.frames_received) == ("complete", EXPOSURES, EXPOSURES)
    assert report.frames_lost == report.frames_incomplete == report.connection_faults["sequence_gaps"] == 0
    assert report.commands.commanded == 50 * EXPOSURES
    assert recording.complete
    for topic in (topics.IMAGE, topics.EXPOSURE, topics.TRUTH, topics.LATENCY):
        assert recording.counts[topic] == EXPOSURES


def skipped_by(recording: Recording, name: str) -> set[int]:
    """Frame ids of the exposures that an estimator had no time for."""
    return {step.exposure.frame_id for step in recording.steps([name]) if name in step.skipped}


@pytest.mark.slow
def test_what_it_had_no_time_for_is_counted_and_recorded(loaded: Session) -> None:
    recording, metadata = Recording(loaded.path), Recording(loaded.path).metadata
    for name in (SLOW, "o3"):
        counted = loaded.report.estimation[name]
        accounts = messages_of(pb.Estimation, recording, topics.estimation_topic(name))
        assert counted.estimated + counted.skipped == len(accounts) == EXPOSURES
        assert sorted(each.frame_id for each in accounts) == list(range(1, EXPOSURES + 1))
        estimated = [each.frame_id for each in recording.estimates(name)]
        assert [each.frame_id for each in accounts if not each.skipped] == estimated
        assert len(estimated) == counted.estimated == len(counted.took_ms) > 0
        assert all((each.took_ns > 0) != each.skipped for each in accounts)
        assert all(bool(each.reason) == each.skipped for each in accounts)
        assert skipped_by(recording, name) == {each.frame_id for each in accounts if each.skipped}
        assert metadata[f"skipped_{name}"] == str(counted.skipped)
    assert loaded.report.estimation[SLOW].skipped > loaded.report.estimation["o3"].skipped
    assert loaded.report.exposures_skipped[SLOW] == loaded.report.estimation[SLOW].skipped > 0


@pytest.mark.slow
def test_what_was_estimated_online_is_the_same_offline_with_the_same_exposures_skipped(loaded: Session) -> None:
    recording = Recording(loaded.path)
    again = reestimate(recording, [SLOW, "o3"], as_recorded=True)
    for name in (SLOW, "o3"):
        assert first_difference(recording.estimates(name), again[name]) is None


@pytest.mark.rare
def test_compare_replay_and_estimate_know_of_the_skipped(
    loaded: Session, aolink: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    skipped = loaded.report.estimation[SLOW].skipped
    compared = aolink("compare", loaded.path, env=dict(os.environ))
    assert (compared.returncode, compared.stderr) == (0, "")
    assert compared.stdout.endswith("the same\n")
    replayed = aolink("replay", loaded.path, "-e", "o3", "--json", env=dict(os.environ))
    assert replayed.returncode == 0, replayed.stderr
    done = aolink("estimate", loaded.path, "-e", SLOW, "-o", "whole.mcap", env=dict(os.environ))
    assert done.returncode == 0, done.stderr
    assert f"no time for {skipped} exposures, all are estimated here" in " ".join(done.stdout.split())
    whole = Recording(tmp_path / "whole.mcap")
    assert len(whole.estimates(SLOW)) == EXPOSURES
    # The exposures that were skipped tell it more: it is not the same.
    last = Recording(loaded.path).estimates(SLOW)[-1]
    assert not np.array_equal(whole.estimates(SLOW)[last.frame_id - 1].end_state, last.end_state)
    assert not skipped_by(whole, SLOW)
    facts = json.loads(aolink("info", loaded.path, "--json", env=dict(os.environ)).stdout)
    assert facts["losses"][f"skipped_{SLOW}"] == skipped


def test_latencies_stay_in_order_beside_a_slow_estimator(loaded: Session) -> None:
    """A frame is estimated when its first estimate is there, and then a command knows it."""
    skipped = skipped_by(Recording(loaded.path), SLOW) & skipped_by(Recording(loaded.path), "o3")
    assert len(loaded.report.latencies) == EXPOSURES
    for each in loaded.report.latencies:
        assert 0 < each.first_byte_ns <= each.complete_ns
        assert (each.estimated_ns == 0) == (each.frame_id in skipped)
        assert each.estimated_ns == 0 or each.complete_ns <= each.estimated_ns
        if each.command_sent_ns and each.estimated_ns:
            assert each.estimated_ns <= each.command_sent_ns


def exposures_of(recording: Session) -> list[Exposure]:
    return list(Recording(recording.path).exposures())


def outcome_of(beside: BesideTheLoop, name: str, frame_id: int) -> Outcome:
    """Serve the processes until this estimator is through with a frame."""
    for _ in range(6000):
        beside.serve(0.01)
        for outcome in beside.outcomes():
            if (outcome.estimator, outcome.exposure.frame_id) == (name, frame_id):
                return outcome
    return pytest.fail(f"{name} is not through with frame {frame_id} within a minute")


@pytest.mark.rare
def test_a_slow_estimator_makes_no_fast_one_skip(recorded: Session) -> None:
    rig, exposures = load_rig("section-vi-lively"), exposures_of(recorded)
    with BesideTheLoop(rig, [SLOW, "o3"]) as beside:
        beside.get_ready(lambda: False)
        for exposure in exposures:
            beside.offer(exposure)
            assert outcome_of(beside, "o3", exposure.frame_id).message is not None
        rest = beside.finish(0.0)
    assert {each.estimator for each in rest} <= {SLOW}
    assert all(each.message is None and "the session was over" in each.reason for each in rest)


@pytest.mark.slow
def test_an_estimate_from_beside_is_that_of_the_driver(recorded: Session) -> None:
    rig, exposures = load_rig("section-vi-lively"), exposures_of(recorded)
    ours = []
    with BesideTheLoop(rig, ["o3"]) as beside:
        beside.get_ready(lambda: False)
        for exposure in exposures:
            beside.offer(exposure)
            outcome = outcome_of(beside, "o3", exposure.frame_id)
            assert outcome.took_ns > 0
            ours.append(outcome.estimate(rig))
    assert first_difference(ours, Recording(recorded.path).estimates("o3")) is None


@pytest.mark.slow
def test_an_estimator_that_cannot_work_ends_the_session_before_it_begins() -> None:
    why = "the estimator o9 does not start: there is no estimator 'o9'"
    with BesideTheLoop(load_rig("section-vi"), ["o9"]) as beside, pytest.raises(EstimatorError, match=why):
        beside.get_ready(lambda: False)


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it reads /proc")
def test_the_recording_goes_on_without_an_estimator_that_was_killed(rig_file: Path, tmp_path: Path) -> None:
    rig, path = parse_rig(FAST), tmp_path / "a.mcap"

    def inputs(first_step: int, n_steps: int) -> np.ndarray:
        if first_step == 1000:
            (process,) = children(os.getpid(), "estimator_process")
            os.kill(process, signal.SIGKILL)
        return rig.drive.inputs(first_step, n_steps, rig.timing.fast_step_s)

    with simulated_rig(rig_file, "--real-time") as ports:
        report = record(rig, *ports, path, estimators=["o3"], exposures=40, inputs=inputs)
    assert (report.ended, report.frames_received, report.frames_lost) == ("complete", 40, 0)
    counted = report.estimation["o3"]
    assert "its process ended" in counted.failed
    assert counted.estimated + counted.skipped == 40
    assert counted.skipped >= 20
    assert [each for each in report.warnings if each.startswith("the estimator o3 failed, the recording goes on")]
    recording = Recording(path)
    assert recording.complete
    again = reestimate(recording, ["o3"], as_recorded=True)["o3"]
    assert first_difference(recording.estimates("o3"), again) is None


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it reads /proc")
@pytest.mark.parametrize("wakes", [False, True])
def test_an_estimator_that_hangs_is_said_to_and_fails_unless_it_wakes(
    rig_file: Path, tmp_path: Path, wakes: bool
) -> None:
    """It is stopped, while exposures go on for longer than it may take, and goes on just before the end."""
    rig, path = parse_rig(FAST), tmp_path / "a.mcap"
    heard = {1000: signal.SIGSTOP, 7500: signal.SIGCONT} if wakes else {1000: signal.SIGSTOP}

    def inputs(first_step: int, n_steps: int) -> np.ndarray:
        if first_step in heard:
            (process,) = children(os.getpid(), "estimator_process")
            os.kill(process, heard.pop(first_step))
        return rig.drive.inputs(first_step, n_steps, rig.timing.fast_step_s)

    with simulated_rig(rig_file, "--real-time") as ports:
        report = record(rig, *ports, path, estimators=["o3"], exposures=160, inputs=inputs)
    assert (report.ended, report.frames_lost, heard) == ("complete", 0, {})
    (said,) = [each for each in report.warnings if "hangs" in each]
    assert "the estimator o3 hangs, its exposures are skipped: it has not answered for 5 s, since it got frame" in said
    counted = report.estimation["o3"]
    assert counted.estimated + counted.skipped == 160
    assert ("it has not answered for" in counted.failed) == (not wakes)
    assert any("the estimator o3 failed" in each for each in report.warnings) == (not wakes)
    again = reestimate(Recording(path), ["o3"], as_recorded=True)["o3"]
    assert first_difference(Recording(path).estimates("o3"), again) is None


def children(parent: int, what: str) -> list[int]:
    """Children of a process with this in their command line."""
    found = []
    for each in Path("/proc").glob("[0-9]*"):
        try:
            status, command = (each / "stat").read_text(), (each / "cmdline").read_text()
        except OSError:  # it has ended meanwhile
            continue
        if int(status.rpartition(")")[2].split()[1]) == parent and what in command:
            found.append(int(each.name))
    return found


@contextmanager
def recording_process(rig_file: Path, path: Path, *more: str, **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """`aolink record` in real time with a slow estimator."""
    with simulated_rig(rig_file, "--real-time") as (camera, mirror):
        command = [
            sys.executable, "-m", "aolink", "record", "--camera", camera, "--mirror", mirror, "--rig", str(rig_file),
            "-o", str(path), *more,
        ]  # fmt: skip
        with subprocess.Popen(command, **options) as process:
            try:
                yield process
            finally:
                process.kill()


def until(true: Callable[[], bool]) -> None:
    for _ in range(6000):
        if true():
            return
        time.sleep(0.01)
    pytest.fail("it does not become true within a minute")


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it reads /proc")
def test_a_killed_session_takes_its_estimators_along(rig_file: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with recording_process(rig_file, path, "-e", SLOW, "-e", "o3", stderr=subprocess.DEVNULL) as process:
        until(lambda: path.exists() and path.stat().st_size > 20_000)
        estimators = children(process.pid, "estimator_process")
        assert len(estimators) == 2
        process.kill()
        until(lambda: not any(is_running(each) for each in estimators))


def is_running(process: int) -> bool:
    try:
        status = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


@pytest.mark.slow
def test_ctrl_c_waits_for_what_is_under_way_and_records_the_rest_as_skipped(rig_file: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with recording_process(
        rig_file, path, "-e", SLOW, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:  # fmt: skip
        until(lambda: path.exists() and path.stat().st_size > 20_000)
        os.killpg(process.pid, signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, b"aolink: interrupted by SIGINT\n")
    recording = Recording(path)
    assert recording.complete
    exposures = {each.frame_id for each in recording.exposures()}
    estimated = {each.frame_id for each in recording.estimates(SLOW)}
    assert estimated | skipped_by(recording, SLOW) == exposures
    assert not estimated & skipped_by(recording, SLOW)
    assert f"{SLOW}: {len(estimated)} of {len(exposures)} exposures".encode() in output


@pytest.mark.slow
def test_a_terminal_that_takes_nothing_holds_up_no_session(rig_file: Path, tmp_path: Path) -> None:
    """As after Ctrl-S in the middle of a session: the progress bar cannot be drawn."""
    path = tmp_path / "a.mcap"
    terminal, theirs = pty.openpty()
    again = os.open(os.ttyname(theirs), os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)

    def begun() -> bool:
        while select.select([terminal], [], [], 0)[0]:
            os.read(terminal, 65536)
        return path.exists() and path.stat().st_size > 20_000

    with recording_process(rig_file, path, "--exposures", str(EXPOSURES), stdout=subprocess.DEVNULL, stderr=theirs):
        until(begun)
        with contextlib.suppress(BlockingIOError):
            while os.write(again, b"x" * 256):
                pass
        until(lambda: Recording(path).end_metadata.get("ended") is not None)
        report = Recording(path).end_metadata
    for each in (terminal, theirs, again):
        os.close(each)
    assert (report["ended"], report["frames_received"]) == ("complete", str(EXPOSURES))


@pytest.mark.slow
def test_who_is_told_and_never_comes_back_holds_up_no_session(rig_file: Path, tmp_path: Path) -> None:
    go_on = threading.Event()

    def never_back(exposures: int) -> None:
        go_on.wait(60)

    with simulated_rig(rig_file, "--real-time") as ports:
        report = record(
            parse_rig(FAST), *ports, tmp_path / "a.mcap", estimators=["o3"], exposures=EXPOSURES, progress=never_back
        )
    go_on.set()
    assert (report.ended, report.frames_received, report.frames_lost) == ("complete", EXPOSURES, 0)


class Seen:
    """A sink that keeps what it gets, or fails with the first message of a topic."""

    may_wait = True

    def __init__(self, fails_at: str = "") -> None:
        self.messages: list[tuple[str, int, bytes]] = []
        self.fails_at = fails_at

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        if topic == self.fails_at:
            raise ValueError("no more paper")
        self.messages.append((topic, time_ns, message.SerializeToString()))


def test_a_sink_gets_what_is_recorded(rig_file: Path, tmp_path: Path) -> None:
    seen, report = Seen(), Report()
    with simulated_rig(rig_file, "--real-time") as ports:
        given = record(
            parse_rig(FAST), *ports, tmp_path / "a.mcap", estimators=["o3"], exposures=20, sinks=[seen], report=report
        )
    assert given is report
    assert not seen.may_wait
    raw = Recording(tmp_path / "a.mcap").raw_messages()
    assert seen.messages == [(each.topic, each.log_time_ns, each.data) for each in raw]


def test_a_sink_that_fails_is_a_warning(rig_file: Path, tmp_path: Path) -> None:
    with simulated_rig(rig_file, "--real-time") as ports:
        report = record(
            parse_rig(FAST), *ports, tmp_path / "a.mcap", exposures=3, sinks=[Seen(topics.EXPOSURE), other := Seen()]
        )
    assert (report.ended, report.frames_received) == ("complete", 3)
    (warning,) = report.warnings
    assert "no more paper" in warning
    assert [each[0] for each in other.messages].count(topics.IMAGE) == 3


def test_what_exists_before_a_session_is_not_garbage_collected_during_it(rig_file: Path, tmp_path: Path) -> None:
    old, collected = [object()], list[bool]()

    def collects_old() -> bool:
        return any(each is old for each in gc.get_objects())

    class Looks(Seen):
        def take(self, topic: str, time_ns: int, message: Message) -> None:
            if topic == topics.EXPOSURE:
                collected.append(collects_old())

    with simulated_rig(rig_file, "--real-time") as ports:
        record(parse_rig(FAST), *ports, tmp_path / "a.mcap", exposures=3, sinks=[Looks()])
    assert collected
    assert not any(collected)
    assert collects_old()


def test_a_queue_keeps_order_and_when_it_is_full_goes_on_with_the_newest() -> None:
    waiting = Waiting[int](3)
    assert [waiting.put(k) for k in range(3)] == [[], [], []]
    assert waiting.take() == 0
    assert [waiting.put(k) for k in (3, 4, 5)] == [[], [1, 2, 3], []]
    assert [waiting.take() for _ in range(3)] == [4, 5, None]


def test_half_a_second_may_wait() -> None:
    assert most_waiting(parse_rig(FAST).timing) == 10
    assert most_waiting(load_rig("section-vi").timing) == 3
    slow = FAST.replace("exposure_steps = 50", "exposure_steps = 5000")
    assert most_waiting(parse_rig(slow).timing) == 2


@pytest.mark.parametrize("name", ["o1", "o3", "moments", "profile"])
def test_a_skipped_exposure_is_like_a_frame_that_was_lost(recorded: Session, name: str) -> None:
    """Its inputs lead the next one: that is what the assembler makes of a lost frame."""
    rig, exposures = load_rig("section-vi-lively"), exposures_of(recorded)
    driver = Driver(rig, [name, "o2"], skipped={name: {1, 4, 5, 12}})
    estimates = [each for _, some in driver.steps(exposures) for each in some]
    ours, others = ([e for e in estimates if (e.estimator == name) == own] for own in (True, False))
    assert [each.frame_id for each in ours] == [2, 3, 6, 7, 8, 9, 10, 11]
    assert [each.frame_id for each in others] == list(range(1, 13))
    theirs = with_frames_lost(Recording(recorded.path), {1, 4, 5, 12})
    estimator = make_estimator(rig, name)
    assert first_difference(ours, [estimator.step(each) for each in theirs]) is None
    one_by_one = Driver(rig, [name], skipped={name: {1, 4, 5, 12}})
    assert first_difference(ours, [each for e in exposures for each in one_by_one.step(e)]) is None


def with_frames_lost(recording: Recording, lost: set[int]) -> list[Exposure]:
    """The exposures of a recording whose camera has lost some frames."""
    from aolink.recording.exposures import ExposureAssembly

    assembly, exposures, is_lost = ExposureAssembly(recording.rig), [], False
    for each in recording.messages():
        if isinstance(each.message, pb.ExposureInfo):
            is_lost = each.message.frame_id in lost
        if each.topic in (topics.EXPOSURE, topics.IMAGE) and is_lost:
            continue
        exposures += assembly.take(each.topic, each.message)
    return exposures + assembly.flush()


def test_over_a_long_gap_the_first_inputs_are_forgotten() -> None:
    def exposure(k: int) -> Exposure:
        return Exposure(
            frame_id=k, first_step=1000 * k, n_steps=1000, pixels=np.zeros((1, 4), np.uint16),
            mask=np.ones((1, 4), bool), inputs=np.full((1000, 2), float(k)), lead_inputs=np.zeros((0, 2)),
        )  # fmt: skip

    skipped = SkippedInputs()
    for k in range(150):
        skipped.skip(exposure(k))
    lead = skipped.leading(exposure(150)).lead_inputs
    assert lead.shape == (100_000, 2)
    assert (lead[0, 0], lead[-1, 0]) == (50.0, 149.0)
    assert skipped.leading(exposure(151)).lead_inputs.shape == (0, 2)


def test_the_next_command_knows_a_frame_that_is_estimated_whatever_the_order() -> None:
    recorded: list[pb.Latency] = []
    book = LatencyBook(Report(), lambda now, latency: recorded.append(latency), commanded=True)
    for frame in (1, 2, 3):
        book.frame(pb.Latency(frame_id=frame, complete_ns=10 * frame))
    book.estimated(2, 25, 25)
    book.sent(wire.CommandBlock(block_id=1, cause_frame_id=2), 26)
    book.estimated(1, 40, 40)  # a slow estimator had it
    book.estimated(3, 0, 40)  # all skipped it
    book.sent(wire.CommandBlock(block_id=2, cause_frame_id=3), 41)
    for block in (1, 2):
        book.acknowledged(block, 50)
        book.applied(block, 60, 61)
    facts = {e.frame_id: (e.estimated_ns, e.command_sent_ns, e.command_applied_ns) for e in recorded}
    assert facts == {2: (25, 26, 60), 1: (40, 41, 60), 3: (0, 41, 60)}
