"""A native camera's counter of frames that wraps, and one that says what cannot be."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from google.protobuf.message import Message
from hypothesis import given
from hypothesis import strategies as st

from aolink.devices.frame_count import FrameCount
from aolink.errors import DeviceError
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import record
from aolink.wire import messages_pb2 as pb
from tests.control.rigs import DRIFT, small_rig
from tests.kinds import log_of, truth_of
from tests.needs import missing
from tests.session.conftest import DEVICE, SANITISED, served_by
from tests.session.simulated_time import SimulatedTimeHub, run_session

RIG = small_rig(DRIFT)


def counting(hub: SimulatedTimeHub, first: int, bits: int, lost: range = range(0)) -> None:
    """The camera's counter has so many bits, and begins with ``first``; some of the frames are lost, by their count."""

    def wrapped(message: Message) -> Message | None:
        if not isinstance(message, pb.FrameChunk | pb.TruthChunk):
            return message
        if message.frame_id in lost:
            return None
        if isinstance(message, pb.TruthChunk):
            truth = pb.Truth.FromString(message.data)
            truth.frame_id = (truth.frame_id + first - 1) % 2**bits
            message.data = truth.SerializeToString()
            message.total = len(message.data)
        message.frame_id = (message.frame_id + first - 1) % 2**bits
        return message

    hub.change("camera", wrapped)


@pytest.mark.parametrize(("bits", "first"), [(8, 250), (16, 65_530), (16, 65_535), (32, 2**32 - 4), (24, 0), (16, 1)])
def test_frames_are_counted_on_where_the_counter_wraps(tmp_path: Path, bits: int, first: int) -> None:
    hub = SimulatedTimeHub(RIG)
    counting(hub, first, bits)
    run = run_session(hub, RIG, tmp_path / "a.mcap", 12, estimators=["o1"])
    assert (run.error, run.report.exposures, run.report.frames_lost, run.report.chunks_refused) == (None, 12, 0, 0)
    exposures = list(Recording(run.path).exposures())
    assert [each.frame_id for each in exposures] == list(range(first, first + 12))
    assert all(truth_of(each).path.any() for each in exposures)
    said = f"camera: its counter of frames, of {bits} bits, has begun anew with 0 after {2**bits - 1}: frames are"
    assert any(text.startswith(said) for text in log_of(run.path)) == (0 < 2**bits - first < 12)


def test_it_wraps_while_frames_are_lost(tmp_path: Path) -> None:
    hub = SimulatedTimeHub(RIG)
    counting(hub, 65_530, 16, lost=range(4, 10))
    run = run_session(hub, RIG, tmp_path / "a.mcap", 12)
    assert (run.error, run.report.exposures, run.report.frames_lost) == (None, 6, 6)
    assert [each.frame_id for each in run.exposures] == [65_530, 65_531, 65_532, 65_539, 65_540, 65_541]


@pytest.mark.slow
def test_a_counter_of_eight_bits_wraps_again_and_again(tmp_path: Path) -> None:
    hub = SimulatedTimeHub(RIG)
    counting(hub, 200, 8)
    run = run_session(hub, RIG, tmp_path / "a.mcap", 330, alone=True)
    assert (run.error, run.report.frames_lost) == (None, 0)
    assert [each.frame_id for each in run.exposures] == list(range(200, 530))


def test_a_counter_that_goes_back_is_named(tmp_path: Path) -> None:
    """A frame comes with a number that no wrap explains."""
    hub = SimulatedTimeHub(RIG)

    def back(message: Message) -> Message:
        if isinstance(message, pb.FrameChunk):
            message.frame_id += 300 if message.frame_id < 8 else 0
        return message

    hub.change("camera", back)
    run = run_session(hub, RIG, tmp_path / "a.mcap", 20)
    assert isinstance(run.error, DeviceError)
    expected = "the camera says FrameChunk.frame_id = 8, expected 308 to 309, for frame 307 began at fast step"
    assert expected in str(run.error)


@given(
    st.integers(8, 63), st.integers(0, 2**63), st.lists(st.tuples(st.integers(1, 200), st.integers(0, 3)), max_size=40)
)
def test_any_counter_is_followed_whatever_is_lost(bits: int, first: int, frames: list[tuple[int, int]]) -> None:
    """Frames, chunks of them that come again, and pauses in which fewer frames were taken than there was time for."""
    count, step = FrameCount(10), 1000
    first %= 2**bits
    taken = first
    assert count.take(taken, step) == (first, "")
    for more, late in frames:
        step_before, before = step, taken
        taken, step = taken + more, step + 10 * more + late
        found, what = count.take(taken % 2**bits, step)
        assert found == taken
        assert bool(what) == (taken // 2**bits > before // 2**bits)
        assert count.take(taken % 2**bits, step) == (taken, "")
        assert count.of_newest(taken % 2**bits) == taken
        assert count.take(before % 2**bits, step_before) == (before, "")


@pytest.mark.rare
def test_a_device_in_c_with_a_counter_of_16_bits(tmp_path: Path) -> None:
    source = tmp_path / "device"
    shutil.copytree(DEVICE, source, ignore=shutil.ignore_patterns("build"))
    for name, before, after in (
        ("camera.h", "uint64_t frame_id; ", "uint16_t frame_id; "),
        ("camera.c", "camera->frame_id = 1;", "camera->frame_id = 65533;"),
    ):
        text = (source / name).read_text()
        assert text.count(before) == 1
        (source / name).write_text(text.replace(before, after))
    try:
        made = subprocess.run(["make", "-s", "-C", source, f"CFLAGS={SANITISED}"], capture_output=True, text=True)
    except FileNotFoundError as error:
        missing("make", error)
    if made.returncode:
        missing("a C compiler with sanitisers", RuntimeError(made.stderr))
    rig, path = load_rig("section-vi"), tmp_path / "a.mcap"
    with served_by(source / "build" / "device") as ports:
        report = record(rig, *ports, path, estimators=["o3"], exposures=8)
    assert (report.ended, report.exposures, report.frames_lost) == ("complete", 8, 0)
    exposures = list(Recording(path).exposures())
    assert [each.frame_id for each in exposures] == list(range(65_533, 65_541))
    assert all(each.truth is not None for each in exposures)
