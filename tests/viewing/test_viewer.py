from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from aolink.errors import ViewerError
from aolink.recording.reader import Recording
from aolink.viewing import open_viewer, serve_web
from aolink.viewing.process import WEB_PORT, free_port, is_free
from aolink.viewing.save import save_rrd
from tests.commands import command_server

LIVELY = Path(__file__).parents[2] / "recordings" / "section-vi-lively.mcap"


@pytest.fixture(scope="module")
def rrd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_rrd(Recording(LIVELY), tmp_path_factory.mktemp("rrd") / "session.rrd")


@pytest.fixture(autouse=True)
def _no_viewer_left_behind() -> Iterator[None]:
    command_server()  # which stays for the tests that come after
    before = set(psutil.Process().children(recursive=True))
    yield
    assert set(psutil.Process().children(recursive=True)) <= before


def listening(*processes: psutil.Process) -> set[str]:
    """Addresses on which they listen."""
    connections = [c for process in processes for c in process.net_connections()]
    return {c.laddr.ip for c in connections if c.status == psutil.CONN_LISTEN}


def test_a_missing_file_is_one_clear_error(tmp_path: Path) -> None:
    for view in (open_viewer, serve_web):
        with pytest.raises(ViewerError, match="no file"):
            view(tmp_path / "absent.rrd")


def test_without_a_display_the_error_says_what_else_works(rrd: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ViewerError, match="--web"):
        open_viewer(rrd)


@pytest.mark.slow
def test_a_viewer_that_ends_by_itself_names_the_driver(rrd: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":77")  # where nothing is
    with pytest.raises(ViewerError, match="mesa-vulkan-drivers"):
        open_viewer(rrd)


def test_the_web_viewer_is_served_on_loopback_until_interrupted(rrd: Path) -> None:
    seen = []

    def look(address: str) -> None:
        with urllib.request.urlopen(address) as page:
            seen.append(page.read())
        seen.append(listening(*psutil.Process().children(recursive=True)))
        raise KeyboardInterrupt

    with free_port() as port, pytest.raises(KeyboardInterrupt):
        serve_web(rrd, port, on_ready=look)
    assert b"<canvas" in seen[0]
    assert seen[1] == {"127.0.0.1"}


def test_a_free_port_is_given_to_nobody_else() -> None:
    """Neither to a program that asks for any port nor to one that asks for this one."""
    with free_port() as port, contextlib.ExitStack() as stack:
        assert is_free(port)
        assert port not in [stack.enter_context(free_port()) for _ in range(50)]
        with socket.socket() as other, pytest.raises(OSError, match="in use"):
            other.bind(("127.0.0.1", port))


def test_a_port_in_use_is_one_clear_error(rrd: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(ViewerError, match=f"port {port} is in use"):
            serve_web(rrd, port)


def test_a_page_moves_where_its_usual_port_is_taken(rrd: Path) -> None:
    seen: list[str] = []

    def look(address: str) -> None:
        with urllib.request.urlopen(address) as page:
            seen.append(page.read().decode())
        seen.append(address)
        raise KeyboardInterrupt

    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # an earlier test may just have left it
        with contextlib.suppress(OSError):  # then somebody else has it
            other.bind(("127.0.0.1", WEB_PORT))
            other.listen()
        with pytest.raises(KeyboardInterrupt):
            serve_web(rrd, on_ready=look)
    assert "<canvas" in seen[0]
    assert urllib.parse.urlsplit(seen[1]).port != WEB_PORT


@pytest.mark.slow
def test_a_rerun_file_is_shown_as_it_is(rrd: Path, start_aolink: Callable[..., subprocess.Popen[str]]) -> None:
    """The command serves it without making a recording of it first; Ctrl-C ends it."""
    serving = start_aolink("view", rrd, "--web")
    assert serving.stdout is not None
    with urllib.request.urlopen(serving.stdout.readline().strip()) as page:
        assert b"<canvas" in page.read()
    serving.send_signal(signal.SIGINT)
    serving.communicate(timeout=60)
    assert serving.returncode == 130


@pytest.mark.slow
def test_what_is_no_rerun_file_is_one_clear_error(aolink: Callable[..., Any], rrd: Path, tmp_path: Path) -> None:
    (tmp_path / "text.rrd").write_text("hello")
    for name, message in (("text.rrd", "text.rrd is not a Rerun file"), ("none.rrd", "there is no file none.rrd")):
        result = aolink("view", name, "--web")
        assert result.returncode == 7
        assert result.stderr.startswith(f"aolink: {message}")
    result = aolink("view", rrd, "-o", "again.rrd")
    assert result.returncode == 2
    assert "is a Rerun file" in " ".join(result.stderr.replace("│", " ").split())
