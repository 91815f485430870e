"""The check that a decoded message is possible, before anything is computed with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message

from aolink.estimation.estimate import Status
from aolink.recording import schemas_pb2 as pb
from aolink.recording import topics
from aolink.recording.convert import is_compressed
from aolink.rig import Rig
from aolink.wire import messages_pb2 as wire
from aolink.wire.runs_pb2 import Run

_LAST_NS = 1 << 62
"""Times and fast steps up to this, in ns, can be added and subtracted in 64 bits: 146 years."""
_MOST_INPUT = 1e100
"""No mirror takes a larger input, whatever its unit; beyond it, sums and quotients may overflow."""
_FEW = 10_000
"""Up to so many numbers, BLAS computes on one thread."""
_WITHOUT_INPUTS = (wire.Applied.AWAITED, wire.Applied.NOT_REPORTED)


def what_is_wrong(message: Message, rig: Rig, topic: str = "") -> str:
    """The field of a message that contradicts itself, its topic, the rig or the calendar, in words; empty where none
    does."""
    if isinstance(message, RawImage):
        return _of_picture(message, rig, topic) if topics.named(topic).after else ""
    check = _CHECKS.get(type(message))
    return check(message, rig) if check else ""


def _of_run(run: wire.Applied | wire.CommandBlock | Run, rig: Rig) -> str:
    if (run.first_step + run.n_steps) * rig.timing.fast_step_ns > _LAST_NS:
        return "first_step is beyond all times"
    if isinstance(run, wire.Applied) and run.source in _WITHOUT_INPUTS:
        return ""
    # Inputs in bytes take 8 bytes a number. A report without the inputs of its steps would be expanded to all of these
    # steps.
    inputs = run.u
    if (len(inputs) / 8 if isinstance(inputs, bytes) else len(inputs)) != run.n_steps * rig.n_inputs:
        return "u has not the inputs of its steps"
    u = np.frombuffer(inputs, "<f8") if isinstance(inputs, bytes) else np.array(inputs)
    # The sum of squares is fast, and is NaN or infinite where one of them is. BLAS computes that of many numbers on
    # several threads, which wait for each other where the cores are busy.
    fine = len(u) < _FEW and np.vdot(u, u) <= _MOST_INPUT**2
    fine = fine or bool(u.max(initial=0.0) <= _MOST_INPUT and u.min(initial=0.0) >= -_MOST_INPUT)
    return "" if fine else "u has an input that is no number, or beyond all"


def _of_answer(answer: pb.CommandAnswer, rig: Rig) -> str:
    beyond = (answer.first_step + answer.n_steps) * rig.timing.fast_step_ns > _LAST_NS
    return "first_step is beyond all times" if beyond else ""


def _of_exposure(info: pb.ExposureInfo, rig: Rig) -> str:
    if info.frame_id > _LAST_NS:
        return "frame_id is beyond all counts"
    if not 0 < info.last_step + 1 - info.first_step <= rig.timing.exposure_steps:
        return "last_step is beyond the end of an exposure"
    if len(info.missing_offset) != len(info.missing_length):
        return "missing_offset and missing_length are not of one length"
    if info.last_step * rig.timing.fast_step_ns > _LAST_NS:
        return "first_step is beyond all times"
    if info.exposure_offset_ns >= rig.timing.fast_step_ns:
        return "exposure_offset_ns is not below a fast step"
    times = (
        info.device_start_ns, info.device_end_ns, info.host_start_ns, info.host_receive_ns, info.host_first_byte_ns,
    )  # fmt: skip
    if not all(-_LAST_NS <= each <= _LAST_NS for each in times):
        return "a time is beyond the calendar"
    sigmas = (info.clock_sigma_ns, info.alignment_sigma_ns)  # NaN where it is not known
    return "" if not any(each < 0 or each > _LAST_NS for each in sigmas) else "a standard deviation is impossible"


def _of_estimate(message: pb.Estimate, rig: Rig) -> str:
    axes, n, c, m = message.axes, message.n_states, message.n_coefficients, message.n_measurements
    spread = message.innovation_variance or message.innovation_covariance
    lengths = (
        (message.end_state, (axes * n,)), (message.coefficients, (axes * c,)), (message.innovation, (axes * m,)),
        (spread, (axes * m, axes * m * m)), (message.nis, (axes,)),
    )  # fmt: skip
    whole = (_is_whole(message, name, size) for name, size in (("end_covariance", n), ("coefficient_covariance", c)))
    if (axes, n) != (rig.plant.axes, rig.plant.n_states) or c < n:
        return "the states are not the rig's"
    if not (all(len(values) in expected for values, expected in lengths) and all(whole)):
        return "it has not as many numbers as it says"
    if not message.estimator.isprintable():
        return "its estimator's name is no text"
    if int(message.status) not in {int(each) for each in Status}:
        return "its status is none that this aolink knows"
    return "" if 0 < message.n_steps <= rig.window_steps else "n_steps is beyond the end of an exposure"


def _is_whole(message: pb.Estimate, name: str, n: int) -> bool:
    if data := getattr(message, f"correlated_{name}"):
        return is_compressed(data, message.axes, n)
    return len(getattr(message, name)) == message.axes * n * n


def _of_truth(message: wire.Truth, rig: Rig) -> str:
    n_path = len(message.path or message.path_single)
    states = {len(message.start_state), len(message.end_state)} - {0}
    if message.n_outputs != rig.n_outputs or n_path % rig.n_outputs or n_path > rig.n_outputs * rig.window_steps:
        return "its path is not that of an exposure"
    fits = len(states) < 2 and all(each % max(message.axes, 1) == 0 for each in states)
    return "" if fits else "its states do not fit its axes"


def _of_picture(picture: RawImage, rig: Rig, topic: str) -> str:
    if not (picture.width and picture.height):
        return "a picture without pixels"
    encoding, width = ("32FC1", 4) if topic.startswith(topics.RESTORED) else ("mono16", 2)
    if picture.encoding != encoding:
        return f"its encoding is not {encoding}"
    if picture.step not in (0, width * picture.width):  # 0 where other software does not state it
        return "its step is not that of its width"
    if len(picture.data) != width * picture.width * picture.height:
        return "its data are not as long as its size says"
    sensor = {topics.IMAGE: rig.sensor, topics.SCENE: rig.scene}.get(topic)
    if sensor is None or sensor.shape == (picture.height, picture.width):
        return ""
    return f"its size is not that of the rig's sensor, {' x '.join(map(str, sensor.shape))} pixels"


_CHECKS: dict[type[Message], Callable[[Any, Rig], str]] = {
    Run: _of_run,
    wire.Applied: _of_run,
    wire.CommandBlock: _of_run,
    pb.CommandAnswer: _of_answer,
    pb.ExposureInfo: _of_exposure,
    pb.Estimate: _of_estimate,
    wire.Truth: _of_truth,
}
