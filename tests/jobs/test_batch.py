"""Many recordings with many models: every combination once, failures beside results, nothing done twice."""

from __future__ import annotations

import csv
import json
import multiprocessing
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from aolink.batch import Model
from aolink.errors import RigError
from aolink.jobs import batch
from aolink.recording.compare import compare
from aolink.recording.reader import Recording
from aolink.recording.reestimate import write_reestimated
from aolink.rig import load_rig
from tests.conftest import EXPOSURES, Session
from tests.recording.small import write_small

Run = Callable[..., subprocess.CompletedProcess[str]]


def run_here(todo: Sequence[batch.Job], workers: int = 1, **options: Any) -> Iterator[tuple[batch.Job, batch.Row]]:
    return batch.run(todo, lambda: batch.here(workers), workers, **options)


def test_every_combination_of_the_values_is_a_model() -> None:
    text = load_rig("section-vi").toml
    settings = ["plant.process_noise=5,10,5.0", "plant.process_noise=10", "drive.amplitude=[0.1],[0.3],[0.1]"]
    found = batch.models(None, settings)
    assert [each.name for each in found] == [
        f"plant.process_noise={noise} drive.amplitude=[{amplitude}]" for noise in (5, 10) for amplitude in (0.1, 0.3)
    ]
    assert "process_noise = 5   # W_f, variance" in found[1].text_for(text), "comments stay"
    assert batch.models(None, [])[0].text_for(text) == text
    (job,) = batch.jobs(["s.mcap"], batch.models("", [], "mine"), ["o1"], Path("out"))
    assert (job.model.name, job.output.name) == ("mine", "s-mine.o1.mcap")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("plant.process_noise", "KEY=VALUE"),
        ("plant.process_noise=", "KEY=VALUE"),
        ("plant.process_noise=a", "quotation"),
        ("plant.colour=1", "no such key"),
        ("plant.process_noise.x=1", "no such key"),
    ],
)
def test_a_setting_that_makes_no_sense(setting: str, message: str) -> None:
    with pytest.raises(RigError, match=message):
        batch.models(None, [setting])[0].text_for(load_rig("section-vi").toml)


def test_thousands_of_names_are_no_matter_and_two_that_are_one_are_refused() -> None:
    sources = [f"{k}.mcap" for k in range(10_000)]
    assert len(batch.jobs(sources, [Model()], ["o3"], Path("out"))) == 10_000
    with pytest.raises(RigError, match=r"s\.o3\.mcap"):
        batch.jobs(["a/s.mcap", "b/s.mcap"], [Model()], ["o3"], Path("out"))


def test_a_job_is_what_one_estimate_would_be(recorded: Session, tmp_path: Path) -> None:
    todo = batch.jobs([str(recorded.path)], batch.models(None, ["plant.process_noise=3.0"]), ["o3"], tmp_path)
    ((job, row),) = run_here(todo)
    assert not row["error"]
    changed = Recording(recorded.path, side=[job.output])
    assert changed.rig.plant.process_noise == pytest.approx(3.0)
    write_reestimated(Recording(recorded.path, rig=changed.rig), ["o3"], tmp_path / "by-hand.mcap")
    by_hand, own = Recording(tmp_path / "by-hand.mcap"), Recording(recorded.path)
    assert compare(changed, by_hand, only=["/estimate/o3"])["/estimate/o3"].same
    assert not compare(changed, own, only=["/estimate/o3"])["/estimate/o3"].same
    assert row["exposures"] == EXPOSURES
    assert row["path_rmse"] > 0


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
    (_, bad), (job, good) = run_here(batch.jobs([str(recorded.path)], models, ["moments"], tmp_path))
    assert bad["error"]
    assert not good["error"]
    assert [*tmp_path.iterdir()] == [job.output]


def several(recorded: Session, folder: Path) -> list[batch.Job]:
    return batch.jobs([str(recorded.path)], batch.models(None, ["plant.process_noise=1,2,3,4,5,6"]), ["o1"], folder)


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "at_once", "most"), [(1, 1, 1), (2, 2, 3), (None, 1, 3), (None, 6, 3)])
def test_stopped_no_job_is_begun_and_those_on_the_way_count(
    recorded: Session, tmp_path: Path, workers: int | None, at_once: int, most: int
) -> None:
    """By processes, or any executor: here a pool of one thread, in which jobs wait that are taken back."""
    done, told = list[tuple[batch.Job, batch.Row]](), list[int]()
    for each in batch.run(
        several(recorded, tmp_path),
        lambda: batch.here(workers) if workers else ThreadPoolExecutor(1),
        at_once,
        stop=lambda: bool(done),
        progress=told.append,
    ):
        done.append(each)
    assert 1 <= len(done) <= most
    assert told == [*range(len(done) + 1)]
    assert not any(row["error"] for _, row in done)
    assert {job.output for job, _ in done} == {*tmp_path.glob("*.mcap")}


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
    assert not [*tmp_path.glob(".*")]


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
    assert len({job.output for job, _ in done}) == len(done) == 6
    failed = [row["error"] for _, row in done if row["error"]]
    assert killed
    assert len(failed) <= 2, "no more than were on the way"
    assert all("lost" in each for each in failed)
    assert len({*tmp_path.glob("*.mcap")}) >= 6 - len(failed)
    assert not [*tmp_path.glob(".*")]


