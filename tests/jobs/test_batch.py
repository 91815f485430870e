"""Many recordings with many models: every combination once, failures beside results, nothing done twice."""

from __future__ import annotations

import csv
import json
import multiprocessing
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aolink.errors import RigError
from aolink.jobs import batch
from aolink.recording.compare import compare
from aolink.recording.reader import Recording
from aolink.recording.reestimate import write_reestimated
from aolink.rig import load_rig
from tests.conftest import EXPOSURES, Session

Run = Callable[..., subprocess.CompletedProcess[str]]


def run_here(todo: Sequence[batch.Job], workers: int = 1, **options: Any) -> Iterator[batch.Done]:
    return batch.run(todo, lambda: batch.here(workers), workers, **options)


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
    (done,) = run_here(batch.jobs([str(recorded.path)], model, ["o3"], tmp_path))
    assert not done.error
    changed = Recording(recorded.path, side=[done.job.output])
    assert changed.rig.plant.process_noise == pytest.approx(3.0)
    write_reestimated(Recording(recorded.path, rig=changed.rig), ["o3"], tmp_path / "by-hand.mcap")
    by_hand, own = Recording(tmp_path / "by-hand.mcap"), Recording(recorded.path)
    assert compare(changed, by_hand, only=["/estimate/o3"])["/estimate/o3"].same
    assert not compare(changed, own, only=["/estimate/o3"])["/estimate/o3"].same
    assert done.row["exposures"] == EXPOSURES
    assert done.row["path_rmse"] > 0


