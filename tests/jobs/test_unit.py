"""One recording, one call: a row and a side file, whole or not at all, and never twice."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from aolink.batch import COLUMNS, Model, Settings, estimate_file
from aolink.errors import AolinkError, EstimatorError, RecordingError, RigError
from aolink.jobs.tables import EXPOSURE_COLUMNS
from aolink.recording.reader import Recording
from aolink.recording.reestimate import scored_and_compared
from tests.recording.small import write_small


def test_the_row_has_the_scores_that_estimate_prints(tmp_path: Path) -> None:
    source = write_small(tmp_path / "s.mcap", 6, truth=True)
    row = estimate_file(source, tmp_path / "out.mcap")
    assert tuple(row) == COLUMNS
    recording = Recording(source)
    scores, _ = scored_and_compared(recording, ["moments"])
    assert (row["path_rmse"], row["nis"]) == (scores["moments"].path_rmse, scores["moments"].nis.mean)
    assert (row["recording"], row["output"], row["error"]) == (str(source), "out.mcap", None)


def test_the_table_of_exposures_has_a_row_for_each(tmp_path: Path) -> None:
    """Its root mean square is that of the recording's row; the estimates are those of the side file."""
    source = write_small(tmp_path / "s.mcap", 6, truth=True)
    row = estimate_file(source, tmp_path / "out.mcap", Settings(table=True))
    table = pq.read_table(tmp_path / "out.parquet")
    assert tuple(table.column_names) == EXPOSURE_COLUMNS
    found = table.to_pydict()
    for key in ("path_rmse", "start_rmse", "end_rmse"):
        assert np.sqrt(np.mean(np.square(found[key]))) == pytest.approx(row[key])
    estimates = Recording(source, side=[tmp_path / "out.mcap"]).estimates("moments")
    assert found["frame_id"] == [each.frame_id for each in estimates] == [1, 2, 3, 4, 5, 6]
    assert found["nis"] == [pytest.approx(each.nis.sum()) for each in estimates]
    assert found["time_ns"] == [1_700_000_000_000_000_000 + k * 200_000_000 for k in range(6)]


def test_without_truth_its_errors_are_unknown(tmp_path: Path) -> None:
    row = estimate_file(write_small(tmp_path / "s.mcap", 3), tmp_path / "out.mcap", Settings(table=True))
    assert row["path_rmse"] is None
    assert pq.read_table(tmp_path / "out.parquet")["path_rmse"].null_count == 3


def test_what_was_done_is_done_again_only_where_something_changed(tmp_path: Path) -> None:
    source, out = write_small(tmp_path / "s.mcap", 4), tmp_path / "out.mcap"

    def is_done(settings: Settings) -> bool:
        before = out.stat().st_ino if out.exists() else 0
        estimate_file(source, out, settings)
        return out.stat().st_ino == before

    assert not is_done(Settings())
    assert is_done(Settings())
    assert not is_done(Settings(table=True)), "there was no table"
    assert is_done(Settings(table=True))
    assert is_done(Settings())
    (tmp_path / "out.parquet").write_bytes(b"of somebody else")
    assert not is_done(Settings(table=True))
    assert not is_done(Settings(overwrite=True))
    assert not is_done(Settings(model=Model(changes=(("plant.process_noise", 3.0),))))
    assert not is_done(Settings(estimator="o1"))
    write_small(source, 5)
    assert not is_done(Settings(estimator="o1"))


def test_settings_go_between_processes(tmp_path: Path) -> None:
    settings = Settings(estimator="o1", model=Model(name="x", changes=(("plant.process_noise", 3.0),)))
    assert pickle.loads(pickle.dumps(settings)) == settings


def test_nothing_but_side_files_is_replaced(tmp_path: Path) -> None:
    source = write_small(tmp_path / "s.mcap", 3)
    kept = source.read_bytes()
    write_small(tmp_path / "other.mcap", 3)
    (tmp_path / "text.mcap").write_text("mine")
    for name in ("other.mcap", "text.mcap", "s.mcap"):
        with pytest.raises(RecordingError, match="exists and is not overwritten"):
            estimate_file(source, tmp_path / name)
    with pytest.raises(RecordingError, match="is what the new file is made from"):
        estimate_file(source, source, Settings(overwrite=True))
    assert source.read_bytes() == kept
    estimate_file(source, tmp_path / "text.mcap", Settings(overwrite=True))


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        (Settings(estimator="o9"), EstimatorError),
        (Settings(model=Model(changes=(("plant.colour", 1),))), RigError),
        (Settings(model=Model(changes=(("sensor.counts_per_density", 1e-300),)), estimator="moments"), AolinkError),
    ],
)
def test_what_cannot_be_estimated_leaves_nothing(tmp_path: Path, settings: Settings, error: type[AolinkError]) -> None:
    source = write_small(tmp_path / "s.mcap", 3)
    with pytest.raises(error):
        estimate_file(source, tmp_path / "out.mcap", settings)
    assert [each.name for each in tmp_path.iterdir()] == ["s.mcap"]
    for missing in ("none.mcap", "s"):
        with pytest.raises(RecordingError):
            estimate_file(tmp_path / missing, tmp_path / "out.mcap")


@pytest.mark.slow
def test_any_engine_can_call_it(tmp_path: Path) -> None:
    """Threads and processes of the standard library, on the same recordings, give the same files."""
    sources = [write_small(tmp_path / f"{k}.mcap", 3 + k) for k in range(4)]
    found = []
    for kind in ("threads", "processes"):
        (folder := tmp_path / kind).mkdir()
        outputs = [folder / each.name for each in sources]
        if kind == "threads":
            with ThreadPoolExecutor(2) as threads:
                rows = list(threads.map(estimate_file, sources, outputs))
        else:
            with get_context("spawn").Pool(2) as pool:
                rows = pool.starmap(estimate_file, zip(sources, outputs, strict=True))
        assert [row["exposures"] for row in rows] == [3, 4, 5, 6]
        found.append([[m.data for m in Recording(each).raw_messages()] for each in outputs])
    assert found[0] == found[1]


@pytest.mark.slow
def test_killed_in_the_middle_it_leaves_nothing_under_the_name(tmp_path: Path) -> None:
    """And the next call does it, and clears away what was left."""
    source = write_small(tmp_path / "s.mcap", 400)
    code = (
        "import sys; from aolink.batch import estimate_file, Settings;"
        "estimate_file(sys.argv[1], sys.argv[2], Settings(estimator='moments', table=True))"
    )
    (folder := tmp_path / "out").mkdir()
    process = subprocess.Popen([sys.executable, "-c", code, str(source), str(folder / "s.mcap")])
    while not [*folder.iterdir()]:
        assert process.poll() is None
        os.sched_yield()
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert all(each.name.endswith(".partial") for each in folder.iterdir())
    row = estimate_file(source, folder / "s.mcap", Settings(table=True))
    assert row["exposures"] == 400
    assert sorted(each.name for each in folder.iterdir()) == ["s.mcap", "s.parquet"]