def test_a_rig_of_another_camera_is_refused(recorded: Session) -> None:
    with pytest.raises(RigError, match=r"session.mcap was recorded with"):
        Recording(recorded.path, rig=load_rig("single-lenslet"))


@pytest.mark.slow
def test_the_command_on_two_processes(aolink: Run, recorded: Session, tmp_path: Path) -> None:
    """A bad file among good ones; the table has the order of the command's files and values, and is that of one
    process. A second time, everything was done before."""
    for name in ("b", "a"):
        shutil.copy(recorded.path, tmp_path / f"{name}.mcap")
    (tmp_path / "bad.mcap").write_bytes(b"nonsense, and a good deal of it")
    arguments = ("estimate", "b.mcap", "bad.mcap", "a.mcap", "-e", "o3", "--set", "plant.process_noise=10,5")
    result = aolink(*arguments, "--jobs", "2", "-o", "two")
    assert result.returncode == 1, result.stderr
    assert result.stderr.count("bad.mcap is not a recording") == 2
    rows = list(csv.DictReader((tmp_path / "two" / "results.csv").read_text().splitlines()))
    assert [(row["recording"], row["model"], "not a recording" in row["error"]) for row in rows] == [
        (f"{name}.mcap", f"plant.process_noise={value}", name == "bad") for name in ("b", "bad", "a")
        for value in (10, 5)
    ]  # fmt: skip
    alone = json.loads(aolink(*arguments, "-o", "one", "--json").stdout)
    for one, two in zip(alone, rows, strict=True):
        assert str(one["path_rmse"] or "") == two["path_rmse"]
    for path in (tmp_path / "one").glob("*.mcap"):
        assert compare(Recording(path), Recording(tmp_path / "two" / path.name))["/estimate/o3"].same
    again = aolink(*arguments, "--jobs", "2", "-o", "two")
    assert "6 of 6 done, 4 of them before, 2 failed" in again.stdout


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["--set", "plant.process_noise=3"], ["--rig", "other.toml"]])
def test_one_file_and_one_model_need_no_folder(
    aolink: Run, recorded: Session, tmp_path: Path, arguments: list[str]
) -> None:
    """With --set or --rig as without: the table is printed, and is that of the batch."""
    shutil.copy(recorded.path, tmp_path / "s.mcap")
    (tmp_path / "other.toml").write_text(
        Recording(recorded.path).rig.toml.replace("process_noise = 10", "process_noise = 3")
    )
    shown = aolink("estimate", "s.mcap", "-e", "o3", *arguments)
    assert shown.returncode == 0, shown.stderr
    assert "RMSE path" in shown.stdout
    score = json.loads(aolink("estimate", "s.mcap", "-e", "o3", *arguments, "--json").stdout)["o3"]
    row = json.loads(aolink("estimate", "s.mcap", "-e", "o3", *arguments, "-o", "out/", "--json").stdout)[-1]
    assert score["path_rmse"] == row["path_rmse"]
    own = json.loads(aolink("estimate", "s.mcap", "-e", "o3", "--json").stdout)["o3"]
    assert own["path_rmse"] != score["path_rmse"]


def test_another_file_is_not_taken_for_the_table(aolink: Run, tmp_path: Path) -> None:
    write_small(tmp_path / "a.mcap", 1)
    (tmp_path / "out").mkdir()
    (table := tmp_path / "out" / "results.csv").write_text("name,mass\nmine,3\n")
    command = ("estimate", "a.mcap", "-e", "o1", "-o", "out/")
    refused = aolink(*command)
    assert refused.stderr.startswith("aolink: out/results.csv exists and is no table")
    assert table.read_text() == "name,mass\nmine,3\n"
    assert not [*(tmp_path / "out").glob("*.mcap")]
    for more in (["--overwrite"], []):  # and then the table is one of ours
        done = aolink(*command, *more)
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scheduler", "tcp://127.0.0.1:1"], "need -o DIR"),
        (["--jobs", "2"], "need -o DIR"),
        (["--set", "plant.process_noise=3,4"], "need -o DIR"),
        (["--set", "plant.process_noise=3,4", "-o", "x.mcap"], "need -o DIR"),
        (["-o", "out/", "--scheduler", "tcp://127.0.0.1:1", "--jobs", "2"], "--jobs is for this machine"),
        (["-o", "out/", "-e", "o1", "-e", "o9"], "there is no estimator 'o9'"),
        (["-o", "a.mcap/out/"], "cannot make the folder"),
    ],
)
def test_options_that_do_not_go_together(aolink: Run, tmp_path: Path, arguments: list[str], message: str) -> None:
    write_small(tmp_path / "a.mcap", 1)
    result = aolink("estimate", "a.mcap", *arguments)
    assert result.returncode
    assert message in " ".join(result.stderr.replace("│", " ").split())
    assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"]