def test_what_was_done_is_not_done_again_until_something_changes(recorded: Session, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    todo = batch.jobs([str(recorded.path)], batch.models(None, []), ["o1"], tmp_path / "out")
    first, second = next(run_here(todo, 1)), next(run_here(todo, 1))
    assert (first.skipped, second.skipped) == (False, True)
    assert first.row == second.row
    todo[0].output.unlink()
    assert not next(run_here(todo, 1)).skipped


def test_values_given_twice_are_one_model_and_another_rig_names_its_models() -> None:
    settings = ["plant.process_noise=5,10,5.0", "plant.process_noise=10", "drive.amplitude=[0.1],[0.1]"]
    names = [each.name for each in batch.models("", settings, "mine")]
    assert names == [f"mine plant.process_noise={value} drive.amplitude=[0.1]" for value in (5, 10)]
    (job,) = batch.jobs(["s.mcap"], batch.models("", [], "mine"), ["o1"], Path("out"))
    assert job.output.name == "s-mine.o1.mcap"


@pytest.mark.slow
def test_damage_of_a_recording_is_in_its_row(aolink: Run, recorded: Session, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(recorded.path.read_bytes()[:-3000])
    shutil.copy(recorded.path, tmp_path / "whole.mcap")
    result = aolink("estimate", "cut.mcap", "whole.mcap", "-e", "o1", "-o", "out/", "--json")
    cut, whole = json.loads(result.stdout)
    assert cut["damage"] == Recording(tmp_path / "cut.mcap").damage
    assert not whole["damage"]
    assert f"warning: cut.mcap: {cut['damage']}" in result.stderr
    assert "warning: whole.mcap" not in result.stderr


def test_an_absurd_value_fails_alone(recorded: Session, tmp_path: Path) -> None:
    models = batch.models(None, ["sensor.counts_per_density=1e-300,300"])
    bad, good = run_here(batch.jobs([str(recorded.path)], models, ["moments"], tmp_path), 1)
    assert bad.error
    assert not good.error
    assert [*tmp_path.iterdir()] == [good.job.output]


def several(recorded: Session, folder: Path) -> list[batch.Job]:
    models = batch.models(None, ["plant.process_noise=1,2,3,4,5,6"])
    return batch.jobs([str(recorded.path)], models, ["o1"], folder)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_stopped_no_job_is_begun_and_those_on_the_way_count(recorded: Session, tmp_path: Path, workers: int) -> None:
    todo, done = several(recorded, tmp_path), list[batch.Done]()
    for each in run_here(todo, workers, stop=lambda: bool(done)):
        done.append(each)
    assert 1 <= len(done) <= workers + 1
    assert not any(each.error for each in done)
    assert {each.job.output for each in done} == {*tmp_path.glob("*.mcap")}


def runs(pid: int) -> bool:
    """Whether a process is there and no zombie. (Two threads wait for these, and one may not hear of their end.)"""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.slow
def test_stopped_twice_the_processes_end_at_once_and_leave_nothing_half(recorded: Session, tmp_path: Path) -> None:
    """The second Ctrl-C is raised where the pool is waited for."""

    def stop() -> bool:
        if [*tmp_path.glob("*.mcap")]:  # one job is done, and others are not
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt):
        list(run_here(several(recorded, tmp_path), 2, stop=stop))
    assert not [each for each in multiprocessing.active_children() if each.pid and runs(each.pid)]
    assert not [*tmp_path.glob("*.partial"), *tmp_path.glob(".*")]


@pytest.mark.parametrize("at_once", [1, 6])
def test_any_executor_does_the_jobs_and_those_that_wait_in_it_are_taken_back(
    recorded: Session, tmp_path: Path, at_once: int
) -> None:
    """A pool of one thread; the first job that is done ends the batch."""
    todo, done, told = several(recorded, tmp_path), list[batch.Done](), list[int]()
    for each in batch.run(
        todo, lambda: ThreadPoolExecutor(1), at_once, stop=lambda: bool(done), progress=told.append
    ):  # fmt: skip
        done.append(each)
    assert 1 <= len(done) <= 3
    assert told == [*range(len(done) + 1)]
    assert {each.job.output for each in done} == {*tmp_path.glob("*.mcap")}


@pytest.mark.slow
def test_a_process_that_is_killed_costs_its_own_jobs(recorded: Session, tmp_path: Path) -> None:
    killed = list[int]()

    def stop() -> bool:
        begun = bool([*tmp_path.glob("*.mcap")])  # the processes are all there: one job is done
        for process in multiprocessing.active_children() if begun and not killed else ():
            killed.append(process.pid or 0)
            process.kill()
            break
        return False

    done = list(run_here(several(recorded, tmp_path), 2, stop=stop))
    assert len(done) == 6
    failed = [each.error for each in done if each.error]
    assert killed
    assert len(failed) <= 2, "no more than were on the way"
    assert all("ended from outside" in each for each in failed)
    assert len({*tmp_path.glob("*.mcap")}) >= 6 - len(failed)


def test_a_rig_of_another_camera_is_refused(recorded: Session, tmp_path: Path) -> None:
    with pytest.raises(RigError, match=r"but .*session.mcap was recorded with"):
        Recording(recorded.path, rig=load_rig("single-lenslet"))


@pytest.mark.slow
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
    file = aolink(*arguments, "-o", "one.mcap")
    assert (file.returncode, (tmp_path / "one.mcap").exists()) == (2, False)
    assert "need -o DIR" in file.stderr
    alone = json.loads(aolink(*arguments, "-o", "one", "--json").stdout)
    for one, two in zip(alone, rows, strict=True):
        assert str(one["path_rmse"] or "") == two["path_rmse"]
    for path in (tmp_path / "one").glob("*.mcap"):
        assert compare(Recording(path), Recording(tmp_path / "two" / path.name))["/estimate/o3"].same
    again = aolink(*arguments, "--jobs", "2", "-o", "two")
    assert "6 of 6 done, 4 of them before, 2 failed" in again.stdout


def test_rows_are_in_the_order_of_the_numbers_in_their_names() -> None:
    """Not in that of their letters, where 10 comes before 5."""
    names = ["x=1e-05", "x=5", "x=10", "x=20", "y=-3", "y=-2.5", "y=0.1", "y=[-1,2]", "y=[-1,10]"]
    files = ["session-1.mcap", "session-2.mcap", "session-10.mcap"]
    rows = [{"recording": file, "model": name} for file in files for name in names]
    job = batch.jobs(["s.mcap"], batch.models(None, []), ["o1"], Path("out"))[0]
    mixed = [rows[k] for k in np.random.default_rng(1).permutation(len(rows))]
    found = batch.table_rows([batch.Done(job, row) for row in mixed])
    assert [(row["recording"], row["model"]) for row in found] == [(row["recording"], row["model"]) for row in rows]


@pytest.mark.slow
def test_values_are_drawn_in_the_order_of_the_table(aolink: Run, recorded: Session, tmp_path: Path) -> None:
    shutil.copy(recorded.path, tmp_path / "s.mcap")
    result = aolink("estimate", "s.mcap", "-e", "o1", "--set", "plant.process_noise=20,5,10", "-o", "out/")
    assert result.returncode == 0, result.stderr
    assert re.findall(r"process_noise=(\d+)", result.stdout) == ["5", "10", "20"]


@pytest.mark.slow
def test_one_file_and_one_model_need_no_folder(aolink: Run, recorded: Session, tmp_path: Path) -> None:
    """With --set or --rig as without: the table is printed, and is that of the batch."""
    shutil.copy(recorded.path, tmp_path / "s.mcap")
    (tmp_path / "other.toml").write_text(
        Recording(recorded.path).rig.toml.replace("process_noise = 10", "process_noise = 3")
    )
    for arguments in (["--set", "plant.process_noise=3"], ["--rig", "other.toml"]):
        shown = aolink("estimate", "s.mcap", "-e", "o3", *arguments)
        assert shown.returncode == 0, shown.stderr
        assert "RMSE path" in shown.stdout
        score = json.loads(aolink("estimate", "s.mcap", "-e", "o3", *arguments, "--json").stdout)["o3"]
        row = json.loads(aolink("estimate", "s.mcap", "-e", "o3", *arguments, "-o", "out/", "--json").stdout)[-1]
        assert score["path_rmse"] == row["path_rmse"]
    own = json.loads(aolink("estimate", "s.mcap", "-e", "o3", "--json").stdout)["o3"]
    assert own["path_rmse"] != score["path_rmse"]
    several = aolink("estimate", "s.mcap", "-e", "o3", "--set", "plant.process_noise=3,4")
    assert several.returncode == 2
    assert "need -o DIR" in several.stderr
    assert aolink("estimate", "s.mcap", "-e", "o3", "--jobs", "2").returncode == 2
