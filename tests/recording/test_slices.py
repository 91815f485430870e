"""Exposures by number and in slices: the same as in the whole recording, with little more read."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink.errors import DeviceError, RecordingError
from aolink.estimation import Estimate
from aolink.exposure import Exposure
from aolink.recording.editing import cut, merge
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import record
from tests.commands import simulated_rig
from tests.conftest import Session
from tests.recording.small import write_small

REFERENCES = sorted((Path(__file__).parents[2] / "recordings").glob("*.mcap"))


def same(one: object, other: object) -> bool:
    """Whether two exposures, or what is in them, agree bit for bit."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    if is_dataclass(one) and not isinstance(one, type):
        return all(same(getattr(one, each.name), getattr(other, each.name)) for each in fields(one))
    return bool(one == other) or (one != one and other != other)


def assert_same(found: list[Exposure], expected: list[Exposure]) -> None:
    assert len(found) == len(expected)
    assert all(same(one, other) for one, other in zip(found, expected, strict=True))


def assert_same_estimates(found: list[Estimate], expected: list[Estimate]) -> None:
    assert [each.frame_id for each in found] == [each.frame_id for each in expected]
    for one, other in zip(found, expected, strict=True):
        assert all(same(getattr(one, name), getattr(other, name)) for name in ("path", "path_sd", "nis", "end_state"))


@pytest.mark.parametrize("path", REFERENCES, ids=lambda path: path.stem)
def test_every_exposure_and_slice_is_as_in_the_whole(path: Path) -> None:
    recording = aolink.read(path)
    whole = list(recording)
    assert len(recording) == len(whole)
    assert_same([recording[k] for k in range(len(recording))], whole)
    assert same(recording[-1], whole[-1])
    for part in (slice(3, 9), slice(None, 4), slice(-2, None), slice(1, 12, 3), slice(5, 5), slice(9, 99)):
        assert_same(list(recording[part]), whole[part])
        assert len(recording[part]) == len(whole[part])
        name = recording.estimators[-1]
        assert_same_estimates(recording[part].estimates(name), recording.estimates(name)[part])


def test_a_slice_of_a_slice_and_its_numbers(recorded: Session) -> None:
    recording = aolink.read(recorded.path)
    whole = list(recording)
    assert_same(list(recording[2:10][1:6:2]), whole[3:8:2])
    assert same(recording[2:10][-1], whole[9])
    with pytest.raises(IndexError):
        recording[len(recording)]
    with pytest.raises(ValueError, match="forwards"):
        recording[::-1]


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session on a line that loses packets both ways: reports asked for again, frames lost, steps assumed."""
    rig = load_rig("section-vi-lively")
    path = tmp_path_factory.mktemp("faulty") / "session.mcap"
    toml = path.with_name("faulty.toml")
    faults = "packet_loss_rate = 0.4\ncommand_loss_rate = 0.4\nbit_flip_rate = 0.2"
    toml.write_text(f"{rig.toml}\n[simulation.faults]\n{faults}\n")
    with simulated_rig(toml) as ports, suppress(DeviceError):  # at its end nobody answers any more
        record(load_rig(toml), *ports, path, estimators=["o1"], exposures=25)
    return path


@pytest.mark.slow
def test_what_was_lost_on_the_line_is_lost_in_a_slice_too(faulty: Path) -> None:
    recording = aolink.read(faulty)
    whole = list(recording)
    assert sum(len(each.lead_inputs) > 0 for each in whole) > 3
    assert any(each.inputs_assumed for each in whole)
    assert_same([recording[k] for k in range(len(recording))], whole)
    assert_same_estimates(recording[5:15].estimates("o1"), recording.estimates("o1")[5:15])


def test_an_exposure_that_goes_on_with_inputs_that_nobody_reported(tmp_path: Path) -> None:
    """Without a single report all is made as from the start of the file."""
    recording = aolink.read(write_small(tmp_path / "small.mcap", 6, applied=False))
    assert_same([recording[k] for k in range(6)], list(recording))


def test_parts_that_were_merged(recorded: Session, tmp_path: Path) -> None:
    parts = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    cut(recorded.path, parts[0], 0, 1.1)
    cut(recorded.path, parts[1], 1.1, 99)
    merge(parts, tmp_path / "whole.mcap")
    for path in (*parts, tmp_path / "whole.mcap"):
        recording = aolink.read(path)
        whole = list(recording)
        assert_same([recording[k] for k in range(len(recording))], whole)
        assert_same_estimates(recording[2:4].estimates("o3"), recording.estimates("o3")[2:4])


def test_a_file_that_was_cut_off_is_read_from_its_start(recorded: Session, tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    data = recorded.path.read_bytes()
    broken.write_bytes(data[: int(0.6 * len(data))])
    recording = aolink.read(broken)
    whole = list(recording)
    assert 2 < len(recording) == len(whole) < 12
    assert_same(list(recording[1:3]), whole[1:3])
    assert same(recording[-1], whole[-1])


def test_an_exposure_that_is_damaged_is_an_error_of_its_own(recorded: Session, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    data = bytearray(recorded.path.read_bytes())
    at = len(data) * 2 // 3
    data[at - 6000 : at + 6000] = bytes(12000)
    damaged.write_bytes(data)
    recording = aolink.read(damaged)
    with pytest.raises(RecordingError, match="exposure 11"):
        recording[11]


@pytest.mark.slow
def test_a_slice_reads_little_of_a_long_file(long_recording: Path) -> None:
    recording = aolink.read(long_recording)
    whole = bytes_read(lambda: list(recording))
    part = bytes_read(lambda: list(recording[60:64]))
    assert len(recording) == 100
    assert part < 0.4 * whole


@pytest.fixture(scope="module")
def long_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("long") / "session.mcap"
    with simulated_rig("section-vi") as ports:
        record(load_rig("section-vi"), *ports, path, exposures=100)
    return path


def bytes_read(work: Callable[[], object]) -> int:
    """Bytes that this process asks the operating system for while it does some work."""

    def so_far() -> int:
        return int(Path("/proc/self/io").read_text().split()[1])

    before = so_far()
    work()
    return so_far() - before


def test_estimators_run_on_a_slice(recorded: Session) -> None:
    recording = aolink.read(recorded.path)
    some = aolink.estimate(recording[4:8], "o3")
    assert [each.frame_id for each in some.estimates("o3")] == [each.frame_id for each in recording[4:8]]
    assert len(aolink.smooth(some, estimators="o3").estimates("o3")) == 4


def test_what_a_recording_says_of_itself(recorded: Session) -> None:
    recording = aolink.read(recorded.path)
    assert repr(recording) == (
        "<Recording session.mcap: 12 exposures, rig section-vi-lively, estimates of open-loop, o1, o2, o3, truth>"
    )
    assert repr(recording[2:9:2]).startswith("<Series session.mcap[2:9:2]: 4 exposures")
    page = recording._repr_html_()
    assert page.startswith("<table>")
    assert "12 of 200 fast steps (200 ms), one every 200 ms" in page


def test_an_empty_recording_is_a_recording(tmp_path: Path) -> None:
    recording = Recording(write_small(tmp_path / "empty.mcap", 0))
    assert len(recording) == 0
    assert recording
    assert list(recording[:5]) == []
    assert "0 exposures" in repr(recording)


def test_damage_is_said_in_the_table(recorded: Session, tmp_path: Path) -> None:
    path = tmp_path / "<b>.mcap"
    shutil.copy(recorded.path, path)
    path.write_bytes(path.read_bytes()[:-500])
    page = aolink.read(path)._repr_html_()
    assert "<th>damage</th>" in page
    assert "<b>" not in page
