"""Figures of recordings: their pace, how long the loop waits for the recorder, what is made of one and of many."""

from __future__ import annotations

import atexit
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer

import aolink
from aolink.assembly import Frame
from aolink.estimation import Driver
from aolink.recording import convert, schemas_pb2, topics
from aolink.recording.reader import Recording
from aolink.recording.reestimate import reestimate, write_reestimated
from aolink.recording.writer import RecordingWriter
from aolink.rig import load_rig
from aolink.wire import messages_pb2 as wire
from bench_rows.row import Effort, Row, median_s, peak_mb, timed

_ROWS = 50_000
_LOOP_S = 20.0
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def _session(path: Path, seconds: float) -> list[float]:
    """A 1 kHz loop that records a command, a report and, 50 times a second, a frame; times of its calls, s."""
    with RecordingWriter(path, load_rig("section-vi"), {}, time.time_ns()) as writer:
        return _loop(seconds, writer.take)


def _loop(seconds: float, write: Callable[[str, int, Message], object]) -> list[float]:
    """Times of the calls of a 1 kHz loop, s."""
    image = np.random.default_rng(1).integers(100, 200, (64, 64), dtype=np.uint16)
    spent = []
    begin, k = time.monotonic(), 0
    while time.monotonic() - begin < seconds:
        now, start = time.time_ns(), time.perf_counter()
        write(topics.COMMAND, now, wire.CommandBlock(block_id=k + 1, first_step=k, n_steps=1, u=[0.1]))
        write(topics.APPLIED, now, wire.Applied(block_id=k + 1, first_step=k, n_steps=1, u=[0.1]))
        if k % 20 == 0:
            write(topics.EXPOSURE, now, schemas_pb2.ExposureInfo(frame_id=k // 20 + 1))
            frame = RawImage(width=64, height=64, encoding="mono16", step=128, data=image.tobytes())
            write(topics.IMAGE, now, frame)
        spent.append(time.perf_counter() - start)
        k += 1
        time.sleep(max(0.0, begin + k * 1e-3 - time.monotonic()))
    return spent


def loop_stall(effort: Effort) -> Row:
    """The longest time that a 1 kHz loop waits for the recorder, in 20 s; and the delays that the machine causes
    without a recorder."""
    with tempfile.TemporaryDirectory() as folder:
        spent = np.array(_session(Path(folder) / "a.mcap", effort.share * _LOOP_S)) * 1e3
    alone = np.array(_loop(effort.share * _LOOP_S, lambda topic, now, message: message.SerializeToString())) * 1e3
    (p999, worst), (alone_999, alone_worst) = (np.percentile(each, [99.9, 100]) for each in (spent, alone))
    return Row(
        "loop's wait for the recorder, 1 kHz", f"worst {worst:.2f} ms, 99.9 % {p999:.2f}",
        f"limit 5 ms; encoded, not recorded: {alone_worst:.2f}, {alone_999:.2f}", 5 / worst, 1.0,
    )  # fmt: skip


def recording_rate(effort: Effort) -> Row:
    """Messages a second into a file: small ones at 1 kHz's ratio to frames."""
    rig = load_rig("section-vi")
    messages = [wire.Applied(block_id=k, first_step=k, n_steps=1, u=[0.1]) for k in range(effort.of(60_000))]

    def ours() -> None:
        with tempfile.TemporaryDirectory() as folder, RecordingWriter(Path(folder) / "a", rig, {}, 0) as writer:
            for k, message in enumerate(messages):
                writer.take(topics.APPLIED, k * 1_000_000, message)

    def plain() -> None:
        with tempfile.TemporaryFile() as file:
            writer = Writer(file, compression=CompressionType.LZ4)
            for k, message in enumerate(messages):
                writer.write_message(topics.APPLIED, message, k * 1_000_000, k * 1_000_000, k)
            writer.finish()

    mine, theirs = (len(messages) / each / 1e3 for each in median_s(ours, effort.of(5), plain))
    return Row("recording small messages", f"{mine:.0f} k/s", f"mcap's writer {theirs:.0f} k/s", mine / theirs, 0.8)


def record_long(path: Path, exposures: int, name: str = "section-vi-lively") -> None:
    """A recording of many exposures of 200 steps, made from a short one played again and again."""
    rig = load_rig(name)
    some = aolink.simulate(rig, min(100, exposures))
    with RecordingWriter(path, rig, {}, 0, deterministic=True) as writer:
        for k in range(exposures):
            each, first, now = some[k % len(some)], 200 * k, 200_000_000 * k
            applied = wire.Applied(first_step=first, n_steps=200, u=each.inputs.ravel())
            frame = Frame(
                frame_id=k + 1, first_step=first, last_step=first + 199, pixels=each.pixels, mask=each.mask,
                chunks_lost=0, frames_lost_before=0, device_start_ns=now, device_end_ns=now, host_first_byte_ns=now,
                host_receive_ns=now,
            )  # fmt: skip
            info, image = convert.frame_messages(frame)
            for topic, message in ((topics.APPLIED, applied), (topics.EXPOSURE, info), (topics.IMAGE, image)):
                writer.take(topic, now, message)


def reestimation(effort: Effort) -> list[Row]:
    """o3 over recordings of one axis, of 32, and of 200 outputs of one plant, against reading the same file and
    decoding its frames, no more."""
    return [
        _reestimated("", "section-vi-lively", effort.of(1500), effort, 0.5),
        _reestimated(" of 32 axes", "sh-4x4", effort.of(500), effort, 0.5),
        _reestimated(" of 200 outputs of one plant", "membrane-12x12", effort.of(50), effort, 0),
    ]


def _reestimated(what: str, name: str, count: int, effort: Effort, target: float) -> Row:
    with tempfile.TemporaryDirectory() as folder:
        record_long(Path(folder) / "a.mcap", count, name)
        recording = Recording(Path(folder) / "a.mcap")

        def read() -> None:
            info: Any = None
            for raw in recording.raw_messages():
                if raw.topic == topics.EXPOSURE:
                    info = recording.decoded(raw)
                elif raw.topic == topics.IMAGE:
                    convert.frame_from_messages(info, cast(Any, recording.decoded(raw)))

        estimating, reading = median_s(lambda: reestimate(recording, ["o3"]), effort.of(15), read)
        skipping = median_s(lambda: sum(1 for _ in recording.messages(topics.IMAGE, topics.EXPOSURE)), effort.of(5))[0]
    theirs = f"reading {count / reading:.0f}; past the mirror's reports {count / skipping:.0f}"
    ours = f"{count / estimating:.0f} frames/s"
    return Row(f"re-estimation with o3{what}", ours, theirs, reading / estimating, target)


def walks(effort: Effort) -> list[Row]:
    """What is made of an hour's recording: how often each chunk is read, the time beside one walk with the same
    estimator, and the memory that it takes."""
    from aolink.exporting.files import export
    from aolink.plotting.report import write_report
    from aolink.recording import messages, scan
    from aolink.viewing import save_rrd

    real: Any = scan.chunk_at
    read, rows, recording = 0, list[Row](), Recording(hour(effort))

    def counting(*arguments: Any) -> Any:
        nonlocal read
        read += 1
        return real(*arguments)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        work: dict[str, Callable[[], object]] = {
            "one walk with o3": lambda: deque(Driver(recording.rig, ["o3"]).steps(recording.exposures()), maxlen=0),
            "estimate -e o3": lambda: write_reestimated(recording, ["o3"], folder / "x.mcap"),
            "export x.csv": lambda: export(recording, folder / "x.csv"),
            "report": lambda: write_report(recording, folder / "x.html"),
            "view -o": lambda: save_rrd(recording, folder / "x.rrd"),
        }
        chunks, walk_s = len(recording.chunk_index or ()), 0.0
        setattr(messages, "chunk_at", counting)  # noqa: B010
        try:
            for what, make in work.items():
                read, before = 0, peak_mb()
                took = timed(make)
                walk_s = walk_s or took
                figure = f"{what} of {len(recording)} exposures: {read / chunks:.2f} times each chunk"
                ours = f"{took:.1f} s, +{peak_mb() - before:.0f} MB"
                ratio = min(1.5 * walk_s / took, 1.05 * chunks / read)
                rows.append(Row(figure, ours, f"limit 1.5 walks: {1.5 * walk_s:.1f} s", ratio, 1))
        finally:
            setattr(messages, "chunk_at", real)  # noqa: B010
    return rows


def tiny_recordings(effort: Effort) -> list[Row]:
    """Ten thousand recordings of three exposures estimated with o3 by one command: the processor time of each, and the
    memory that the command takes beyond that for a tenth of them."""
    count = effort.of(10_000, 20)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record_long(folder / "3.mcap", 3)
        for k in range(count):
            os.link(folder / "3.mcap", folder / f"t{k}.mcap")

        def command(number: int) -> tuple[float, float]:
            """Processor time, s, and the largest memory, MB."""
            sources = [folder / f"t{k}.mcap" for k in range(number)]
            process = _estimate(sources, folder / f"out-{number}", "o3")
            _, status, used = os.wait4(process.pid, 0)
            assert status == 0
            return used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3

        (few_s, few_mb), (many_s, many_mb) = command(count // 10), command(count)
    each_ms, grown_mb = max(1e3 * (many_s - few_s) / (count - count // 10), 0.1), many_mb - few_mb
    return [
        Row(f"{count} tiny recordings, each", f"{each_ms:.1f} ms", "limit 20 ms", 20 / each_ms, 1.0),
        Row(f"memory over {count} recordings", f"{grown_mb:+.1f} MB", "limit 10 MB", 10 / max(grown_mb, 0.1), 1.0),
    ]


def _estimate(sources: Sequence[Path], target: Path, name: str, *options: str) -> subprocess.Popen[bytes]:
    """The command that estimates recordings into a folder."""
    command = [sys.executable, "-m", "aolink", "estimate", *map(str, sources), "-e", name, "-o", f"{target}/"]
    return subprocess.Popen([*command, *options], stdout=subprocess.DEVNULL, env=os.environ | _ONE_THREAD)


def batch_workers(effort: Effort) -> list[Row]:
    """Two dozen recordings estimated with moments on two processes, and on two Dask workers, whose start counts,
    against one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sources = [folder / f"{k}.mcap" for k in range(effort.of(24, 2))]
        for source in sources:
            record_long(source, effort.of(600, 5))

        def work(*options: str) -> float:
            target = folder / f"out-{time.monotonic_ns()}"
            return timed(lambda: _done(_estimate(sources, target, "moments", *options)))

        def on_dask(workers: int) -> float:
            file = folder / f"scheduler-{workers}.json"
            scheduler = ("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", file)
            worker = ("worker", "--scheduler-file", file, "--no-nanny", "--nthreads", "1", "--no-dashboard")
            with _dask(*scheduler), ExitStack() as stack:
                while not (file.exists() and file.read_text().endswith("}")):
                    time.sleep(0.05)
                for _ in range(workers):
                    stack.enter_context(_dask(*worker, "--death-timeout", "30"))
                time.sleep(5)  # until they have started
                return work("--scheduler", json.loads(file.read_text())["address"])

        one, two = work(), work("--jobs", "2")
        dask_one, dask_two = on_dask(1), on_dask(2)
    count = f"{len(sources)} recordings"
    return [
        Row(f"{count} estimated on 2 processes", f"{two:.1f} s", f"on one {one:.1f} s", one / two, 1.8),
        Row(
            f"{count} on 2 Dask workers", f"{dask_two:.1f} s", f"on one {dask_one:.1f} s", dask_one / dask_two, 1.8
        ),
    ]  # fmt: skip


def _done(process: subprocess.Popen[bytes]) -> None:
    assert process.wait() == 0


@contextmanager
def _dask(*arguments: str | Path) -> Iterator[None]:
    """A process of a cluster."""
    environment = os.environ | _ONE_THREAD | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    quiet = subprocess.DEVNULL
    process = subprocess.Popen([sys.executable, "-m", "dask", *arguments], env=environment, stdout=quiet, stderr=quiet)
    try:
        yield
    finally:
        process.kill()
        process.wait()


def rrd_of_ten_minutes(effort: Effort) -> Row:
    """The .rrd of 3000 exposures with o3, against one call of rr.log for each row in it: of a number at two times."""
    import rerun as rr
    from rerun.chunk import RrdReader

    from aolink.viewing import save_rrd

    def logged_row_by_row(path: Path) -> float:
        stream = rr.RecordingStream("bench")
        stream.save(path)
        start = time.perf_counter()
        for row in range(effort.of(_ROWS)):
            stream.set_time("fast_step", sequence=row)
            stream.set_time("time", duration=row * 1e-3)
            stream.log("line", rr.Scalars(1e-3 * row))
        stream.disconnect()
        return (time.perf_counter() - start) / effort.of(_ROWS)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record_long(folder / "bare.mcap", effort.of(3000))
        write_reestimated(Recording(folder / "bare.mcap"), ["o3"], folder / "a.mcap")
        recording = Recording(folder / "a.mcap")
        ours, _ = median_s(lambda: save_rrd(recording, folder / "a.rrd", overwrite=True), effort.of(3))
        row = logged_row_by_row(folder / "b.rrd")
        rows = sum(chunk.num_rows for chunk in RrdReader(folder / "a.rrd").stream())
    theirs = rows * row
    figure = f".rrd of ten minutes, {rows / 1e3:.0f}k rows"
    return Row(figure, f"{ours:.1f} s", f"rr.log {theirs:.0f} s", theirs / ours, 20)


@cache
def hour(effort: Effort) -> Path:
    """A recording of an hour at 5 exposures a second, with o3; made once for all rows."""
    folder = Path(tempfile.mkdtemp(prefix="aolink-bench-"))
    atexit.register(shutil.rmtree, folder)
    record_long(folder / "bare.mcap", effort.of(18_000, 64))
    write_reestimated(Recording(folder / "bare.mcap"), ["o3"], folder / "hour.mcap")
    return folder / "hour.mcap"


def rrd_size(effort: Effort) -> Row:
    """The size of the .rrd of an hour over that of the recording."""
    from aolink.viewing import save_rrd

    recording = Recording(hour(effort))
    with tempfile.TemporaryDirectory() as name:
        ratio = save_rrd(recording, Path(name) / "a.rrd").stat().st_size / recording.size
    figure = f".rrd of {len(recording)} exposures"
    return Row(figure, f"{ratio:.2f} times the recording", "limit 4 times", 4 / ratio, 1.0)
