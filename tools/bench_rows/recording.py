"""Figures of recordings: their pace, what a crash and damage cost, how long the loop waits for the recorder."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import statistics
import tempfile
import time
from collections import deque
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer

import aolink
from aolink.assembly import Frame
from aolink.estimation import Driver
from aolink.jobs import batch
from aolink.recording import convert, schemas_pb2, topics
from aolink.recording.editing import recover
from aolink.recording.mcap_file import McapFile, WriteOptions, schema_of
from aolink.recording.reader import Recording
from aolink.recording.reestimate import reestimate, write_reestimated
from aolink.recording.writer import RecordingWriter, begin_recording
from aolink.rig import load_rig
from aolink.wire import messages_pb2 as wire
from bench_rows.row import Effort, Row, median_s, resident_mb, timed

KILLS = 100
_ROWS = 50_000
_LOOP_S = 20.0


def _session(path: Path, seconds: float) -> list[float]:
    """A 1 kHz loop that records a command, a report and, 50 times a second, a frame; times of its calls, s."""
    with RecordingWriter(path, load_rig("section-vi"), {}, time.time_ns()) as writer:
        return _loop(seconds, writer.write)


def _loop(seconds: float, write: Callable[[str, Message, int], object]) -> list[float]:
    """Times of the calls of a 1 kHz loop, s."""
    image = np.random.default_rng(1).integers(100, 200, (64, 64), dtype=np.uint16)
    spent = []
    begin, k = time.monotonic(), 0
    while time.monotonic() - begin < seconds:
        now, start = time.time_ns(), time.perf_counter()
        write(topics.COMMAND, wire.CommandBlock(block_id=k + 1, first_step=k, n_steps=1, u=[0.1]), now)
        write(topics.APPLIED, wire.Applied(block_id=k + 1, first_step=k, n_steps=1, u=[0.1]), now)
        if k % 20 == 0:
            write(topics.EXPOSURE, schemas_pb2.ExposureInfo(frame_id=k // 20 + 1), now)
            frame = RawImage(width=64, height=64, encoding="mono16", step=128, data=image.tobytes())
            write(topics.IMAGE, frame, now)
        spent.append(time.perf_counter() - start)
        k += 1
        time.sleep(max(0.0, begin + k * 1e-3 - time.monotonic()))
    return spent


def kill_at_any_moment(effort: Effort) -> Row:
    """SIGKILL at random moments of a session that records in real time: the age of the oldest message lost."""
    rng = np.random.default_rng(1)
    ages, unreadable = [], 0
    with tempfile.TemporaryDirectory() as folder:
        for k in range(effort.of(KILLS, 3)):
            path = Path(folder) / f"{k}.mcap"
            child = os.fork()
            if not child:
                _session(path, 60.0)
                os._exit(0)
            time.sleep(0.3 + 0.4 * rng.random())
            killed = time.time_ns()
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            try:
                result = recover(path, Path(folder) / "whole.mcap", overwrite=True)
                recording = Recording(result.path)
                sequences = [each.sequence for each in recording.messages()]
                assert sequences == list(range(1, len(sequences) + 1))
                ages.append((killed - recording.end_ns) / 1e6)
            except Exception as error:
                print(f"kill {k}: {error!r}")
                unreadable += 1
    worst = max(ages) if not unreadable else float("inf")
    ours = f"{worst:.0f} ms lost at worst, median {statistics.median(ages):.0f}"
    figure = f"kill -9 at a random moment, {effort.of(KILLS, 3)} times, all recovered"
    return Row(figure, ours, "limit 200 ms", 200 / worst, 1.0)


def _many_chunks(folder: Path) -> tuple[bytes, list[tuple[int, int, int]]]:
    """A recording of several MB, and for each chunk its first byte, the byte after its last, and its messages."""
    path = folder / "long.mcap"
    file = McapFile(path, WriteOptions())
    begin_recording(file, load_rig("section-vi"), {}, 0, {})
    rng = np.random.default_rng(2)
    for k in range(3000):
        data = RawImage(width=32, height=32, encoding="mono16", step=64, data=rng.bytes(2048)).SerializeToString()
        file.add(topics.IMAGE, schema_of(RawImage), data, k * 5_000_000, k + 1)
    file.finish()
    with path.open("rb") as opened:
        reader = make_reader(opened)
        summary = reader.get_summary()
        assert summary is not None
        counts = [
            sum(1 for _ in reader.iter_messages(starting_at=each.message_start_time, ending_at=each.message_end_time))
            for each in summary.chunk_indexes
        ]
    spans = [(each.chunk_start_offset, each.chunk_start_offset + each.chunk_length) for each in summary.chunk_indexes]
    return path.read_bytes(), [(*span, count) for span, count in zip(spans, counts, strict=True)]


def truncation(effort: Effort) -> Row:
    """Cut off at 500 sampled bytes of the last megabyte: messages that come back of those in whole chunks."""
    with tempfile.TemporaryDirectory() as name:
        data, chunks = _many_chunks(Path(name))
        due = found = 0
        for size in np.random.default_rng(3).integers(len(data) - (1 << 20), len(data), effort.of(500)):
            (path := Path(name) / "cut.mcap").write_bytes(data[:size])
            due += sum(count for _, end, count in chunks if end <= size)
            found += sum(Recording(path).counts.values())
    figure = f"cut off at {effort.of(500)} bytes of the last MB"
    return Row(figure, f"{found} messages back", f"{due} in whole chunks", found / due, 1.0)


def flipped_bits(effort: Effort) -> Row:
    """20 random bits flipped, 200 times: messages that come back of those in chunks that were not hit."""
    rng = np.random.default_rng(4)
    with tempfile.TemporaryDirectory() as name:
        data, chunks = _many_chunks(Path(name))
        due = found = 0
        for _ in range(effort.of(200)):
            damaged, hits = bytearray(data), rng.integers(16, len(data), 20)
            for byte in hits:
                damaged[byte] ^= 1 << int(rng.integers(8))
            (path := Path(name) / "flipped.mcap").write_bytes(damaged)
            due += sum(count for start, end, count in chunks if not ((start <= hits) & (hits < end)).any())
            found += sum(Recording(path, check=True).counts.values())
    figure = f"20 bits flipped, {effort.of(200)} times"
    return Row(figure, f"{found} messages back", f"{due} in whole chunks", found / due, 1.0)


def loop_stall(effort: Effort) -> Row:
    """The longest time that a 1 kHz loop waits for the recorder, in 20 s; and the delays that the machine causes
    without a recorder."""
    with tempfile.TemporaryDirectory() as folder:
        spent = np.array(_session(Path(folder) / "a.mcap", effort.share * _LOOP_S)) * 1e3
    alone = np.array(_loop(effort.share * _LOOP_S, lambda topic, message, now: message.SerializeToString())) * 1e3
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
                writer.write(topics.APPLIED, message, k * 1_000_000)

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
                writer.write(topic, message, now)


def reestimation_rate(effort: Effort) -> list[Row]:
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


def chunks_read(effort: Effort) -> list[Row]:
    """How often each chunk of a session of 1500 exposures with four estimators is read, and how long that takes beside
    a walk over its exposures and estimates."""
    from aolink.exporting.files import export
    from aolink.plotting.report import write_report
    from aolink.recording import messages, scan
    from aolink.recording.reestimate import scored_anew
    from aolink.viewing import save_rrd

    real: Any = scan.chunk_at
    read = 0

    def counting(*arguments: Any) -> Any:
        nonlocal read
        read += 1
        return real(*arguments)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with RecordingWriter(folder / "a.mcap", load_rig("section-vi-lively"), {}, 0, deterministic=True) as writer:
            record_long(folder / "bare.mcap", effort.of(1500, 10))
            write_reestimated(Recording(folder / "bare.mcap"), ["open-loop", "o1", "o3", "moments"], folder / "b.mcap")
            for each in Recording(folder / "b.mcap").messages():  # in the chunks of a session
                writer.write(each.topic, each.message, each.log_time_ns)
        recording = Recording(folder / "a.mcap")
        chunks = len(recording.chunk_index or ())
        work: dict[str, Callable[[], object]] = {
            "walk": lambda: deque(recording.walk(), maxlen=0),
            "estimate -e o3": lambda: scored_anew(recording, ["o3"]),
            "export x.csv": lambda: export(recording, folder / "x.csv"),
            "report": lambda: write_report(recording, folder / "x.html"),
            "view -o": lambda: save_rrd(recording, folder / "x.rrd"),
        }
        rows = []
        setattr(messages, "chunk_at", counting)  # noqa: B010
        try:
            for what, run in work.items():
                read = 0
                took = f"{timed(run):.1f} s"
                times = read / chunks
                rows.append(Row(f"{chunks} chunks read by {what}", f"{times:.2f} times", took, 1 / times, 0.95))
        finally:
            setattr(messages, "chunk_at", real)  # noqa: B010
    return rows


def memory_of_an_hour(effort: Effort) -> Row:
    """Growth while an hour at 5 Hz is estimated with o3, against the file's size."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        record_long(path, effort.of(18_000))
        size, recording = path.stat().st_size / 1e6, Recording(path)
        driver, marks = Driver(recording.rig, ["o3"]), []
        for number, exposure in enumerate(recording.exposures()):
            driver.step(exposure)
            if number % effort.of(4000) == effort.of(1000):
                marks.append(resident_mb())
    growth = max(marks) - marks[0]
    figure = "memory over an hour's recording, o3"
    return Row(figure, f"+{growth:.1f} MB", f"file {size:.0f} MB", size / max(growth, 0.1), 10)


