"""Simple drivers: frames get their fast steps, and each commanded step ends once, whatever a driver does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from aolink.assembly import Frame
from aolink.devices.adapted_camera import AdaptedCamera
from aolink.devices.adapted_mirror import AdaptedMirror
from aolink.devices.discovery import find_drivers
from aolink.devices.interfaces import ClockSampled, CommandAnswered, Event
from aolink.devices.opening import open_devices
from aolink.devices.simple import ClockAnswer, Lacks, SimpleFrame
from aolink.errors import DeviceError
from aolink.extensions import installed
from aolink.recording.account import Account
from aolink.rig import Rig, load_rig
from aolink.rig.device_tables import Delay, DeviceTable
from aolink.session.received import command_answer
from aolink.wire import messages_pb2 as pb
from tests.packages import package

RIG = load_rig("section-vi")
STEP_NS = RIG.timing.fast_step_ns
EXPOSURE_NS, PERIOD_NS = RIG.timing.exposure_steps * STEP_NS, RIG.timing.frame_period_steps * STEP_NS
EPOCH_NS = 1_767_225_600_000_000_000
CAMERA_ZERO_NS = 777_000_000
PATIENCE_S = 10.0


def eventually(happened: Callable[[], bool]) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not happened():
        assert time.monotonic() < until_s
        time.sleep(0.001)


class Bench:
    """A mirror and a camera whose clocks are exact, and a host's clock that stands still between two calls."""

    description = "bench"
    timing_sigma_ns = 0.0

    def __init__(self) -> None:
        self.host_ns = EPOCH_NS
        self.parks = 0
        self.parked = threading.Event()
        self.late = 0
        self.refusal: Exception | None = None
        self.reports: list[tuple[int, NDArray[np.float64]]] = []
        self.taken: list[SimpleFrame] = []
        self.started_ns: int | None = None

    def now_ns(self) -> int:
        return self.host_ns

    def time_ns(self) -> int:
        return self.host_ns - EPOCH_NS

    def send(self, first_step: int, u: NDArray[np.float64]) -> int:
        if self.refusal:
            raise self.refusal
        return self.late

    def applied(self) -> Iterable[tuple[int, NDArray[np.float64]]]:
        reports, self.reports = self.reports, []
        return reports

    def park(self) -> int:
        self.parks += 1
        self.parked.set()
        return self.time_ns() // STEP_NS

    def start(self, start_ns: int, exposures: int) -> None:
        self.started_ns = start_ns

    def frames(self) -> Iterable[SimpleFrame]:
        taken, self.taken = self.taken, []
        return taken

    def stop(self) -> None:
        self.started_ns = None

    def close(self) -> None:
        pass


class CameraBench(Bench):
    def time_ns(self) -> int:
        return super().time_ns() + CAMERA_ZERO_NS


def mirror_of(bench: Bench, **changes: Any) -> AdaptedMirror:
    """With a clock that was read once; changes are keys of ``[mirror]``."""
    rig = replace(RIG, mirror=replace(RIG.mirror, **changes))
    mirror = AdaptedMirror(rig, bench, Delay(), bench.now_ns)
    mirror.query_clock(bench.host_ns)
    mirror.poll()
    return mirror


def held(n_steps: int, value: float = 0.01) -> NDArray[np.float64]:
    return RIG.mirror.quantise(np.full((n_steps, 1), value))


def ends(mirror: AdaptedMirror) -> list[tuple[int, int, int, int]]:
    """Block, first step, number of steps and source of each report."""
    events = mirror.poll()
    return [(e.block_id, e.first_step, e.n_steps, e.source) for e in events if isinstance(e, pb.Applied)]


