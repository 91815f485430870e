"""Many recordings with many models: every combination once, failures beside results, nothing done twice."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from aolink import batch
from aolink.errors import RigError
from aolink.recording.compare import compare
from aolink.recording.reader import Recording
from aolink.recording.reestimate import write_reestimated
from aolink.rig import load_rig
from tests.conftest import EXPOSURES, Session

Run = Callable[..., subprocess.CompletedProcess[str]]


def test_every_combination_of_the_values_is_a_model() -> None:
    text = load_rig("section-vi").toml
    found = batch.models(None, ["plant.process_noise=0.2,0.4", "drive.amplitude=[0.1],[0.3]"])
    assert [each.name for each in found] == [
        "plant.process_noise=0.2 drive.amplitude=[0.1]",
        "plant.process_noise=0.2 drive.amplitude=[0.3]",
        "plant.process_noise=0.4 drive.amplitude=[0.1]",
        "plant.process_noise=0.4 drive.amplitude=[0.3]",
    ]
    changed = found[1].text_for(text)
    assert "process_noise = 0.2   # W_f, variance" in changed, "comments stay"
    assert batch.models(None, [])[0].text_for(text) == text


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("plant.process_noise", "KEY=VALUE or KEY=VALUE,VALUE is needed"),
        ("plant.process_noise=", "KEY=VALUE or KEY=VALUE,VALUE is needed"),
        ("plant.process_noise=a", "is no number, nor a text in quotation marks"),
        ("plant.colour=1", "the rig file has no such key"),
        ("plant.process_noise.x=1", "the rig file has no such key"),
    ],
)
def test_a_setting_that_makes_no_sense(setting: str, message: str) -> None:
    with pytest.raises(RigError, match=message):
        batch.models(None, [setting])[0].text_for(load_rig("section-vi").toml)


def test_a_job_is_what_one_estimate_would_be(recorded: Session, tmp_path: Path) -> None:
    model = batch.models(None, ["plant.process_noise=3.0"])
    (done,) = batch.run(batch.jobs([recorded.path], model, ["o3"], tmp_path), 1)
    assert not done.error
    changed = Recording(done.job.output)
    assert changed.rig.plant.process_noise == pytest.approx(3.0)
    write_reestimated(Recording(recorded.path, rig=changed.rig), ["o3"], tmp_path / "by-hand.mcap")
    assert all(each.same for each in compare(changed, Recording(tmp_path / "by-hand.mcap")).values())
    own = Recording(recorded.path)
    assert not compare(changed, own)["/estimate/o3"].same
    assert done.rows[0]["exposures"] == EXPOSURES
    assert done.rows[0]["path_rmse"] > 0


def test_what_was_done_is_not_done_again_until_something_changes(recorded: Session, tmp_path: Path) -> None:
    shutil.copy(recorded.path, source := tmp_path / "s.mcap")
    todo = batch.jobs([source], batch.models(None, []), ["o1"], tmp_path / "out")
    (tmp_path / "out").mkdir()
    first, second = next(batch.run(todo, 1)), next(batch.run(todo, 1))
    assert (first.skipped, second.skipped) == (False, True)
    assert first.rows == second.rows
    shutil.copyfile(recorded.path, source)  # a new time
    assert not next(batch.run(todo, 1)).skipped
    todo[0].output.unlink()
    assert not next(batch.run(todo, 1)).skipped


def test_two_names_that_are_one_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RigError, match="give them different names"):
        batch.jobs([tmp_path / "a" / "s.mcap", tmp_path / "b" / "s.mcap"], batch.models(None, []), [], tmp_path)


def test_a_rig_of_another_camera_is_refused(recorded: Session, tmp_path: Path) -> None:
    with pytest.raises(RigError, match=r"but .*session.mcap was recorded with"):
        Recording(recorded.path, rig=load_rig("single-lenslet"))


def test_the_command_on_two_processes(aolink: Run, recorded: Session, tmp_path: Path) -> None:
    """A bad file among good ones; the table is that of one process."""
    for name in ("a", "b"):
        shutil.copy(recorded.path, tmp_path / f"{name}.mcap")
    (tmp_path / "bad.mcap").write_bytes(b"nonsense, and a good deal of it")
    arguments = ("estimate", "a.mcap", "bad.mcap", "b.mcap", "-e", "o3", "--set", "plant.process_noise=5,10")
    result = aolink(*arguments, "--jobs", "2", "-o", "two")
    assert result.returncode == 1, result.stderr
    assert result.stderr.count("bad.mcap is not a recording: it is not an MCAP file") == 2
    rows = list(csv.DictReader((tmp_path / "two" / "results.csv").read_text().splitlines()))
    assert [(row["recording"], row["estimator"]) for row in rows] == [
        *[("a.mcap", "o3")] * 2, *[("b.mcap", "o3")] * 2, *[("bad.mcap", "")] * 2,
    ]  # fmt: skip
    assert all("is not a recording" in row["error"] for row in rows[4:])
    alone = json.loads(aolink(*arguments, "-o", "one", "--json").stdout)
    for one, two in zip(alone, rows, strict=True):
        assert str(one["path_rmse"] or "") == two["path_rmse"]
    for path in (tmp_path / "one").glob("*.mcap"):
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()
    again = aolink(*arguments, "--jobs", "2", "-o", "two")
    assert "6 of 6 done, 4 of them before, 2 failed" in again.stdout