def batch_workers(effort: Effort) -> Row:
    """Two dozen recordings estimated again with moments on two processes, whose start counts, against one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sources = [folder / f"{k}.mcap" for k in range(effort.of(24, 2))]
        for source in sources:
            record_long(source, effort.of(600))

        def work(jobs: int) -> float:
            target = folder / f"on-{jobs}-{time.monotonic_ns()}"
            target.mkdir()
            todo = batch.jobs([*map(str, sources)], batch.models(None, []), ["moments"], target)
            start = time.perf_counter()
            assert not any(row["error"] for _, row in batch.run(todo, lambda: batch.here(jobs), jobs))
            return time.perf_counter() - start

        one, two = work(1), work(2)
    count = f"{len(sources)} recordings"
    return Row(f"{count} estimated again on 2 processes", f"{two:.1f} s", f"on one {one:.1f} s", one / two, 1.8)


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
    """The size of the .rrd of an hour over that of the recording; and the memory that writing it takes."""
    from aolink.viewing import save_rrd

    recording, grown = Recording(hour(effort)), list[float]()
    with tempfile.TemporaryDirectory() as name:
        saved = save_rrd(recording, Path(name) / "a.rrd", progress=lambda done: grown.append(resident_mb()))
        ratio = saved.stat().st_size / recording.size
        more = max(grown) - grown[0]
    ours = f"{ratio:.2f} times the recording, {more:.0f} MB more memory after the first part"
    return Row(f".rrd of {len(recording)} exposures", ours, "limit 4 times", 4 / ratio, 1.0)


def view_first(effort: Effort) -> Row:
    """Time from opening a recording of an hour until its first part is with the viewer, which has no window."""
    import rerun as rr

    from aolink.viewing import Look
    from aolink.viewing.process import running_rerun
    from aolink.viewing.save import sent_parts

    times, path = [], hour(effort)
    for _ in range(effort.of(5)):
        start = time.perf_counter()
        with running_rerun(["--serve-grpc"]) as server:
            server.listen()
            stream = rr.RecordingStream("aolink")
            stream.connect_grpc(server.data_address)
            next(sent_parts(stream, Recording(path), Look(), at_once=True))
            stream.flush()
            times.append(time.perf_counter() - start)
            stream.disconnect()
    ours = statistics.median(times)
    return Row("first picture's data of an hour in the viewer", f"{ours:.2f} s", "limit 2 s", 2 / ours, 1.0)
