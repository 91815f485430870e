"""Recordings behind URLs: the same results as from files, by the ranges that are needed; one line where it fails."""

from __future__ import annotations

import pickle
import re
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import fsspec
import numpy as np
import pytest
import s3fs
from hypothesis import example, given
from hypothesis import strategies as st

from aolink.batch import estimate_file
from aolink.errors import RecordingError
from aolink.recording.compare import compare
from aolink.recording.reader import Recording
from aolink.recording.remote import AHEAD, MOST_AHEAD, Url, location
from aolink.recording.topics import EXPOSURE
from tests.recording.small import write_small
from tests.s3_server import S3Server, serving_s3

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def s3(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[S3Server]:
    """With the bucket `lab`."""
    with serving_s3() as server:
        for name, value in {
            "AWS_ENDPOINT_URL": server.url, "AWS_ACCESS_KEY_ID": "me", "AWS_SECRET_ACCESS_KEY": "secret",
            "AWS_DEFAULT_REGION": "us-east-1", "AWS_CONFIG_FILE": str(tmp_path / "none"),
        }.items():  # fmt: skip
            monkeypatch.setenv(name, value)
        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir("lab")
        yield server
        s3fs.S3FileSystem.clear_instance_cache()


class _Ranges(BaseHTTPRequestHandler):
    """What a web server does: files of one folder, ranges of them, one that nobody may read, one that it fails at."""

    folder: Path
    gives_ranges = True

    def do_HEAD(self) -> None:
        self._answer()

    def do_GET(self) -> None:
        if (data := self._answer()) is not None:
            self.wfile.write(data)

    def _answer(self) -> bytes | None:
        name = self.path.strip("/").partition("?")[0]
        if refusal := {"secret.mcap": 403, "broken.mcap": 500}.get(name):
            self.send_error(refusal)
            return None
        if not (self.folder / name).is_file():
            self.send_error(404)
            return None
        whole = data = (self.folder / name).read_bytes()
        wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if wanted and self.gives_ranges:
            data = whole[int(wanted[1]) : int(wanted[2]) + 1]
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {wanted[1]}-{int(wanted[1]) + len(data) - 1}/{len(whole)}")
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        return data

    def log_message(self, format: str, *arguments: object) -> None:
        """Requests are no news."""


@pytest.fixture
def web(tmp_path: Path) -> Iterator[tuple[str, type[_Ranges]]]:
    """A web server of the folder, as the start of its URLs, and its handler."""
    handler = type("Handler", (_Ranges,), {"folder": tmp_path})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", handler
    server.shutdown()
    thread.join()
    server.server_close()


def same_as_from_the_file(url: str, source: Path, folder: Path) -> None:
    """The row and the estimates, and the side file belongs to both."""
    rows = [estimate_file(str(each), folder / f"{k}.mcap") for k, each in enumerate((source, url))]
    differing = {key for key in rows[0] if rows[0][key] != rows[1][key]}
    assert differing <= {"recording", "output", "seconds"}
    there = Recording(url, side=[folder / "0.mcap"])
    assert all(each.same for each in compare(Recording(source, side=[folder / "1.mcap"]), there).values())


@pytest.mark.slow
def test_object_storage_gives_what_the_file_gives(s3: S3Server, tmp_path: Path) -> None:
    source = write_small(tmp_path / "s.mcap", 30, truth=True)
    s3fs.S3FileSystem().put(str(source), "lab/night/s.mcap")
    same_as_from_the_file("s3://lab/night/s.mcap", source, tmp_path)


@pytest.mark.slow
def test_so_do_a_web_server_and_memory(web: tuple[str, type[_Ranges]], tmp_path: Path) -> None:
    source = write_small(tmp_path / "s.mcap", 30, truth=True)
    same_as_from_the_file(f"{web[0]}/s.mcap?signature=1", source, tmp_path)
    fsspec.filesystem("memory").pipe("/lab/s.mcap", source.read_bytes())
    (tmp_path / "memory").mkdir()
    same_as_from_the_file("memory://lab/s.mcap", source, tmp_path / "memory")


def test_a_server_that_does_not_answer_is_no_missing_file(tmp_path: Path) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}/s.mcap"
        with pytest.raises(RecordingError, match="its server does not answer") as error:
            Recording(url)
    assert "no such file" not in str(error.value)
    with pytest.raises(RecordingError) as error:
        Recording(f"{url}?signature=SECRET")
    assert "SECRET" not in str(error.value)


