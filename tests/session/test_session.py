"""A whole session: two processes, real bytes, and what must hold of the recording."""

from __future__ import annotations

import itertools
import json
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink.devices.native import NativeMirror
from aolink.estimation import Driver, run, score
from aolink.recording import topics
from aolink.recording.compare import compare
from aolink.recording.facts import recording_facts
from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference, reestimate, scored_anew, write_reestimated
from aolink.rig import load_rig, parse_rig
from aolink.session import record
from tests.commands import simulated_rig
from tests.conftest import ESTIMATORS, EXPOSURES, Session
from tests.recording.small import copied


def test_everything_is_received_and_recorded(recorded: Session) -> None:
    report, recording = recorded.report, Recording(recorded.path)
    assert (report.ended, report.exposures, report.frames_received) == ("complete", EXPOSURES, EXPOSURES)
    assert report.frames_lost == report.frames_incomplete == report.blocks_retransmitted == 0
    assert not any(report.connection_faults.values())
    assert report.commands.commanded == report.commands.applied == 200 * EXPOSURES
    assert report.commands.late == report.steps_parked == 0
    assert recording.complete
    for topic in (topics.IMAGE, topics.EXPOSURE, topics.TRUTH, *map(topics.estimate_topic, ESTIMATORS)):
        assert recording.counts[topic] == EXPOSURES
    assert recording.counts[topics.COMMAND] == recording.counts[topics.APPLIED] == 4 * EXPOSURES
    assert recording.counts[topics.CLOCK] >= 16
    assert recording.counts[topics.CONNECTION] >= 2


def test_the_wire_gives_what_the_model_gives_in_memory(recorded: Session) -> None:
    """Nothing is lost or changed between the simulated rig's model and the exposures of the recording."""
    simulated = aolink.simulate("section-vi-lively", EXPOSURES)
    for ours, theirs in zip(Recording(recorded.path).exposures(), simulated, strict=True):
        assert np.array_equal(ours.pixels, theirs.pixels)
        assert np.array_equal(ours.inputs, theirs.inputs)
        assert ours.truth is not None
        assert theirs.truth is not None
        assert np.array_equal(ours.truth.path, theirs.truth.path)
        assert np.array_equal(ours.truth.end_state, theirs.truth.end_state)


def test_online_and_offline_estimates_agree_bit_for_bit(recorded: Session) -> None:
    recording = Recording(recorded.path)
    for name, again in reestimate(recording, ESTIMATORS).items():
        assert first_difference(recording.estimates(name), again) is None


def test_scored_one_by_one_is_as_all_at_once(recorded: Session) -> None:
    recording = Recording(recorded.path)
    scores = scored_anew(recording, ESTIMATORS)
    for name in ESTIMATORS:
        listed = recording.estimates(name)
        assert str(scores[name]) == str(score(list(recording.exposures()), listed))  # some are NaN


def test_writing_the_same_estimates_again_gives_the_same_bytes(recorded: Session, tmp_path: Path) -> None:
    again = tmp_path / "again.mcap"
    for path in (again, tmp_path / "third.mcap"):
        write_reestimated(Recording(recorded.path), ["o1", "o3"], path)
    assert again.read_bytes() == (tmp_path / "third.mcap").read_bytes()
    ours, theirs = Recording(again), Recording(recorded.path)
    assert first_difference(ours.estimates("o3"), theirs.estimates("o3")) is None
    assert sorted(ours.estimators) == sorted(ESTIMATORS)
    assert ours.metadata["estimators"] == "open-loop o2 o1 o3"


def test_a_copy_keeps_the_estimates_that_were_there(recorded: Session, tmp_path: Path) -> None:
    """Unless they are of another rig, with which they could not be read."""
    source, copy = Recording(recorded.path), tmp_path / "copy.mcap"
    write_reestimated(source, ["o1"], copy)
    found = compare(source, Recording(copy))
    assert all(each.same for each in found.values()), found
    write_reestimated(source, ["moments"], copy, overwrite=True)
    assert sorted(Recording(copy).estimators) == sorted([*ESTIMATORS, "moments"])
    other = Recording(recorded.path, rig=parse_rig(source.rig.toml.replace("process_noise = 10", "process_noise = 3")))
    write_reestimated(other, ["o1"], copy, overwrite=True)
    assert Recording(copy).estimators == ["o1"]