def test_what_a_mirror_held_is_reported_by_the_block_that_it_was_commanded_with() -> None:
    mirror = mirror_of(bench := Bench())
    mirror.send_block(10, np.full((4, 1), 0.01), 0, 0)
    mirror.send_block(14, np.full((4, 1), 0.02), 0, 0)
    bench.reports = [(8, held(4)), (12, np.concatenate([held(2), held(3, 0.02)]))]
    assert ends(mirror) == [(1, 10, 2, pb.Applied.COMMAND), (1, 12, 2, pb.Applied.COMMAND), (2, 14, 3, 0)]
    bench.reports = [(17, held(3, -0.04))]  # something else, and one step that nothing is queued for
    assert ends(mirror) == [(2, 17, 1, pb.Applied.CLIPPED), (0, 18, 2, pb.Applied.PARKED)]


def test_a_gap_between_reports_is_said_not_to_be_reported() -> None:
    mirror = mirror_of(bench := Bench())
    mirror.send_block(0, np.full((8, 1), 0.01), 0, 0)
    bench.reports = [(0, held(2)), (5, held(3)), (5, held(3))]
    assert ends(mirror) == [(1, 0, 2, 0), (0, 2, 3, pb.Applied.NOT_REPORTED), (1, 5, 3, 0)]
    assert mirror.next_due_ns() is None
    assert mirror.await_reports(12, 50) == []
    assert mirror.next_due_ns() == 1_000_000_050
    (given_up,) = mirror.serve(1_000_000_050)
    assert given_up == pb.Applied(first_step=8, n_steps=4, source=pb.Applied.NOT_REPORTED)
    assert mirror.next_due_ns() is None


def test_what_a_driver_raises_refuses_the_command_in_words() -> None:
    mirror = mirror_of(bench := Bench())
    bench.refusal = OSError("no such channel")
    mirror.send_block(0, np.full((8, 1), 0.01), 0, 0)
    (answered,) = mirror.poll()
    assert isinstance(answered, CommandAnswered)
    assert answered.ack
    assert answered.ack.code == pb.NOT_SUPPORTED
    assert answered.ack.text == "the driver of the mirror failed when it was sent a command: OSError('no such channel')"
    with pytest.raises(DeviceError, match=r"input 0 at fast step 1 is 0.06, beyond the mirror's limits"):
        mirror.send_block(0, np.array([[0.0], [0.06]]), 0, 0)


@given(
    st.lists(st.tuples(st.integers(1, 9), st.integers(0, 12), st.booleans()), min_size=1, max_size=6),
    st.lists(st.integers(0, 9), max_size=8),
    st.integers(0, 60),
)
def test_each_commanded_step_ends_once(
    blocks: list[tuple[int, int, bool]], gaps: list[int], parked: int,
) -> None:  # fmt: skip
    """Late and refused commands, gaps between reports, parking in the middle."""
    mirror = mirror_of(bench := Bench())
    account, first = Account(), 0

    def take(events: Iterable[Event]) -> None:
        for event in events:
            if isinstance(event, CommandAnswered):
                account.answered(command_answer(mirror, event, 0))
            elif isinstance(event, pb.Applied):
                account.reported(event)

    for n_steps, late, refused in blocks:
        bench.late, bench.refusal = late, ValueError() if refused else None
        account.commanded(mirror.send_block(first, np.full((n_steps, 1), 0.01), 0, 0))
        first += n_steps
    step = 0
    for gap in gaps:
        bench.reports.append((step + gap, held(3)))
        step += gap + 3
        take(mirror.poll())
    bench.host_ns = EPOCH_NS + parked * STEP_NS
    step = mirror.park()
    mirror.await_reports(min(first, step), bench.host_ns)
    while (due_ns := mirror.next_due_ns()) is not None:
        take(mirror.serve(due_ns))
        take(mirror.poll())
    take(mirror.poll())
    account.parked_from(step)
    counts = account.close()
    assert counts.ended == counts.commanded == first
    assert counts.refused == sum(n for n, _, refused in blocks if refused)


@pytest.fixture
def bench() -> CameraBench:
    return CameraBench()


@pytest.fixture
def camera(bench: CameraBench) -> AdaptedCamera:
    return started(bench)


