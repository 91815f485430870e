"""Figures of batches: many small recordings, a cluster."""

from __future__ import annotations

import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from aolink.batch import estimate_file
from aolink.jobs import batch
from aolink.numerics.workers import processes as pool_of
from bench_rows.recording import record_long
from bench_rows.row import Effort, Row, resident_mb, timed

_TINY = 10_000


def tiny_recordings(effort: Effort) -> list[Row]:
    """Ten thousand recordings of three exposures are estimated into side files in one folder: what each costs besides
    its estimates.

    The cost is the time of each less that of the estimates, which is the slope of time against exposures; and the
    memory that the process has gained since the first thousand.
    """
    count = effort.of(_TINY, 20)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record_long(folder / "3.mcap", 3)
        record_long(folder / "203.mcap", 203)
        (folder / "in").mkdir()
        (folder / "out").mkdir()
        sources = [folder / "in" / f"{k}.mcap" for k in range(count)]
        for each in sources:
            os.link(folder / "3.mcap", each)

        def work(source: Path) -> float:
            out = folder / "out" / f"{source.stem}.o3.mcap"
            return timed(lambda: estimate_file(source, out, overwrite=True))

        few, many = (min(work(folder / f"{each}.mcap") for _ in range(5)) for each in (3, 203))
        of_one = max(0.0, (many - few) / 200)
        begin, begin_cpu, marks = time.perf_counter(), time.process_time(), []
        for k, each in enumerate(sources):
            work(each)
            if k in (count // 10, count - 1):
                marks.append(resident_mb())
        overhead_ms = 1e3 * ((time.perf_counter() - begin) / count - 3 * of_one)
        cpu_ms = 1e3 * (time.process_time() - begin_cpu) / count
    growth = marks[-1] - marks[0]
    return [
        Row(
            f"{count} tiny recordings, each", f"{overhead_ms:.1f} ms", f"limit 20 ms; processor {cpu_ms:.1f} ms",
            20 / overhead_ms, 1.0,
        ),
        Row(f"memory over {count} recordings", f"+{growth:.1f} MB", "limit 10 MB", 10 / max(growth, 0.1), 1.0),
    ]  # fmt: skip


def cluster_workers(effort: Effort) -> Row:
    """Eight recordings estimated with moments on two workers of a Dask scheduler, against one worker.

    Beside it stands what this machine can reach: the same work by two plain processes against one, in the same rounds.
    """
    from distributed import Client

    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        for k in range(8):
            record_long(folder / f"{k}.mcap", effort.of(600, 5))
        sources = [str(folder / f"{k}.mcap") for k in range(8)]
        (folder / "out").mkdir()
        todo = batch.jobs(sources, batch.models(None, []), ["moments"], folder / "out", overwrite=True)

        def cluster(count: int) -> str:
            options, file = ["--host", "127.0.0.1", "--no-dashboard"], folder / f"scheduler-{count}.json"
            stack.enter_context(_dask("scheduler", *options, "--port", "0", "--scheduler-file", str(file)))
            while not (file.exists() and file.read_text().endswith("}")):
                time.sleep(0.05)
            address: str = json.loads(file.read_text())["address"]
            for _ in range(count):
                stack.enter_context(
                    _dask("worker", address, *options, "--no-nanny", "--nthreads", "1", "--death-timeout", "30")
                )
            with Client(address, set_as_default=False) as client:
                client.wait_for_workers(count)
            return address

        def work(address: str, some: Sequence[Any] = todo) -> float:
            """Time that the workers were busy, s."""
            rows = [row for _, row in batch.run(some, lambda: batch.dask(address), len(some))]
            assert not any(row["error"] for row in rows)
            return math.fsum(row["seconds"] for row in rows)

        def plain(pool: ProcessPoolExecutor, some: Sequence[Any] = todo) -> None:
            assert not any(row["error"] for _, row in batch.run(some, lambda: nullcontext(pool), len(some)))

        small, large = cluster(1), cluster(2)
        alone, pair = (stack.enter_context(pool_of(count)) for count in (1, 2))
        for address, pool in ((small, alone), (large, pair)):  # the workers load their modules
            plain(pool, todo[:2])
            work(address, todo[:2])
        busy: list[float] = []
        runs = (lambda: work(small), lambda: busy.append(work(large)), lambda: plain(alone), lambda: plain(pair))
        rounds = [[timed(run) for run in runs] for _ in range(effort.of(2))]
        one, two, process, processes = (statistics.median(each) for each in zip(*rounds, strict=True))
    share = statistics.median(busy) / (2 * two)
    beside = f"on one {one:.1f} s; two plain processes {process / processes:.2f} times one"
    return Row("8 recordings on 2 Dask workers", f"{two:.1f} s, workers busy {share:.0%}", beside, one / two, 1.8)


@contextmanager
def _dask(*arguments: str) -> Iterator[None]:
    """A process of a cluster; its linear algebra has one thread."""
    root = str(Path(__file__).resolve().parents[2])
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": root}
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *arguments], env=environment,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        yield
    finally:
        process.kill()
        process.wait()