def test_the_same_seed_gives_the_same_recording_byte_for_byte(recorded: Session, tmp_path: Path) -> None:
    path = tmp_path / "again.mcap"
    with simulated_rig("section-vi-lively") as (camera, mirror):
        record(load_rig("section-vi-lively"), camera, mirror, path, estimators=ESTIMATORS, exposures=EXPOSURES)
    assert path.read_bytes() == recorded.path.read_bytes()


def test_another_seed_gives_another_recording(recorded: Session, tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    with simulated_rig("section-vi-lively", "--seed", "2") as (camera, mirror):
        record(load_rig("section-vi-lively"), camera, mirror, path, exposures=EXPOSURES)
    (ours, theirs) = (next(Recording(p).exposures()) for p in (path, recorded.path))
    assert not np.array_equal(ours.pixels, theirs.pixels)


def test_over_tcp_it_is_the_same(recorded: Session, tmp_path: Path) -> None:
    path = tmp_path / "tcp.mcap"
    with simulated_rig("section-vi-lively", "--listen", "127.0.0.1:0") as (camera, mirror):
        assert camera.startswith("socket://127.0.0.1:")
        record(load_rig("section-vi-lively"), camera, mirror, path, estimators=ESTIMATORS, exposures=EXPOSURES)
    assert path.read_bytes() == recorded.path.read_bytes()


def test_a_rig_serves_one_session_after_another(tmp_path: Path) -> None:
    rig = load_rig("section-vi-lively")
    with simulated_rig("section-vi-lively") as (camera, mirror):
        for name, first in (("a", 0), ("b", 600)):
            record(rig, camera, mirror, tmp_path / name, exposures=3)
            exposures = list(Recording(tmp_path / name).exposures())
            assert [e.first_step for e in exposures] == [first, first + 200, first + 400]


def test_removing_truth_and_estimates_changes_no_estimate(recorded: Session, tmp_path: Path) -> None:
    whole = Recording(recorded.path)
    copied(
        recorded.path, tmp_path / "bare.mcap",
        lambda topic, message: [] if topic == topics.TRUTH or "estimate" in topic else [message],
    )  # fmt: skip
    bare = Recording(tmp_path / "bare.mcap")
    assert next(bare.exposures()).truth is None
    assert bare.estimators == []
    for name, again in reestimate(bare, ESTIMATORS).items():
        assert first_difference(whole.estimates(name), again) is None


def test_changing_a_pixel_changes_the_estimates_from_there_on(recorded: Session) -> None:
    exposures = list(Recording(recorded.path).exposures())
    pixels = exposures[4].pixels.copy()
    pixels[0, 3] += 1
    changed = [*exposures[:4], replace(exposures[4], pixels=pixels), *exposures[5:]]
    rig = load_rig("section-vi-lively")
    before, after = (run(rig, series, ["o3"])["o3"] for series in (exposures, changed))
    assert first_difference(before[:4], after[:4]) is None
    assert (before[4].path != after[4].path).all()
    assert not np.array_equal(before[5].end_state, after[5].end_state)


def test_the_truth_is_not_read(recorded: Session) -> None:
    exposures = list(Recording(recorded.path).exposures())
    driver, blind = (Driver(load_rig("section-vi-lively"), ESTIMATORS) for _ in range(2))
    for exposure in exposures:
        pairs = zip(driver.step(exposure), blind.step(replace(exposure, truth=None)), strict=True)
        assert all(first_difference([a], [b]) is None for a, b in pairs)


FAULTY = """
[simulation.faults]
bit_flip_rate = 0.02
packet_loss_rate = 0.03
command_loss_rate = 0.05
duplicate_rate = 0.03
"""


@pytest.mark.slow
def test_a_bad_link_loses_frames_and_nothing_else(tmp_path: Path) -> None:
    """Every command gets through by retransmission, lost frames are bridged, and it is reproducible."""
    rig_file = tmp_path / "faulty.toml"
    rig_file.write_text(load_rig("section-vi-lively").toml + FAULTY)
    rig, paths, reports = load_rig(rig_file), [], []
    for name in ("a", "b"):
        with simulated_rig(rig_file) as (camera, mirror):
            paths.append(tmp_path / name)
            reports.append(record(rig, camera, mirror, paths[-1], estimators=["o3"], exposures=60))
    report = reports[0]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert report.ended == "complete"
    assert 0 < report.frames_lost < 15
    assert report.frames_received == 60 - report.frames_lost == report.exposures
    assert report.connection_faults["bad_crc"] + report.connection_faults["bad_framing"] > 0
    assert report.connection_faults["sequence_gaps"] > 0
    said = recording_facts(Recording(paths[0]))["losses"]
    assert said["connection_sequence_gaps"] == report.connection_faults["sequence_gaps"]
    assert report.blocks_retransmitted > 0
    # Every step was commanded and applied, and what was not reported was asked for again.
    assert report.commands.commanded == report.commands.applied == 60 * 200
    assert report.reports_asked > 0
    exposures = list(Recording(paths[0]).exposures())
    for before, exposure in itertools.pairwise(exposures):
        assert exposure.first_step - len(exposure.lead_inputs) == before.first_step + 200
    assert any(len(e.lead_inputs) for e in exposures)
    truth = aolink.simulate(rig, 60)
    for exposure in exposures:
        assert exposure.inputs_assumed == 0
        assert np.array_equal(exposure.inputs, truth[exposure.first_step // 200].inputs)
    recording = Recording(paths[0])
    assert first_difference(recording.estimates("o3"), reestimate(recording, ["o3"])["o3"]) is None
    sd = np.concatenate([e.path_sd for e in recording.estimates("o3")])
    assert np.isfinite(sd).all()


def test_a_rig_file_with_other_numbers_is_a_warning(tmp_path: Path) -> None:
    with simulated_rig("section-vi") as (camera, mirror):
        report = record(load_rig("section-vi-lively"), camera, mirror, tmp_path / "a.mcap", exposures=2)
    (warning,) = report.warnings
    assert "was made from another rig file than section-vi-lively" in warning
    assert Recording(tmp_path / "a.mcap").metadata["warnings"] == warning


@pytest.mark.rare
@pytest.mark.parametrize("arguments", [["--exposures", "3"], ["--duration", "0.5"]])
def test_the_commands_of_a_session_by_hand_work_one_after_the_other(
    aolink: Callable[..., subprocess.CompletedProcess[str]], arguments: list[str]
) -> None:
    with simulated_rig("section-vi") as (camera, mirror):
        listed = aolink("devices", camera, mirror)
        assert f"{camera}: camera section-vi" in listed.stdout
        assert "1 input, queue" in listed.stdout
        result = aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "section-vi", "--estimator", "o3", *arguments,
            "--estimator", "o3", "--note", "by hand", "-o", "a.mcap",
        )  # fmt: skip
        again = aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "section-vi", *arguments,
            "-o", "c.mcap", "--json",
        )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert "a.mcap: 3 exposures, complete" in result.stdout
    assert json.loads(again.stdout)["frames_received"] == 3
    facts = json.loads(aolink("info", "a.mcap", "--json").stdout)
    assert facts["session"]["exposures"] == 3
    assert facts["session"]["virtual_time"] is True
    assert facts["estimators"] == ["o3"]
    assert facts["messages"]["/estimate/o3"] == 3
    scored = json.loads(aolink("estimate", "a.mcap", "--json").stdout)
    assert aolink("compare", "a.mcap").returncode == 0
    assert scored["o3"]["exposures"] == 3
    info = aolink("info", "a.mcap")
    assert "by hand" in info.stdout
    assert re.search(r"^exposures +3,", info.stdout, re.MULTILINE)
    estimated = aolink("estimate", "a.mcap", "--estimator", "o3", "--estimator", "o1", "-o", "b.mcap")
    assert estimated.returncode == 0, estimated.stderr
    assert aolink("view", "b.mcap", "-o", "b.rrd").returncode == 0


def test_a_recording_is_closed_whatever_is_raised_while_the_mirror_is_parked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a driver of another package, whose errors are not aolink's."""

    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("a driver's own")

    def failing(exposures: int) -> None:
        if exposures >= 3:
            raise LookupError("the caller's own")

    monkeypatch.setattr(NativeMirror, "park", broken)
    rig = load_rig("section-vi")
    with simulated_rig("section-vi") as (camera, mirror), pytest.raises(LookupError):
        record(rig, camera, mirror, path := tmp_path / "a.mcap", exposures=8, progress=failing)
    recording = Recording(path, check=True)
    assert recording.complete
    assert recording.end_metadata["ended"].startswith("error: LookupError")
    assert recording.n_frames >= 3
