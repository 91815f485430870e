"""One recording, one call: a row and a side file, whole or not at all, and never twice."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

from aolink.batch import COLUMNS, Model, estimate_file
from aolink.errors import AolinkError, EstimatorError, RecordingError, RigError
from aolink.recording.reader import Recording
from aolink.recording.reestimate import scored_anew
from tests.recording.small import write_small


def test_the_row_has_the_scores_that_estimate_prints(tmp_path: Path) -> None:
    source = write_small(tmp_path / "s.mcap", 6, truth=True)
    row = estimate_file(source, tmp_path / "out.mcap")
    assert tuple(row) == COLUMNS
    recording = Recording(source)
    scores = scored_anew(recording, ["moments"])
    assert (row["path_rmse"], row["nis"]) == (scores["moments"].path_rmse, scores["moments"].nis.mean)
    assert (row["recording"], row["output"], row["error"]) == (str(source), "out.mcap", None)


def test_what_was_done_is_done_again_only_where_something_changed(tmp_path: Path) -> None:
    source, out = write_small(tmp_path / "s.mcap", 4), tmp_path / "out.mcap"
    first = estimate_file(source, out)
    assert not first["done_before"]
    assert estimate_file(source, out) == first | {"done_before": True}
    assert not estimate_file(source, out, overwrite=True)["done_before"]
    assert not estimate_file(source, out, model=Model(changes=(("plant.process_noise", 3.0),)))["done_before"]
    assert not estimate_file(source, out, "o1")["done_before"]
    assert estimate_file(source, out, "o1")["done_before"]
    write_small(source, 5)
    assert not estimate_file(source, out, "o1")["done_before"]
    out.unlink()
    assert not estimate_file(source, out, "o1")["done_before"]


def test_nothing_but_side_files_is_replaced(tmp_path: Path) -> None:
    source = write_small(tmp_path / "s.mcap", 3)
    kept = source.read_bytes()
    write_small(tmp_path / "other.mcap", 3)
    (tmp_path / "text.mcap").write_text("mine")
    for name in ("other.mcap", "text.mcap", "s.mcap"):
        with pytest.raises(RecordingError, match="exists"):
            estimate_file(source, tmp_path / name)
    with pytest.raises(RecordingError, match="made from"):
        estimate_file(source, source, overwrite=True)
    assert source.read_bytes() == kept
    estimate_file(source, tmp_path / "text.mcap", overwrite=True)


@pytest.mark.parametrize(
    ("estimator", "changes", "error"),
    [
        ("o9", (), EstimatorError),
        ("o1", (("plant.colour", 1),), RigError),
        ("moments", (("sensor.counts_per_density", 1e-300),), AolinkError),
    ],
)
def test_what_cannot_be_estimated_leaves_nothing(
    tmp_path: Path, estimator: str, changes: tuple[tuple[str, Any], ...], error: type[AolinkError]
) -> None:
    source = write_small(tmp_path / "s.mcap", 3)
    with pytest.raises(error):
        estimate_file(source, tmp_path / "out.mcap", estimator, model=Model(changes=changes))
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
    code = "import sys; from aolink.batch import estimate_file; estimate_file(sys.argv[1], sys.argv[2], 'moments')"
    (folder := tmp_path / "out").mkdir()
    process = subprocess.Popen([sys.executable, "-c", code, str(source), str(folder / "s.mcap")])
    while not [*folder.iterdir()]:
        assert process.poll() is None
        os.sched_yield()
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert all(each.name.endswith(".partial") for each in folder.iterdir())
    row = estimate_file(source, folder / "s.mcap")
    assert row["exposures"] == 400
    assert [each.name for each in folder.iterdir()] == ["s.mcap"]
