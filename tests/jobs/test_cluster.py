"""A batch on a real Dask scheduler with real workers, on loopback: one of them killed, one of another version."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from distributed import Client

from aolink.errors import AolinkError
from aolink.jobs import batch
from aolink.jobs.cluster import workers_of
from aolink.jobs.unit import Model, aolink_version
from aolink.recording.reader import Recording
from tests.recording.small import write_small

Run = Callable[..., subprocess.CompletedProcess[str]]
_PATIENCE_S = 120


@dataclass(frozen=True)
class Cluster:
    """A scheduler without workers."""

    address: str
    scheduler: subprocess.Popen[bytes]

    @contextmanager
    def worker(self, name: str, path: str = "") -> Iterator[subprocess.Popen[bytes]]:
        """A worker process; ``path`` comes first on its module search path."""
        root = str(Path(__file__).parents[2])
        environment = os.environ | {"PYTHONPATH": f"{path}{os.pathsep}{root}" if path else root, "OMP_NUM_THREADS": "1"}
        options = [
            "--no-nanny",
            "--nthreads",
            "1",
            "--death-timeout",
            "30",
            "--no-dashboard",
            "--host",
            "127.0.0.1",
            "--name",
            name,
        ]
        with _process("worker", self.address, *options, environment=environment) as process:
            yield process

    def wait_for(self, count: int) -> None:
        """Wait until it has so many workers."""
        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=_PATIENCE_S)


@contextmanager
def _process(*arguments: str, environment: dict[str, str] | None = None) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "dask", *arguments]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Iterator[Cluster]:
    """Its parameter, if it has one, is how many workers a job may cost before it counts as failed."""
    file = tmp_path_factory.mktemp("cluster") / "scheduler.json"
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    may_cost = os.environ | {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": str(getattr(request, "param", 3))}
    with _process("scheduler", *options, environment=may_cost) as process:
        deadline = time.monotonic() + _PATIENCE_S
        while True:
            assert process.poll() is None
            assert time.monotonic() < deadline
            try:
                yield Cluster(json.loads(file.read_text())["address"], process)
                return
            except (OSError, ValueError):
                os.sched_yield()


@pytest.mark.slow
def test_a_worker_is_killed_and_nothing_is_lost_or_doubled(cluster: Cluster, tmp_path: Path) -> None:
    """Its work is done again by the other; the row and the file of each recording are those of one process."""
    sources = [str(write_small(tmp_path / f"{k}.mcap", 100 + k)) for k in range(10)]
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"nonsense, and a good deal of it")
    (tmp_path / "out").mkdir()
    todo = batch.jobs([*sources, str(bad)], batch.models(None, []), ["o3"], tmp_path / "out")
    done: list[batch.Done] = []
    with ExitStack() as stack:
        workers = [stack.enter_context(cluster.worker(name)) for name in ("one", "two")]
        cluster.wait_for(2)
        for each in batch.run(todo, lambda: workers_of(cluster.address), len(todo)):
            if not done:
                workers[0].kill()
            done.append(each)
        assert workers[0].wait() == -9
    assert sorted(each.job.output for each in done) == sorted(job.output for job in todo)
    assert [each.job.source for each in done if each.error] == [str(bad)]
    rows = {each.row["recording"]: each.row["exposures"] for each in done if each.row}
    assert rows == {source: 100 + k for k, source in enumerate(sources)}
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [f"{k}.o3.mcap" for k in range(10)]
    (alone := tmp_path / "alone").mkdir()
    for job in batch.jobs(sources[:2], batch.models(None, []), ["o3"], alone):
        assert not batch.do(job, aolink_version()).error
        there = Recording(tmp_path / "out" / job.output.name)
        assert [m.data for m in there.raw_messages()] == [m.data for m in Recording(job.output).raw_messages()]


@pytest.mark.slow
@pytest.mark.parametrize("cluster", [0], indirect=True)
def test_a_job_that_costs_its_workers_is_one_line(cluster: Cluster, tmp_path: Path) -> None:
    todo = batch.jobs([str(write_small(tmp_path / f"{k}.mcap", 100)) for k in range(10)], [Model()], ["o3"], tmp_path)
    done: list[batch.Done] = []
    with cluster.worker("one") as first, cluster.worker("two"):
        cluster.wait_for(2)
        for each in batch.run(todo, lambda: workers_of(cluster.address), len(todo)):
            if not done:
                first.kill()
            done.append(each)
    errors = [each.error for each in done if each.error]
    assert len(done) == len(todo)
    assert 1 <= len(errors) <= 3, "those that the worker had"
    assert {*errors} == {"its process was ended from outside: too little memory, or a signal"}


@pytest.mark.slow
def test_stopped_the_cluster_keeps_nothing_of_the_batch(
    cluster: Cluster, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    todo = batch.jobs([str(write_small(tmp_path / f"{k}.mcap", 100)) for k in range(30)], [Model()], ["o3"], tmp_path)
    done: list[batch.Done] = []
    with cluster.worker("one"), Client(cluster.address, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=_PATIENCE_S)
        for each in batch.run(todo, lambda: workers_of(cluster.address), len(todo), stop=lambda: bool(done)):
            done.append(each)
        while client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks)) or [*tmp_path.glob(".*")]:
            os.sched_yield()
    assert 1 <= len(done) <= len([*tmp_path.glob("*.o3.mcap")]) <= len(done) + 2 < len(todo)
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_without_its_scheduler_a_batch_ends_with_one_line(cluster: Cluster, tmp_path: Path) -> None:
    todo = batch.jobs([str(write_small(tmp_path / "s.mcap", 3))], batch.models(None, []), ["o3"], tmp_path)
    with cluster.worker("one"):
        cluster.wait_for(1)
        address = cluster.address
        stopped = iter([False])

        def stop() -> bool:  # asked once before the job is given away, and then while it is waited for
            if next(stopped, None) is None:
                cluster.scheduler.kill()
            return False

        with pytest.raises(AolinkError, match=f"the scheduler at {address} is gone; what was done stays"):
            list(batch.run(todo * 20, lambda: workers_of(address), 20, stop=stop))


@pytest.mark.slow
def test_a_worker_with_another_aolink_is_one_clear_line(cluster: Cluster, aolink: Run, tmp_path: Path) -> None:
    other = tmp_path / "other" / "aolink-0.0.9.dist-info"
    other.mkdir(parents=True)
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: aolink\nVersion: 0.0.9\n")
    write_small(tmp_path / "s.mcap", 3)
    arguments = ("estimate", "s.mcap", "-o", "out", "--scheduler", cluster.address)
    nobody = aolink(*arguments)
    assert nobody.returncode == 1
    assert nobody.stderr.startswith(f"aolink: the scheduler at {cluster.address} has no workers: start some")
    with cluster.worker("old", str(other.parent)):
        cluster.wait_for(1)
        refused = aolink(*arguments)
    assert refused.returncode == 1
    assert "has aolink 0.0.9, this is aolink 0.1.0: install the same everywhere" in refused.stderr
    assert (len(nobody.stderr.splitlines()), len(refused.stderr.splitlines())) == (1, 1)
    assert not [*(tmp_path / "out").iterdir()]


@pytest.mark.slow
def test_the_command_on_a_cluster(cluster: Cluster, aolink: Run, tmp_path: Path) -> None:
    """Names may be relative: the workers have other folders. A second time, everything was done before."""
    names = [write_small(tmp_path / f"s{k}.mcap", 3 + k).name for k in range(3)]
    arguments = ("estimate", *names, "-o", "out", "--table", "all.parquet", "--scheduler", cluster.address)
    with cluster.worker("one"):
        cluster.wait_for(1)
        first, second = aolink(*arguments), aolink(*arguments)
    assert first.returncode == 0, first.stderr
    assert "3 of 3 done, 0 of them before, 0 failed; table: all.parquet" in first.stdout
    assert "3 of 3 done, 3 of them before, 0 failed; table: all.parquet" in second.stdout
    assert (first.stderr, second.stderr) == ("", "")
    assert {each.name for each in (tmp_path / "out").glob("*.mcap")} == {f"s{k}.moments.mcap" for k in range(3)}


@pytest.mark.slow
@pytest.mark.parametrize("address", ["127.0.0.1:1", "nonsense"])
def test_no_scheduler_is_one_clear_line(address: str) -> None:
    with pytest.raises(AolinkError, match="no Dask scheduler answers at"):
        workers_of(address).__enter__()
