"""GigE Vision through Aravis, over real packets on 127.0.0.1: Aravis's own fake camera, and a relay before it."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from aolink.devices.cameras.aravis import discover
from aolink.devices.cameras.pixel_formats import PIXEL_FORMATS
from aolink.devices.simple import Lacks, Trigger
from tests.devices.cameras.gige import (
    LONGEST_S,
    PICTURES,
    codes,
    expected,
    fast_rig,
    need_aravis,
    noise,
    numbers_of,
    opened,
    packed,
    started,
    taken,
)
from tests.devices.simulators.gige import FAKE, Faults, gige_camera

need_aravis()


def test_a_camera_is_found_that_answers(tmp_path: Path) -> None:
    with gige_camera(tmp_path, packed(noise(8, 16), PIXEL_FORMATS["Mono8"]), {}):
        assert (FAKE, "Aravis Fake, serial number GV01, GigEVision") in discover()


@pytest.mark.parametrize(("bits", "name"), [(8, "Mono8"), (10, "Mono10p"), (12, "Mono12p")])
def test_a_format_of_as_many_bits_as_the_sensor_has_is_chosen(bits: int, name: str, tmp_path: Path) -> None:
    """The packed ones are packed by this test: the fake camera has none, and sends what it is given."""
    pictures = noise(bits, 16)
    with (
        gige_camera(tmp_path, packed(pictures, PIXEL_FORMATS[name]), codes("Mono10p", "Mono12p")),
        opened(fast_rig(bits, period_steps=20)) as camera,
    ):
        assert f" {name} from " in camera.description
        frames = taken(started(camera), PICTURES)
    assert len(frames) >= PICTURES
    assert all(np.array_equal(frame.pixels, expected(pictures, frame)) for frame in frames)


def test_the_camera_s_clock_is_latched_and_frames_bear_its_stamp(tmp_path: Path) -> None:
    with (
        gige_camera(tmp_path, packed(noise(16, 16), PIXEL_FORMATS["Mono16"]), {}),
        opened(fast_rig(period_steps=100), stamp_at="end") as camera,
    ):
        assert camera.lacks == (Lacks.TRIGGER,)
        before_ns, now_ns, after_ns = time.time_ns(), camera.time_ns(), time.time_ns()
        assert now_ns is not None
        assert before_ns <= now_ns <= after_ns  # the relay's clock is that of this machine
        camera.start(now_ns + 50_000_000, 0)
        frames = taken(camera, 5)
        last_ns = camera.time_ns()
    starts = [frame.start_ns or 0 for frame in frames]
    assert last_ns is not None
    assert now_ns + 50_000_000 <= starts[0] < starts[1] < starts[-1] + 500_000 <= last_ns


def test_a_camera_with_a_trigger_takes_a_frame_for_each_edge_and_none_without(tmp_path: Path) -> None:
    """At 50 edges a second; free, it would take 1000."""
    frames = packed(noise(16, 16), PIXEL_FORMATS["Mono16"])
    with (
        gige_camera(tmp_path, frames, {}, Faults(edges_hz=50.0)) as relay,
        opened(fast_rig(), trigger=Trigger("hardware", "Line1")) as camera,
    ):
        assert camera.lacks == ()
        numbers = numbers_of(taken(started(camera), 20))
        edges = relay.said()[0]["edges"]
    assert (len(numbers) >= 20, np.diff(numbers).tolist()) == (True, [1] * (len(numbers) - 1))
    assert len(numbers) <= edges


def test_a_camera_that_the_host_triggers_takes_a_frame_in_each_period_and_none_unasked(tmp_path: Path) -> None:
    """At 20 commands a second; left to itself it would take 25."""
    frames, rig = packed(noise(16, 16), PIXEL_FORMATS["Mono16"]), fast_rig(period_steps=500)
    with gige_camera(tmp_path, frames, {}) as relay, opened(rig, trigger=Trigger("software")) as camera:
        assert camera.lacks == ()
        begun_ns = camera.time_ns()
        assert begun_ns is not None
        camera.start(begun_ns + 50_000_000, 0)
        found = taken(camera, 20)
        camera.stop()
        commands, passed_ns = relay.said()[0]["commands"], (camera.time_ns() or 0) - begun_ns
    assert np.diff(numbers_of(found)).tolist() == [1] * (len(found) - 1)
    assert 20 <= len(found) <= commands <= passed_ns / 50_000_000 + 1
    assert (found[0].start_ns or 0) >= begun_ns + 50_000_000


def test_each_packet_that_is_lost_is_counted_and_masks_its_pixels(tmp_path: Path) -> None:
    """Frames of 14 packets, of which the relay drops one in twenty; nobody sends one again."""
    pictures, packet_bytes = noise(16, 32), 184
    with (
        gige_camera(tmp_path, packed(pictures, PIXEL_FORMATS["Mono16"]), {}, Faults(loss=0.05, seed=3)) as relay,
        opened(fast_rig(size=32, period_steps=40), packet_size=packet_bytes + 36, resend=False) as camera,
    ):
        frames = taken(started(camera), 150)
        _, dropped = relay.said()
        counted = camera.statistics()
    numbers = numbers_of(frames)
    headless = {(frame_id - 1) % 65535 + 1 for frame_id, packets in dropped.items() if 0 in packets}
    n_packets = -(-pictures[0].nbytes // packet_bytes)
    for number in range(numbers[0], numbers[-1] + 1):
        frame_id = (number - 1) % 65535 + 1
        assert (number in numbers) == (frame_id not in headless)  # without its first packet there is no frame
    lost = 0
    for frame in frames:
        assert frame.number is not None
        missing = [k for k in dropped.get((frame.number - 1) % 65535 + 1, []) if 1 <= k <= n_packets]
        arrived = np.ones(pictures[0].nbytes // 2, dtype=bool)
        for k in missing:
            arrived[(k - 1) * packet_bytes // 2 : k * packet_bytes // 2] = False
        mask = np.ones((32, 32), dtype=bool) if frame.mask is None else frame.mask
        assert np.array_equal(mask.ravel(), arrived)
        assert np.array_equal(frame.pixels, expected(pictures, frame))
        assert frame.chunks_lost == len(missing)
        lost += len(missing)
    assert counted["sequence_gaps"] == lost > 50
    assert headless


def test_packets_that_are_lost_are_sent_again(tmp_path: Path) -> None:
    """By the relay, which keeps what it has dropped: Aravis asks it, and counts what comes."""
    pictures = noise(16, 32)
    with (
        gige_camera(tmp_path, packed(pictures, PIXEL_FORMATS["Mono16"]), {}, Faults(loss=0.02, resend=True)) as relay,
        opened(fast_rig(size=32, period_steps=100), packet_size=220) as camera,
    ):
        frames = taken(started(camera), 60)
        camera.stop()
        until_s = time.monotonic() + LONGEST_S
        while camera.statistics()["retransmits"] < 0.9 * relay.said()[0]["resent"]:
            frames += camera.frames()
            assert time.monotonic() < until_s
        counted, resent = camera.statistics(), relay.said()[0]["resent"]  # in this order: more may come
    assert all(np.array_equal(frame.pixels, expected(pictures, frame)) for frame in frames)
    # On a busy machine the relay may answer too late for a frame or two, which then have holes.
    assert 0 < counted["retransmits"] <= resent
    assert counted["sequence_gaps"] == sum(frame.chunks_lost for frame in frames)
    assert np.mean([frame.mask is None for frame in frames]) > 0.9
