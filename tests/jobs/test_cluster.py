"""A batch on a real Dask scheduler with real workers, on loopback: one of them killed, one of another version."""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import dask
import psutil
import pytest
from distributed import Client, LocalCluster

from aolink.batch import Model
from aolink.errors import AolinkError
from aolink.jobs import batch
from aolink.recording.reader import Recording
from tests.kinds import must_be
from tests.recording.small import write_small

Run = Callable[..., subprocess.CompletedProcess[str]]
pytestmark = pytest.mark.slow


def cluster_of(workers: int) -> LocalCluster:
    return LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)


@pytest.fixture
def cluster(request: pytest.FixtureRequest) -> Iterator[LocalCluster]:
    """Two workers; a parameter is how many of them a job may cost before it counts as failed."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": getattr(request, "param", 3)}),
        cluster_of(2) as made,
    ):
        yield made


def jobs(folder: Path, count: int, exposures: int = 100) -> list[batch.Job]:
    (folder / "out").mkdir()
    sources = [str(write_small(folder / f"{k}.mcap", exposures)) for k in range(count)]
    return batch.jobs(sources, [Model()], ["o3"], folder / "out")


def killing_one(cluster: LocalCluster, todo: list[batch.Job]) -> dict[str, batch.Row]:
    """The rows of jobs, by recording, of which a worker is killed when the first is done."""
    rows: dict[str, batch.Row] = {}
    with Client(cluster, set_as_default=False) as client:
        victim = min(client.run(os.getpid).values())
    for job, row in batch.run(todo, lambda: batch.dask(cluster.scheduler_address), len(todo)):
        if not rows:
            os.kill(victim, signal.SIGKILL)
        assert job.source not in rows
        rows[job.source] = row
    return rows


def test_a_worker_is_killed_and_nothing_is_lost_or_doubled(cluster: LocalCluster, tmp_path: Path) -> None:
    """Its work is done again; the row and the file of each recording are those of one process."""
    todo = jobs(tmp_path, 10)
    (bad := tmp_path / "bad.mcap").write_bytes(b"nonsense, and a good deal of it")
    rows = killing_one(cluster, [*todo, *batch.jobs([str(bad)], [Model()], ["o3"], tmp_path / "out")])
    assert [source for source, row in rows.items() if row["error"]] == [str(bad)]
    assert {source for source, row in rows.items() if row["exposures"] == 100} == {job.source for job in todo}
    assert {*(tmp_path / "out").iterdir()} == {job.output for job in todo}
    (alone := tmp_path / "alone").mkdir()
    for job in batch.jobs([each.source for each in todo[:2]], [Model()], ["o3"], alone):
        assert not batch.do(job)["error"]
        there = Recording(tmp_path / "out" / job.output.name)
        assert [m.data for m in there.raw_messages()] == [m.data for m in Recording(job.output).raw_messages()]


@pytest.mark.parametrize("cluster", [0], indirect=True)
def test_a_job_that_costs_its_workers_is_one_row(cluster: LocalCluster, tmp_path: Path) -> None:
    rows = killing_one(cluster, jobs(tmp_path, 10))
    errors = [row["error"] for row in rows.values() if row["error"]]
    assert len(rows) == 10
    assert 1 <= len(errors) <= 3, "those that the worker had"
    assert all("lost" in each for each in errors)


def test_stopped_the_cluster_keeps_nothing_of_the_batch(
    cluster: LocalCluster, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    todo, done = jobs(tmp_path, 30), list[batch.Job]()
    for job, _ in batch.run(
        todo, lambda: batch.dask(cluster.scheduler_address), len(todo), stop=lambda: bool(done)
    ):  # fmt: skip
        done.append(job)
    assert cluster.scheduler
    while cluster.scheduler.tasks or [*(tmp_path / "out").glob(".*")]:
        os.sched_yield()
    assert 1 <= len(done) <= len([*(tmp_path / "out").iterdir()]) <= len(done) + 4 < len(todo)
    assert capfd.readouterr().err == ""


def test_without_its_scheduler_a_batch_ends_with_one_line(cluster: LocalCluster, tmp_path: Path) -> None:
    stopped = iter([False])

    def stop() -> bool:  # asked once before the job is given away, and then while it is waited for
        if next(stopped, None) is None:
            cluster.close()
        return False

    with pytest.raises(AolinkError, match="is gone"):
        list(batch.run(jobs(tmp_path, 20, 3), lambda: batch.dask(cluster.scheduler_address), 20, stop=stop))


def test_no_worker_or_one_with_another_aolink_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "aolink-0.0.9.dist-info").mkdir()
    (tmp_path / "aolink-0.0.9.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: aolink\nVersion: 0.0.9\n"
    )
    with cluster_of(0) as cluster, Client(cluster, set_as_default=False) as client:
        address = cluster.scheduler_address
        with pytest.raises(AolinkError, match="no workers"), batch.dask(address):
            pass
        worker = subprocess.Popen(
            [sys.executable, "-m", "dask", "worker", address, "--no-nanny", "--no-dashboard", "--nthreads", "1"],
            env=os.environ | {"PYTHONPATH": str(tmp_path)}, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            client.wait_for_workers(1, timeout=120)
            with pytest.raises(AolinkError, match=r"0\.0\.9"), batch.dask(address):
                pass
        finally:
            worker.kill()
            worker.wait()


def test_the_command_on_a_cluster(cluster: LocalCluster, aolink: Run, tmp_path: Path) -> None:
    """Names may be relative: the workers have other folders. A second time, everything was done before."""
    names = [write_small(tmp_path / f"s{k}.mcap", 3 + k).name for k in range(3)]
    arguments = ("estimate", *names, "-o", "out", "--scheduler", cluster.scheduler_address)
    for before in (0, 3):
        done = aolink(*arguments)
        assert done.returncode == 0, done.stderr
        assert f"3 of 3 done, {before} of them before, 0 failed" in done.stdout
        assert done.stderr == ""
    assert {each.name for each in (tmp_path / "out").glob("*.mcap")} == {f"s{k}.moments.mcap" for k in range(3)}


def test_as_the_page_starts_it_no_other_machine_reaches_it() -> None:
    page = (Path(__file__).parents[2] / "aolink" / "pages" / "many_recordings.md").read_text()
    with contextlib.ExitStack() as started:
        for line in re.findall(r"^    dask (.*)$", page, re.MULTILINE):
            command = [sys.executable, "-m", "dask", *line.replace("8786", "28786").replace("8787", "0").split()]
            process = started.enter_context(
                subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
            )
            started.callback(os.killpg, process.pid, signal.SIGKILL)
            for said in must_be(io.TextIOBase, process.stderr):
                if "Registered to" in said or "Scheduler at" in said:
                    break
        every = [each for at_top in psutil.Process().children() for each in (at_top, *at_top.children(recursive=True))]
        ports = [port for each in every for port in each.net_connections("inet") if port.status == psutil.CONN_LISTEN]
        assert len(ports) >= 4
        assert {port.laddr.ip for port in ports} == {"127.0.0.1"}


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nonsense"])
def test_no_scheduler_is_one_clear_line(address: str) -> None:
    with pytest.raises(AolinkError, match="no Dask scheduler answers"):
        batch.dask(address).__enter__()