@pytest.mark.slow
def test_no_more_is_read_than_is_needed(s3: S3Server, tmp_path: Path) -> None:
    """All of it is needed once to estimate it; to look at its index, little. No request is for more than a megabyte."""
    source = write_small(tmp_path / "s.mcap", 1500, truth=True)
    size = source.stat().st_size
    assert size > 2 * MOST_AHEAD
    s3fs.S3FileSystem().put(str(source), "lab/s.mcap")
    recording = Recording("s3://lab/s.mcap")
    assert recording.n_frames == 1500
    assert sum(s3.sent) < 2 * AHEAD + size / 20
    s3.sent.clear()
    middle = recording.start_ns + 100 * 200_000_000
    assert sum(1 for _ in recording.messages(EXPOSURE, start_ns=middle, end_ns=middle + 10**9)) == 5
    assert sum(s3.sent) < size / 4
    s3.sent.clear()
    assert [each.frame_id for each in Recording("s3://lab/s.mcap")[700:703]] == [701, 702, 703]
    assert len(s3.sent) < 12, "where a frame is, is known without reading"
    assert sum(s3.sent) < 2 * MOST_AHEAD + 4 * AHEAD + size / 20
    s3.sent.clear()
    assert len(list(Recording("s3://lab/s.mcap")[300:450])) == 150
    assert sum(s3.sent) < 2 * MOST_AHEAD + 4 * AHEAD + size / 10 + size / 20
    s3.sent.clear()
    estimate_file("s3://lab/s.mcap", tmp_path / "out.mcap")
    assert size * 0.9 < sum(s3.sent) < 1.1 * size
    assert max(s3.sent) <= 1.3 * MOST_AHEAD


@pytest.mark.slow
def test_nobody_may_read_it_or_it_is_not_there(
    s3: S3Server, web: tuple[str, type[_Ranges]], aolink: Run, tmp_path: Path
) -> None:
    """One line each, and nothing is written."""
    source = write_small(tmp_path / "s.mcap", 3)
    s3fs.S3FileSystem().put(str(source), "lab/s.mcap")
    (tmp_path / "out").mkdir()
    for url, message in (
        ("s3://lab/none.mcap", "there is no such file"),
        ("s3://none/s.mcap", "there is no such file"),
        (f"{web[0]}/none.mcap", "there is no such file"),
        (f"{web[0]}/secret.mcap", "no right to read it"),
        (f"{web[0]}/broken.mcap", "its server has an error"),
        ("http://127.0.0.1:1/s.mcap", "Cannot connect to host"),
        ("ftpx://lab/s.mcap", "Protocol not known"),
        ("memory://none.mcap", "there is no such file"),
    ):
        with pytest.raises(RecordingError, match=message) as caught:
            estimate_file(url, tmp_path / "out" / "s.mcap")
        assert str(caught.value).startswith(f"cannot read {url}: ")
        assert len(str(caught.value).splitlines()) == 1
    s3.refuse_strangers()
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(RecordingError, match=r"cannot read s3://lab/s\.mcap: no right to read it"):
        estimate_file("s3://lab/s.mcap", tmp_path / "out" / "s.mcap")
    result = aolink("estimate", "s3://lab/s.mcap", "-o", "out/")
    assert (result.returncode, len(result.stderr.splitlines())) == (1, 1)
    assert "no right to read it" in result.stderr
    assert [each.name for each in (tmp_path / "out").iterdir()] == ["results.csv"]


@pytest.mark.slow
def test_a_server_that_gives_no_ranges_is_refused(web: tuple[str, type[_Ranges]], tmp_path: Path) -> None:
    write_small(tmp_path / "s.mcap", 400)
    web[1].gives_ranges = False
    with pytest.raises(RecordingError, match="its server gives no ranges, or the file has changed: copy it here"):
        Recording(f"{web[0]}/s.mcap")


@pytest.mark.slow
def test_the_commands_take_urls(s3: S3Server, aolink: Run, tmp_path: Path) -> None:
    source = write_small(tmp_path / "s.mcap", 4)
    s3fs.S3FileSystem().put(str(source), "lab/s.mcap")
    url = "s3://lab/s.mcap"
    estimate_file(url, tmp_path / "s.o3.mcap")
    for arguments in (("estimate", url), ("view", url, "s.o3.mcap", "-o", "s.rrd")):
        result = aolink(*arguments)
        assert result.returncode == 0, result.stderr


@pytest.mark.slow
@given(st.lists(st.tuples(st.integers(0, 400_000), st.integers(0, 90_000)), max_size=12), st.booleans())
@example([(210_001, 90_000)], True)  # planned beyond the end
def test_what_is_read_is_what_is_there(reads: list[tuple[int, int]], planned: bool) -> None:
    data = np.random.default_rng(1).bytes(300_000)
    fsspec.filesystem("memory").pipe("/bytes", data)
    url = Url("memory://bytes")
    for _ in range(2):
        with url.open(sorted(reads) if planned else ()) as file:
            for start, length in sorted(reads) if planned else reads:
                assert file.seek(start) == start
                assert file.read(length) == data[start : start + length]


def test_a_url_shows_no_secret_and_goes_between_processes() -> None:
    url = location("https://me:password@host:8/night/s.o3.mcap?X-Amz-Signature=abc")
    assert isinstance(url, Url)
    assert (str(url), url.name, url.stem, url.suffix) == (
        "https://host:8/night/s.o3.mcap", "s.o3.mcap", "s.o3", ".mcap"
    )  # fmt: skip
    again = pickle.loads(pickle.dumps(url))
    assert again.text == url.text
    assert location("night/s.mcap") == Path("night/s.mcap")
