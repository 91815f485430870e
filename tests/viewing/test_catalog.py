"""What other programs find in Rerun files: one recording for one file, and estimates by the names of their columns."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from aolink.recording.reader import Recording
from aolink.recording.reestimate import write_reestimated
from aolink.viewing import save_rrd
from tests.conftest import Session
from tests.viewing.rrd import read_rrd


@pytest.fixture(scope="module")
def recording(recorded: Session) -> Recording:
    return Recording(recorded.path)


@pytest.fixture(scope="module")
def saved(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_rrd(recording, tmp_path_factory.mktemp("rrd") / "session.rrd")


def identity(path: Path) -> tuple[str, str]:
    (entry,) = RrdReader(path).recordings()
    return entry.application_id, entry.recording_id


@pytest.mark.slow
def test_the_same_file_is_one_recording_under_any_name_and_another_file_another(
    recording: Recording, saved: Path, tmp_path: Path
) -> None:
    copy, other = tmp_path / "copy.mcap", tmp_path / "other.mcap"
    shutil.copy(recording.path, copy)
    write_reestimated(recording, ["o1"], other)
    assert identity(save_rrd(Recording(copy), tmp_path / "copy.rrd")) == identity(saved)
    application, recording_id = identity(save_rrd(Recording(other), tmp_path / "other.rrd"))
    assert application == identity(saved)[0] == "aolink"
    assert recording_id != identity(saved)[1]


def test_estimates_are_columns_with_names(recording: Recording, saved: Path) -> None:
    entities = read_rrd(saved)
    for name in recording.estimators:
        table, estimates = entities[f"/estimate/{name}"], recording.estimates(name)
        assert table["frame"] == [e.frame_id for e in estimates]
        assert table["status"] == [[e.status.name] for e in estimates]
        assert table["reason"] == [[e.reason] for e in estimates]
        nis = [[np.nan] if name == "open-loop" else e.nis for e in estimates]
        np.testing.assert_array_equal(np.array(table["nis"]), nis)
        np.testing.assert_allclose(np.array(table["path_rms"]), [e.path.std(axis=1) for e in estimates])
        sd = [np.sqrt(np.mean(e.path_sd**2, axis=1)) for e in estimates]
        np.testing.assert_allclose(np.array(table["path_sd_rms"]), sd)


def test_rerun_itself_converts_a_recording_with_estimates_as_structures(recording: Recording, tmp_path: Path) -> None:
    target = tmp_path / "converted.rrd"
    command = [sys.executable, "-m", "rerun_cli", "mcap", "convert", str(recording.path), "-o", str(target)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    entities = read_rrd(target)
    assert len(entities["/camera/image"]["Image:buffer"]) == recording.n_frames
    for name in recording.estimators:
        structures = [each for (each,) in entities[f"/estimate/{name}"]["aolink.recording.Estimate:message"]]
        estimates = recording.estimates(name)
        assert [each["frame_id"] for each in structures] == [e.frame_id for e in estimates]
        assert [each["status"]["name"] for each in structures] == [e.status.name for e in estimates]
        np.testing.assert_array_equal([each["nis"] for each in structures], [e.nis for e in estimates])