def started(bench: CameraBench) -> AdaptedCamera:
    """Started at fast step 100; frames arrive by the clock that the camera tells, or would tell."""

    def monotonic_ns() -> int:
        return CameraBench.time_ns(bench)

    camera = AdaptedCamera(RIG, bench, mirror_of(Bench()), Delay(), bench.now_ns, monotonic_ns)
    camera.query_clock(bench.host_ns)
    camera.poll()
    assert camera.start(100, 0)
    assert bench.started_ns is not None
    assert (
        0 < bench.started_ns - (CAMERA_ZERO_NS + 100 * STEP_NS) < STEP_NS // 5
    )  # by what one clock sample leaves open
    bench.host_ns += 10**10
    return camera


def frame(since_zero_ns: int, **changes: Any) -> SimpleFrame:
    """One whose exposure began so long after the mirror's fast step 0."""
    pixels = np.full(RIG.sensor.shape, 20_000, dtype=np.uint16)
    return replace(
        SimpleFrame(pixels=pixels, start_ns=CAMERA_ZERO_NS + since_zero_ns, exposure_ns=EXPOSURE_NS), **changes
    )  # fmt: skip


def test_a_frame_gets_the_fast_steps_of_the_mirror(camera: AdaptedCamera, bench: CameraBench) -> None:
    bench.taken = [
        frame(-70 * PERIOD_NS),  # the camera had kept it from before: it is none of this session, and makes no loss
        frame(100 * STEP_NS - 3000),  # as the clocks are compared: no step earlier
        frame(100 * STEP_NS + PERIOD_NS + STEP_NS // 4),
        frame(100 * STEP_NS + 4 * PERIOD_NS),
    ]
    frames = [event for event in camera.poll() if isinstance(event, Frame)]
    assert [(f.first_step, f.exposure_offset_ns) for f in frames] == [(100, 0), (300, STEP_NS // 4), (900, 0)]
    assert [(f.frame_id, f.frames_lost_before) for f in frames] == [(1, 0), (2, 0), (5, 2)]
    assert all(f.last_step + 1 - f.first_step == RIG.timing.exposure_steps for f in frames)


def test_the_session_gets_the_pixels_where_the_driver_has_them(camera: AdaptedCamera, bench: CameraBench) -> None:
    bench.taken = [given := frame(100 * STEP_NS)]
    (taken,) = [event for event in camera.poll() if isinstance(event, Frame)]
    assert np.shares_memory(taken.pixels, given.pixels)


def test_exposures_without_a_pause_do_not_overlap_by_the_clocks_error(
    camera: AdaptedCamera, bench: CameraBench
) -> None:
    """Each begins with the end of the one before, as well as the clocks can be compared."""
    bench.taken = [frame((100 + 200 * k) * STEP_NS - k % 3 * STEP_NS // 40) for k in range(9)]
    frames = [event for event in camera.poll() if isinstance(event, Frame)]
    assert [(f.first_step, f.exposure_offset_ns) for f in frames] == [(100 + 200 * k, 0) for k in range(9)]


@pytest.mark.parametrize("faster", [0.0013, 60e-6, -0.0013])
def test_a_camera_without_a_pause_loses_no_step_to_the_mirrors_clock(faster: float) -> None:
    """Where its clock is the faster one, an exposure has a step less now and then; the middle of each is as it was."""
    mirror, bench = mirror_of(of_mirror := Bench()), CameraBench()
    camera = AdaptedCamera(RIG, bench, mirror, Delay(), bench.now_ns)
    starts, frames = [400 * STEP_NS + round(200 * k * STEP_NS * (1 - faster)) for k in range(200)], []
    for start in [0, *starts]:
        bench.host_ns = of_mirror.host_ns = EPOCH_NS + start + PERIOD_NS
        for device in (mirror, camera):  # their clocks agree, and both are compared with the host's all the time
            device.query_clock(bench.host_ns)
        bench.taken = [frame(start)] if start else []
        frames += [event for event in camera.poll() if isinstance(event, Frame)]
        assert start or camera.start(400, 0)
    steps = np.array([f.last_step + 1 - f.first_step for f in frames])
    gaps = np.array([after.first_step - before.last_step - 1 for before, after in pairwise(frames)])
    assert (len(frames), {*steps.tolist()} <= {199, 200}, {*gaps.tolist()} <= {0, 1}) == (200, True, True)
    # Each step that one clock has gained on the other shows once: as a shorter exposure, or between two.
    assert abs(np.count_nonzero(steps == 199) - np.count_nonzero(gaps) - 199 * 200 * faster) <= 1
    assert gaps.any() == (faster < 0)
    middles = [f.first_step + f.exposure_offset_ns / STEP_NS + n / 2 for f, n in zip(frames, steps, strict=True)]
    assert np.abs(np.array(middles) - (np.array(starts) / STEP_NS + 100)).max() < 1.6 / 16


def test_arrivals_before_a_session_are_apart_from_its_own() -> None:
    """The camera counts its frames and tells no time, and it runs before the session does."""
    camera = started(bench := CameraWithoutTime())
    ends_ns = [100 * STEP_NS + (k + 1) * PERIOD_NS for k in range(-6, 2)]
    bench.taken = [
        frame(0, start_ns=None, arrived_ns=CAMERA_ZERO_NS + end_ns, number=9 + k) for k, end_ns in enumerate(ends_ns)
    ]
    frames = [event for event in camera.poll() if isinstance(event, Frame)]
    assert [(f.frame_id, f.first_step, f.frames_lost_before) for f in frames] == [(1, 100, 0), (2, 300, 0)]


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"pixels": np.zeros((2, 3), np.uint16)}, r"the camera gives \(2, 3\) pixels from 0 to 0, the rig file says"),
        ({"exposure_ns": EXPOSURE_NS + STEP_NS}, r"the camera exposes for 0.201 s, the rig file says 0.2 s: correct"),
        ({"start_ns": CAMERA_ZERO_NS + 10**12}, "a frame whose exposure ends in the future"),
        ({"start_ns": None}, r"the driver of bench gives a frame without start_ns although its time_ns\(\) gives"),
    ],
)
def test_a_frame_that_is_not_of_this_rig_is_refused(
    camera: AdaptedCamera, bench: CameraBench, wrong: dict[str, object], what: str
) -> None:
    bench.taken = [frame(100 * STEP_NS, **wrong)]
    with pytest.raises(DeviceError, match=what):
        camera.poll()


def test_frames_that_come_together_with_a_bad_one_are_given_before_its_error(
    camera: AdaptedCamera, bench: CameraBench
) -> None:
    bench.taken = [frame(100 * STEP_NS), frame(100 * STEP_NS + PERIOD_NS, exposure_ns=1)]
    assert [event.frame_id for event in camera.poll() if isinstance(event, Frame)] == [1]
    for _ in range(2):
        with pytest.raises(DeviceError, match="the camera exposes for 1e-09 s"):
            camera.poll()


def test_a_frame_that_comes_as_the_camera_stops_is_given_once(camera: AdaptedCamera, bench: CameraBench) -> None:
    bench.taken = [frame(100 * STEP_NS)]
    camera.stop()
    assert [event.frame_id for event in camera.poll() if isinstance(event, Frame)] == [1]


def test_no_more_frames_are_given_than_were_asked_for(camera: AdaptedCamera, bench: CameraBench) -> None:
    """A camera that runs until it is stopped takes more where the host is held up."""
    first_step = (bench.host_ns - EPOCH_NS) // STEP_NS + 1
    assert camera.start(first_step, 2)
    bench.host_ns += 10**10
    bench.taken = [frame(first_step * STEP_NS + k * PERIOD_NS) for k in range(-1, 3)]
    assert [event.frame_id for event in camera.poll() if isinstance(event, Frame)] == [1, 2]


def test_a_step_that_has_gone_by_is_too_late_to_start_at(camera: AdaptedCamera) -> None:
    assert not camera.start(200, 0)


def test_a_second_picture_is_not_to_be_had_of_a_simple_driver(bench: CameraBench) -> None:
    with pytest.raises(DeviceError, match="no second picture"):
        AdaptedCamera(load_rig("moving-scene"), bench, mirror_of(Bench()), Delay(), bench.now_ns)


def test_a_mirror_that_the_session_leaves_alone_is_parked_by_the_hosts_watchdog() -> None:
    """It takes no command until it is re-armed, and the steps between are reported as those of the watchdog."""
    mirror = mirror_of(bench := Bench(), watchdog_s=0.05)
    mirror.send_block(10, np.full((20, 1), 0.01), 0, 0)
    mirror.poll()
    bench.host_ns += 20 * STEP_NS
    assert bench.parked.wait(PATIENCE_S)
    eventually(lambda: mirror.latched)
    time.sleep(0.2)
    mirror.poll()
    assert mirror.outage_s > 0.25  # until the session is back, not until it was parked
    mirror.send_block(30, np.full((5, 1), 0.01), 0, 0)
    (answered,) = mirror.poll()
    assert isinstance(answered, CommandAnswered)
    assert answered.ack
    assert answered.ack.code == pb.LATCHED
    bench.host_ns += 20 * STEP_NS
    assert mirror.rearm() == 41
    mirror.send_block(41, np.full((4, 1), 0.01), 0, 0)
    bench.reports = [(10, np.concatenate([held(10), np.tile(RIG.mirror.park, (21, 1)), held(4)]))]
    assert ends(mirror) == [(1, 10, 10, 0), (0, 20, 21, pb.Applied.WATCHDOG), (3, 41, 4, 0)]
    mirror.close()


def test_a_mirror_that_the_session_serves_is_left_alone_by_the_watchdog() -> None:
    mirror = mirror_of(bench := Bench(), watchdog_s=1.0)
    mirror.send_block(10, np.full((20, 1), 0.01), 0, 0)
    until_s = time.monotonic() + 0.6
    while time.monotonic() < until_s:
        mirror.poll()
        time.sleep(0.005)  # as a session
    assert (bench.parks, mirror.latched) == (0, False)
    mirror.close()


def test_the_watchdog_watches_again_once_it_was_re_armed_and_no_longer_once_the_session_has_parked() -> None:
    mirror = mirror_of(bench := Bench(), watchdog_s=0.05)
    mirror.send_block(10, np.full((20, 1), 0.01), 0, 0)
    for times in (1, 2):
        eventually(lambda: mirror.latched)
        time.sleep(0.1)
        assert bench.parks == times  # it parks once
        mirror.rearm()
    mirror.park()
    before = bench.parks
    time.sleep(0.3)
    assert bench.parks == before
    mirror.close()


@pytest.mark.parametrize("commanded", [True, False])
def test_a_mirror_that_could_not_be_parked_is_parked_when_it_is_closed(commanded: bool) -> None:
    mirror, parked = mirror_of(bench := Bench()), []

    def park() -> int:
        parked.append(True)
        if len(parked) == 1:
            raise DeviceError("no answer")
        return 7

    bench.park = park  # type: ignore[method-assign]
    if commanded:
        mirror.send_block(0, np.full((8, 1), 0.01), 0, 0)
        with pytest.raises(DeviceError, match="no answer"):
            mirror.park()
    mirror.close()
    assert len(parked) == 2 * commanded


def test_the_watchdog_leaves_alone_a_mirror_that_was_closed_while_it_waited_for_the_driver() -> None:
    calls, bench = [], Bench()
    bench.park = lambda: calls.append("park") or 7  # type: ignore[method-assign, func-returns-value]

    def close() -> None:
        time.sleep(0.3)
        calls.append("close")

    bench.close = close  # type: ignore[method-assign]
    mirror = mirror_of(bench, watchdog_s=0.05)
    mirror.send_block(10, np.full((20, 1), 0.01), 0, 0)
    bench.time_ns = lambda: time.sleep(0.3) or 0  # type: ignore[method-assign, func-returns-value]
    mirror.query_clock(bench.host_ns)  # the watchdog waits for the driver meanwhile
    mirror.close()
    time.sleep(0.1)
    assert calls[-1] == "close"


def test_a_command_that_changes_too_fast_is_refused() -> None:
    mirror = mirror_of(Bench(), slew_max_per_s=0.001 / RIG.timing.fast_step_s)
    mirror.send_block(0, np.array([[0.001], [0.002]]), 0, 0)
    with pytest.raises(DeviceError, match=r"input 0 changes by 0.0015 to fast step 3, more than mirror.slew_max_per_s"):
        mirror.send_block(2, np.array([[0.003], [0.0045]]), 0, 0)
    mirror.send_block(2, np.array([[0.003], [0.004]]), 0, 0)
    # One that replaces queued steps goes on from the step before them, not from the last that was sent.
    mirror.send_block(1, np.array([[0.0005], [0.0]]), 0, 0)
    with pytest.raises(DeviceError, match=r"input 0 changes by 0\.004 to fast step 4"):
        mirror.send_block(4, np.array([[0.0]]), 0, 0)


@pytest.mark.parametrize(("delay_s", "expected"), [(0.0, 3e6), (0.001, 0.0)])
def test_a_delay_of_the_rig_file_stands_for_how_late_inputs_are(delay_s: float, expected: float) -> None:
    bench = Bench()
    bench.timing_sigma_ns = 3e6
    mirror = AdaptedMirror(RIG, bench, Delay(mean_s=delay_s, sd_s=0.0), bench.now_ns)
    mirror.query_clock(bench.host_ns)
    assert mirror.step_sigma_ns(bench.host_ns) == pytest.approx(expected, abs=2e3)


class CameraWithoutTime(CameraBench):
    lacks = (Lacks.TIME, Lacks.COUNT)

    def time_ns(self) -> int | None:  # type: ignore[override]
        return None


class CameraWithASlowClock(CameraBench):
    """Whose answer is under way until the test lets it come."""

    def __init__(self) -> None:
        super().__init__()
        self.answers: list[ClockAnswer] = []

    def ask_time(self) -> bool:
        return True

    def time_answers(self) -> list[ClockAnswer]:
        answers, self.answers = self.answers, []
        return answers


def test_a_clock_that_answers_late_is_compared_with_the_time_at_which_it_was_asked() -> None:
    bench = CameraWithASlowClock()

    def monotonic_ns() -> int:
        return bench.host_ns - EPOCH_NS + 5_000

    camera = AdaptedCamera(RIG, bench, mirror_of(Bench()), Delay(), bench.now_ns, monotonic_ns)
    for _ in range(8):
        bench.host_ns += 10**9
        camera.query_clock(bench.host_ns)
        assert camera.poll() == []
        answer = ClockAnswer(monotonic_ns() - 20_000, bench.time_ns(), monotonic_ns() + 20_000)
        bench.host_ns += 3 * 10**8
        bench.answers = [answer]
        (sampled,) = camera.poll()
        assert isinstance(sampled, ClockSampled)
        assert sampled.accepted
    assert camera.clock.host_ns(bench.time_ns())[0] == pytest.approx(bench.host_ns, abs=100)


def test_arrival_stands_for_the_time_that_a_camera_does_not_tell() -> None:
    bench, mirror_bench = CameraWithoutTime(), Bench()
    mirror = mirror_of(mirror_bench)

    def monotonic_ns() -> int:
        return bench.host_ns - EPOCH_NS + 5_000

    camera = AdaptedCamera(RIG, bench, mirror, Delay(mean_s=0.01, sd_s=0.002), bench.now_ns, monotonic_ns)
    camera.query_clock(bench.host_ns)
    camera.poll()
    assert camera.start(0, 0)
    pixels = np.zeros(RIG.sensor.shape, np.uint16)
    frames = []
    for k in (1, 2, 3, 5, 6, 7, 8):
        bench.host_ns = EPOCH_NS + k * PERIOD_NS + EXPOSURE_NS + 10_000_000
        bench.taken = [SimpleFrame(pixels=pixels, exposure_ns=EXPOSURE_NS, arrived_ns=monotonic_ns())]
        (frame,) = camera.poll()
        assert isinstance(frame, Frame)
        frames.append(frame)
    assert [frame.frame_id for frame in frames] == [1, 2, 3, 5, 6, 7, 8]
    assert sum(frame.frames_lost_before for frame in frames) == 1
    assert frames[-1].first_step == 8 * RIG.timing.frame_period_steps
    assert frames[-1].alignment_sigma_ns == pytest.approx(2e6, rel=0.05)  # what is not known of the delay stays
    assert camera.lacks == [Lacks.TIME, Lacks.COUNT]


def test_a_camera_that_repeats_a_number_is_refused(camera: AdaptedCamera, bench: CameraBench) -> None:
    pixels = np.zeros(RIG.sensor.shape, np.uint16)
    camera.start(0, 0)
    for number in (7, 8, 10):
        bench.host_ns += PERIOD_NS
        start_ns = bench.time_ns() - EXPOSURE_NS
        bench.taken = [SimpleFrame(pixels=pixels, exposure_ns=EXPOSURE_NS, start_ns=start_ns, number=number)]
        (frame,) = camera.poll()
    assert isinstance(frame, Frame)
    assert (frame.frame_id, frame.frames_lost_before) == (4, 1)
    bench.taken = [SimpleFrame(pixels=pixels, exposure_ns=EXPOSURE_NS, start_ns=bench.time_ns(), number=10)]
    with pytest.raises(DeviceError, match="the camera numbers a frame 10 after number 10"):
        camera.poll()


class WatchedMirror(Bench):
    """A driver of which it is known when it was closed."""

    closed: ClassVar[list[str]] = []

    def __init__(self, rig: Rig) -> None:
        super().__init__()

    def close(self) -> None:
        self.closed.append(type(self).__name__)


class WingedMirror(WatchedMirror):
    lacks = ("wings",)


class CameraWithoutClock(WatchedMirror):
    def time_ns(self) -> int:
        raise OSError("no clock")


@pytest.fixture
def odd(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An installed package that has these drivers."""
    here = f"{__name__}:"
    package(
        tmp_path, "odd",
        f"[aolink.cameras]\nclockless = {here}CameraWithoutClock\nwinged = {here}WingedMirror\n"
        f"[aolink.mirrors]\ngood = {here}WatchedMirror\nwinged = {here}WingedMirror\n",
    )  # fmt: skip
    monkeypatch.syspath_prepend(tmp_path)
    installed.cache_clear()
    WatchedMirror.closed.clear()


@pytest.mark.usefixtures("odd")
@pytest.mark.parametrize(
    ("mirror", "what", "closed"),
    [
        (
            "good", r"the driver of the camera failed when it was opened: OSError\('no clock'\)",
            ["CameraWithoutClock", "WatchedMirror"],
        ),
        ("winged", "the driver of the mirror failed when it was opened: ValueError", ["WingedMirror"]),
    ],
)  # fmt: skip
def test_a_driver_that_turns_out_to_be_of_no_use_is_closed(mirror: str, what: str, closed: list[str]) -> None:
    tables = {
        kind: DeviceTable(driver=name, options={}) for kind, name in (("camera", "clockless"), ("mirror", mirror))
    }
    with pytest.raises(DeviceError, match=what), open_devices(replace(RIG, devices=tables)):
        pass
    assert WatchedMirror.closed == closed


@pytest.mark.usefixtures("odd")
def test_a_driver_with_an_unknown_lack_is_a_line_among_those_found() -> None:
    problems = [found.problem for found in find_drivers() if found.name == "winged"]
    assert [problem.split(":")[0] for problem in problems] == [
        f"the driver of the {kind} failed when it was asked what its devices lack" for kind in ("camera", "mirror")
    ]
