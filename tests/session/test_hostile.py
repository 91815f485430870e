"""Devices that lie, on real pseudo terminals: each gets one clear error, and what was true before is kept."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import Message

from aolink.devices.discovery import identify_port
from aolink.errors import DeviceError
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig
from aolink.session import record
from aolink.wire import messages_pb2 as pb
from tests.hostile import Lie, changed, lying_rig
from tests.kinds import log_of

RIG = load_rig("section-vi-lively")
HUGE = 2**63 - 1


def says(field: str, value: object) -> Callable[[Any], None]:
    """Change a field to a value, or by a function of the message."""

    def change(message: Any) -> None:
        new = value(message) if callable(value) else value
        owner, _, name = field.rpartition(".")
        target = getattr(message, owner) if owner else message
        if isinstance(new, list):
            del getattr(target, name)[:]
            getattr(target, name).extend(new)
        else:
            setattr(target, name, new)

    return change


def assert_caught(
    tmp_path: Path, lies: dict[str, Lie], pattern: str, *, rig: Rig = RIG, exposures: int = 6, real_time: bool = False,
    tcp: bool = False,
) -> None:  # fmt: skip
    path = tmp_path / "a.mcap"
    with (
        lying_rig(rig, **lies, real_time=real_time, tcp=tcp) as ports,
        pytest.raises(DeviceError, match=pattern) as caught,
    ):
        record(rig, *ports, path, exposures=exposures)
    assert "\n" not in str(caught.value)
    if path.exists():
        recording = Recording(path)
        assert recording.metadata["ended"].startswith("error: the")
        for exposure in recording.exposures():
            assert exposure.inputs_assumed <= exposure.n_steps
            assert np.abs(exposure.inputs).max() <= RIG.mirror.input_max.max()


_MIRROR: dict[type[Message], dict[str, list[object]]] = {
    pb.Applied: {
        "n_steps": [2**32 - 1, 0, 49],
        "u": [
            lambda applied: [50.0] * len(applied.u),
            lambda applied: [*applied.u[1:], float("nan")],
            lambda applied: [float("inf")] * len(applied.u),
        ],
        "first_step": [HUGE, lambda applied: applied.first_step + 1],
        "block_id": [HUGE, 0], "source": [77], "device_ns": [HUGE],
    },
    pb.CommandAck: {
        "block_id": [HUGE, 0], "code": [77, pb.QUEUE_FULL], "late_steps": [2**32 - 1], "superseded_steps": [51],
        "queue_end_step": [HUGE],
    },
    pb.ClockReply: {"device_receive_ns": [HUGE]},
    pb.VirtualTime: {
        "host_ns": [
            lambda handed: handed.host_ns + 7_400_000_000_000_000_000,
            lambda handed: handed.host_ns + 1_000_000_000_000, 1, -1,
        ],
        "mirror_bytes": [HUGE],
    },
}  # fmt: skip
_CAMERA: dict[type[Message], dict[str, list[object]]] = {
    pb.FrameChunk: {
        "frame_id": [HUGE, lambda chunk: chunk.frame_id + 2 if chunk.frame_id > 1 else 1],
        "plane": [1], "width": [41], "height": [2], "total": [2**32 - 1], "offset": [2**32 - 1], "data": [b""],
        "first_step": [lambda chunk: chunk.first_step + 1], "last_step": [lambda chunk: chunk.first_step, HUGE],
        "exposure_offset_ns": [2**32 - 1], "exposure_start_ns": [HUGE], "exposure_end_ns": [-HUGE],
    },
    pb.TruthChunk: {
        "total": [2**32 - 1], "offset": [2**32 - 1], "data": [lambda chunk: b"\xff" * len(chunk.data)],
    },
    pb.ClockReply: {"device_send_ns": [-HUGE]},
}  # fmt: skip


def rows(table: dict[type[Message], dict[str, list[object]]]) -> list[tuple[type[Message], str, object]]:
    return [(kind, name, value) for kind, fields in table.items() for name, each in fields.items() for value in each]


MIRROR, CAMERA = rows(_MIRROR), rows(_CAMERA)


@pytest.mark.parametrize(("kind", "field", "value"), MIRROR)
def test_a_mirror_that_lies_ends_the_session_with_the_field(
    tmp_path: Path, kind: type[Message], field: str, value: object
) -> None:
    lies = {"mirror": changed(kind, says(field, value), 30 if kind is pb.VirtualTime else 3)}
    assert_caught(tmp_path, lies, rf"the mirror says {kind.__name__}\.{field}")


@pytest.mark.parametrize(("kind", "field", "value"), CAMERA)
def test_a_camera_that_lies_ends_the_session_with_the_field(
    tmp_path: Path, kind: type[Message], field: str, value: object
) -> None:
    # The length of the data is what does not fit where the offset is wrong, the last step where the first one is.
    named = {"offset": "data", "first_step": "last_step"}.get(field, field)
    assert_caught(tmp_path, {"camera": changed(kind, says(field, value), 2)}, rf"{kind.__name__}\.{named}")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("kind", 7), ("model", "\x1b[2J"), ("serial_number", "x" * 5000), ("fast_step_ns", 0), ("next_step", 2**64 - 1),
        ("step_zero_ns", -(2**63)),
    ],
)  # fmt: skip
def test_an_identity_that_cannot_be(field: str, value: object) -> None:
    with (
        lying_rig(RIG, camera=changed(pb.Identity, says(field, value))) as (camera, _),
        pytest.raises(DeviceError, match=rf"Identity\.{field} = "),
    ):
        identify_port(camera)


@pytest.mark.parametrize(("field", "value"), [("queue_steps", 401), ("watchdog_s", 60.0), ("dac_bits", 8)])
def test_a_mirror_of_another_rig_file(tmp_path: Path, field: str, value: object) -> None:
    lies = {"mirror": changed(pb.Identity, says(f"mirror.{field}", value))}
    assert_caught(tmp_path, lies, rf"mirror\.{field} is .* {value} on the device")


def test_counts_beyond_the_converter_end_the_session(tmp_path: Path) -> None:
    rig = replace(RIG, sensor=replace(RIG.sensor, bit_depth=12))
    bright = changed(pb.FrameChunk, says("data", lambda chunk: b"\xff\xff" * (len(chunk.data) // 2)))
    assert_caught(tmp_path, {"camera": bright}, "65535", rig=rig, exposures=2)


def test_a_code_that_nobody_knows_is_a_refusal(tmp_path: Path) -> None:
    lies = {"camera": changed(pb.Ack, says("code", 77))}
    assert_caught(tmp_path, lies, "code 77")


def test_a_device_that_says_what_the_other_has_to_say_is_refused(tmp_path: Path) -> None:
    def lie(message: Message) -> Message:
        return pb.CommandAck(block_id=1) if isinstance(message, pb.FrameChunk) else message

    assert_caught(tmp_path, {"camera": lie}, "CommandAck")


def test_a_real_device_cannot_take_over_the_clock(tmp_path: Path) -> None:
    """On real time `VirtualTime` changes nothing; who claims virtual time and drives none is not waited for forever."""

    def handing(message: Message) -> Iterator[Message]:
        yield pb.VirtualTime(host_ns=9 * 10**18, camera_bytes=1, mirror_bytes=1)
        yield message

    with lying_rig(RIG, camera=handing, mirror=handing, real_time=True) as ports:
        report = record(RIG, *ports, tmp_path / "a.mcap", exposures=2)
    recording = Recording(tmp_path / "a.mcap")
    assert (report.ended, report.virtual_time, report.exposures) == ("complete", False, 2)
    assert recording.end_ns - recording.start_ns < 60e9
    assert abs(recording.start_ns - time.time_ns()) < 3600e9


def flood(after: type[Message], begun: threading.Event) -> Lie:
    """Messages without end in the place of an answer."""

    def lie(message: Message) -> Message | Iterator[Message]:
        return endless() if isinstance(message, after) else message

    def endless() -> Iterator[Message]:
        while True:
            yield pb.Event(text="x" * 4000)
            begun.set()

    return lie


@pytest.mark.slow
@pytest.mark.parametrize("real_time", [False, True])
def test_a_flood_ends_the_session_before_it_fills_the_memory(tmp_path: Path, real_time: bool) -> None:
    lies = {"camera": flood(pb.Ack, threading.Event())}
    # By the clock, a machine that is busy may give the silent camera up before so much has come.
    late = "|did not answer|has sent no frame" if real_time else ""
    assert_caught(tmp_path, lies, "without answering" + late, real_time=real_time)


@pytest.mark.slow
def test_a_stop_is_heard_in_a_flood(tmp_path: Path) -> None:
    """The flood has no end, and nothing but the stop ends the session."""
    begun = threading.Event()
    with lying_rig(RIG, mirror=flood(pb.CommandAck, begun)) as ports:
        report = record(RIG, *ports, tmp_path / "a.mcap", stop=begun.is_set)
    assert report.ended == "interrupted"
    # A busy machine may hold the flood up, or let more of it come, before the session gives up.
    why = ("sends messages without handling those it was sent", "has said nothing for", "without answering")
    assert any(each in warning for each in why for warning in report.warnings)
    assert Recording(tmp_path / "a.mcap").complete


@pytest.mark.slow
def test_a_clock_that_is_set_back_during_a_session(tmp_path: Path) -> None:
    """From the first stamp on the frames say that they are uncertain, until the new clock is known; nothing stops."""
    set_back_ns, path = -50_000_000, tmp_path / "a.mcap"
    is_set = threading.Event()

    def lie(message: Message) -> Message:
        if isinstance(message, pb.FrameChunk) and message.frame_id == 8:
            is_set.set()
        if is_set.is_set():
            names = ("exposure_start_ns", "exposure_end_ns", "device_receive_ns", "device_send_ns", "device_ns")
            for name in names:
                if hasattr(message, name):
                    setattr(message, name, getattr(message, name) + set_back_ns)
        return message

    with lying_rig(RIG, camera=lie, mirror=lie, real_time=True) as ports:
        report = record(RIG, *ports, path, exposures=25)
    assert report.ended == "complete"
    assert any("the camera's clock was set back by 0.0" in warning for warning in report.warnings)
    exposures = list(Recording(path).exposures())
    step_ns = RIG.timing.fast_step_ns
    # Steps and host run at one rate: this is when an exposure began, up to a constant.
    began = np.array([e.host_start_ns - e.first_step * step_ns for e in exposures], dtype=np.int64)
    error = (began - began[0]).astype(float)
    sigma = np.array([e.clock_sigma_ns for e in exposures])
    set_back = [e.frame_id for e in exposures].index(8)
    assert sigma[set_back] > 45e6
    assert abs(error[set_back]) > 45e6
    assert sigma[-1] < 20e6
    assert np.abs(error[sigma < 20e6]).max() < 20e6  # who claims to know is right
    assert any("the camera's clock was set back by" in text for text in log_of(path))
