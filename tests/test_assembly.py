"""Chunks become frames, frames and reports become exposures; what is lost is masked, counted and bridged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.assembly import Assembler, Frame, FrameReassembly, InputHistory, PlanesReassembly, TruthReassembly
from aolink.rig import load_rig
from aolink.wire import messages_pb2 as pb

RIG = load_rig("section-vi")
SHAPE = (3, 100)
PICTURE = np.arange(300, dtype=np.uint16).reshape(SHAPE)


def chunks(frame_id: int, size: int = 100) -> list[pb.FrameChunk]:
    data = PICTURE.astype("<u2").tobytes()
    first = 200 * frame_id
    return [
        pb.FrameChunk(
            frame_id=frame_id,
            offset=offset,
            total=len(data),
            width=SHAPE[1],
            height=SHAPE[0],
            first_step=first,
            last_step=first + 199,
            exposure_start_ns=first * 10**6,
            exposure_end_ns=(first + 200) * 10**6,
            data=data[offset : offset + size],
        )
        for offset in range(0, len(data), size)
    ]


def feed(reassembly: FrameReassembly, parts: list[pb.FrameChunk]) -> list[Frame]:
    return [frame for i, part in enumerate(parts) for frame in reassembly.add(part, 1000 + i)]


def test_chunks_of_a_whole_frame_make_its_picture() -> None:
    (frame,) = feed(FrameReassembly(SHAPE, 1_000_000), chunks(5))
    assert np.array_equal(frame.pixels, PICTURE)
    assert frame.mask.all()
    assert (frame.frame_id, frame.first_step, frame.last_step, frame.chunks_lost) == (5, 1000, 1199, 0)
    assert (frame.host_first_byte_ns, frame.host_receive_ns) == (1000, 1005)
    assert (frame.device_start_ns, frame.device_end_ns) == (10**9, 1_200_000_000)


@given(st.sets(st.integers(0, 5), max_size=5), st.integers(60, 200))
def test_lost_chunks_are_masked_and_counted(lost: set[int], size: int) -> None:
    reassembly = FrameReassembly(SHAPE, 1_000_000)
    parts = chunks(1, size)
    kept = [part for i, part in enumerate(parts) if i not in lost]
    frames = feed(reassembly, kept) + reassembly.flush()
    if not kept:
        assert frames == []
        return
    (frame,) = frames
    arrived = np.zeros(600, dtype=bool)
    for part in kept:
        arrived[part.offset : part.offset + len(part.data)] = True
    # A pixel is good only if both of its bytes came.
    assert np.array_equal(frame.mask.ravel(), arrived.reshape(-1, 2).all(axis=1))
    assert np.array_equal(frame.pixels[frame.mask], PICTURE[frame.mask])
    assert (frame.chunks_lost == 0) == frame.mask.all()
    if len({len(part.data) for part in parts}) == 1:
        assert frame.chunks_lost == len(parts) - len(kept)


def test_a_lost_last_chunk_shows_with_the_next_frame() -> None:
    reassembly = FrameReassembly(SHAPE, 1_000_000)
    assert feed(reassembly, chunks(1)[:-1]) == []
    first, second = feed(reassembly, chunks(2))
    assert (first.chunks_lost, second.chunks_lost) == (1, 0)


def test_lost_frames_are_counted() -> None:
    frames = feed(FrameReassembly(SHAPE, 1_000_000), chunks(1) + chunks(2) + chunks(6))
    assert [frame.frames_lost_before for frame in frames] == [0, 0, 3]


def test_a_chunk_that_makes_no_sense_is_refused() -> None:
    good = chunks(3)
    for change in (
        {"offset": 600},
        {"offset": 590},
        {"total": 602},
        {"width": 2**31, "total": 2**32 - 1},
        {"last_step": 0},
        {"exposure_offset_ns": 1_000_000},
        {"data": b""},
    ):
        reassembly, bad = FrameReassembly(SHAPE, 1_000_000), pb.FrameChunk()
        bad.CopyFrom(good[0])
        for name, value in change.items():
            setattr(bad, name, value)
        assert reassembly.add(bad, 0) == []
        assert reassembly.refused == 1, change
    reassembly = FrameReassembly(SHAPE, 1_000_000)
    feed(reassembly, good)
    assert feed(reassembly, good[:2]) == []  # the frame is over
    assert reassembly.refused == 2


def test_a_truth_with_a_missing_chunk_is_dropped_and_the_next_is_whole() -> None:
    truth = pb.Truth(frame_id=1, axes=1, n_outputs=1, path=list(range(100)))
    data = truth.SerializeToString()

    def pieces(frame_id: int) -> list[pb.TruthChunk]:
        return [
            pb.TruthChunk(frame_id=frame_id, offset=o, total=len(data), data=data[o : o + 300])
            for o in range(0, len(data), 300)
        ]

    reassembly = TruthReassembly()
    results = [reassembly.add(piece) for piece in pieces(1)[:1] + pieces(1)[2:] + pieces(2)]
    assert [result for result in results if result] == [truth]


def frame_at(first_step: int, n_steps: int = 200, frame_id: int = 1) -> Frame:
    return Frame(
        frame_id=frame_id,
        first_step=first_step,
        last_step=first_step + n_steps - 1,
        pixels=np.zeros((1, 40), dtype=np.uint16),
        mask=np.ones((1, 40), dtype=bool),
        chunks_lost=0,
        frames_lost_before=0,
        device_start_ns=0,
        device_end_ns=0,
        host_first_byte_ns=0,
        host_receive_ns=0,
    )


def applied(first: int, end: int) -> pb.Applied:
    return pb.Applied(first_step=first, n_steps=end - first, u=[1e-3 * k for k in range(first, end)])


def commanded(first: int, end: int) -> pb.CommandBlock:
    return pb.CommandBlock(first_step=first, n_steps=end - first, u=[2e-3 * k for k in range(first, end)])


def test_a_frame_waits_for_the_reports_of_its_steps() -> None:
    assembler = Assembler(RIG)
    assert assembler.add_applied(applied(0, 150)) == []
    assert assembler.add_frame(frame_at(0)) == []
    (exposure,) = assembler.add_applied(applied(150, 230))
    assert np.array_equal(exposure.inputs[:, 0], 1e-3 * np.arange(200))
    assert exposure.lead_inputs.shape == (0, 1)
    assert exposure.inputs_assumed == 0


def test_a_lost_report_is_replaced_by_the_command_and_counted() -> None:
    assembler = Assembler(RIG)
    assembler.add_command(commanded(0, 200))
    assembler.add_applied(applied(0, 100))
    assembler.add_applied(applied(150, 200))
    (exposure,) = assembler.add_frame(frame_at(0))
    assert exposure.inputs_assumed == 50
    assert np.array_equal(exposure.inputs[100:150], RIG.mirror.quantise(2e-3 * np.arange(100.0, 150.0)[:, None]))
    assert not np.array_equal(exposure.inputs[100:150, 0], 2e-3 * np.arange(100, 150))


def without_report(source: pb.Applied.Source, first: int, end: int) -> pb.Applied:
    return pb.Applied(first_step=first, n_steps=end - first, source=source)


def test_an_exposure_waits_for_reports_that_were_asked_for_again() -> None:
    assembler = Assembler(RIG)
    assembler.add_command(commanded(0, 400))
    assembler.add_frame(frame_at(0))
    assembler.add_frame(frame_at(200, frame_id=2))
    assembler.add_applied(applied(0, 100))
    assert assembler.add_applied(without_report(pb.Applied.AWAITED, 100, 150)) == []
    assert assembler.add_applied(applied(150, 400)) == []
    assert assembler.add_applied(applied(110, 150)) == []
    first, second = assembler.add_applied(applied(100, 110))
    assert np.array_equal(first.inputs[:, 0], 1e-3 * np.arange(200))
    assert first.inputs_assumed == second.inputs_assumed == 0


def test_an_exposure_waits_no_longer_when_reports_are_given_up() -> None:
    assembler = Assembler(RIG)
    assembler.add_command(commanded(0, 200))
    assembler.add_frame(frame_at(0))
    assembler.add_applied(without_report(pb.Applied.AWAITED, 0, 150))
    assert assembler.add_applied(applied(150, 200)) == []
    (exposure,) = assembler.add_applied(without_report(pb.Applied.NOT_REPORTED, 0, 150))
    assert exposure.inputs_assumed == 150
    assert np.array_equal(exposure.inputs[:150], RIG.mirror.quantise(2e-3 * np.arange(150.0)[:, None]))


def test_a_step_that_nothing_is_known_of_holds_the_last_value() -> None:
    assembler = Assembler(RIG)
    assembler.add_applied(applied(0, 100))
    assembler.add_frame(frame_at(0))
    (exposure,) = assembler.flush()
    assert exposure.inputs_assumed == 100
    assert (exposure.inputs[100:, 0] == exposure.inputs[99, 0]).all()


def test_a_lost_frame_lengthens_the_lead_of_the_next() -> None:
    assembler = Assembler(RIG)
    assembler.add_applied(applied(0, 700))
    assembler.add_frame(frame_at(0))
    (exposure,) = assembler.add_frame(frame_at(450, frame_id=3))
    assert np.array_equal(exposure.lead_inputs[:, 0], 1e-3 * np.arange(200, 450))
    assert np.array_equal(exposure.inputs[:, 0], 1e-3 * np.arange(450, 650))


@pytest.mark.parametrize("first_frame", [0, 60, 450])
def test_a_first_exposure_is_led_by_all_inputs_since_the_first_command(first_frame: int) -> None:
    """Its camera may begin later than its mirror, or its first frames may be lost."""
    assembler = Assembler(RIG)
    for first in (0, 350):
        assembler.add_command(commanded(first, first + 350))
    assembler.add_applied(applied(0, 700))
    (exposure,) = assembler.add_frame(frame_at(first_frame))
    assert np.array_equal(exposure.lead_inputs[:, 0], 1e-3 * np.arange(first_frame))
    assert np.array_equal(exposure.inputs[:, 0], 1e-3 * np.arange(first_frame, first_frame + 200))
    assert exposure.inputs_assumed == 0


def test_a_mirror_that_was_not_commanded_yet_leads_nothing() -> None:
    """It reports that it rests, and the first command comes with the first exposure or later."""
    assembler = Assembler(RIG)
    assembler.add_applied(applied(0, 450))
    assembler.add_command(commanded(500, 700))
    assembler.add_applied(applied(450, 700))
    (exposure,) = assembler.add_frame(frame_at(450))
    assert exposure.lead_inputs.shape == (0, 1)


@given(st.data())
def test_the_order_of_frames_and_reports_does_not_matter(data: st.DataObject) -> None:
    """As long as each stream is in order, the exposures are the same."""
    reports = [applied(100 * k, 100 * (k + 1)) for k in range(6)]
    frames = [frame_at(200 * k, frame_id=k + 1) for k in range(3)]
    assembler, exposures = Assembler(RIG), []
    waiting = list(frames)
    for report in reports:
        while len(waiting) > 0 and data.draw(st.booleans()):
            exposures += assembler.add_frame(waiting.pop(0))
        exposures += assembler.add_applied(report)
    for frame in waiting:
        exposures += assembler.add_frame(frame)
    assert [e.frame_id for e in exposures] == [1, 2, 3]
    for e in exposures:
        assert np.array_equal(e.inputs[:, 0], 1e-3 * np.arange(e.first_step, e.first_step + 200))


runs = st.tuples(st.booleans(), st.integers(0, 40), st.integers(0, 15))
takes = st.tuples(st.integers(0, 12), st.integers(0, 12))


@given(st.lists(st.one_of(runs, takes), max_size=25))
def test_every_step_has_its_last_report_or_command_or_the_input_before(calls: list[tuple[int, ...]]) -> None:
    mirror = replace(RIG.mirror, park=np.zeros(2), dac_bits=0)
    history, applied, commanded = InputHistory(mirror), dict[int, float](), dict[int, float]()
    value, last, end = 0.0, 0.0, 0
    for call in calls:
        if len(call) == 3:
            reported, first, n_steps = call
            u = [value := value + 1.0 for _ in range(n_steps)]
            if reported:
                history.add_applied(pb.Applied(first_step=first, n_steps=n_steps, u=np.repeat(u, 2)))
            else:
                history.add_command(pb.CommandBlock(first_step=first, n_steps=n_steps, u=np.repeat(u, 2)))
            (applied if reported else commanded).update(zip(range(first, first + n_steps), u, strict=True))
            continue
        first = max(0, end + call[0] - 3)  # a few steps again, or a gap
        end = first + call[1]
        expected, assumed = [], 0
        for step in range(first, end):
            assumed += step not in applied
            last = applied.get(step, commanded.get(step, last))
            expected.append(last)
        rows, found = history.take(first, end)
        assert (rows.tolist(), found) == ([[each, each] for each in expected], assumed)
        for known in (applied, commanded):
            for step in [step for step in known if step < end]:
                del known[step]


def planes(lost: set[int], plane: int, frame_id: int = 1) -> list[pb.FrameChunk]:
    parts = chunks(frame_id)
    for part in parts:
        part.plane = plane
    return [part for i, part in enumerate(parts) if i not in lost]


@given(st.sets(st.integers(0, 5), max_size=6), st.sets(st.integers(0, 5), max_size=6))
def test_each_picture_of_an_exposure_has_losses_of_its_own(spots: set[int], scene: set[int]) -> None:
    reassembly = PlanesReassembly([SHAPE, SHAPE], 1_000_000)
    sent = planes(spots, 0) + planes(scene, 1) + planes(set(), 0, 2) + planes(set(), 1, 2)
    frames = [frame for i, part in enumerate(sent) for frame in reassembly.add(part, 1000 + i)]
    assert not reassembly.flush()
    found = {(frame.frame_id, frame.plane): frame for frame in frames}
    assert list(found) == sorted(found)  # in the order in which the camera sends
    for plane, lost in ((0, spots), (1, scene)):
        assert found[2, plane].mask.all()
        if len(lost) == 6:
            assert (1, plane) not in found
        else:
            assert found[1, plane].chunks_lost == len(lost)
            assert np.count_nonzero(~found[1, plane].mask) == 50 * len(lost)
    assert reassembly.refused == 0


def test_a_picture_that_the_camera_does_not_have_is_refused() -> None:
    reassembly = PlanesReassembly([SHAPE], 1_000_000)
    assert [frame for part in planes(set(), 1) for frame in reassembly.add(part, 0)] == []
    assert reassembly.refused == 6


def test_a_report_that_cannot_be_changes_nothing() -> None:
    """One without the inputs of its steps, and one of steps that nothing leads up to."""
    assembler = Assembler(RIG)
    assembler.add_command(pb.CommandBlock(block_id=1, first_step=0, n_steps=200, u=[0.01] * 200))
    for first, n_steps, inputs in ((0, 2**32 - 1, 50), (0, 2**32 - 1, 0), (2**50, 50, 50)):
        bad = pb.Applied(block_id=1, first_step=first, n_steps=n_steps, u=[0.05] * inputs)
        assert assembler.add_applied(bad) == []
    (frame,) = feed(FrameReassembly(SHAPE, 1_000_000), chunks(0))
    assert assembler.add_frame(frame) == []  # it still waits for the report of its steps
    (exposure,) = assembler.add_applied(pb.Applied(block_id=1, first_step=0, n_steps=200, u=[0.02] * 200))
    assert set(exposure.inputs[:, 0]) == {0.02}
    assert exposure.inputs_assumed == 0


def test_reports_that_no_frame_uses_are_not_kept_forever() -> None:
    history = InputHistory(RIG.mirror)
    for k in range(5000):
        history.add_applied(pb.Applied(block_id=k + 1, first_step=50 * k, n_steps=50, u=[0.01] * 50))
    assert history.take(0, 100)[1] == 100  # 200 000 steps ago
    assert history.take(249_800, 250_000)[1] == 0
