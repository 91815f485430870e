"""`aolink view --web` in a real browser: what it shows, what it says, and who can reach it."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import psutil
import pytest

from aolink.colours import estimator_colour
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import Report, record
from aolink.viewing.live import drawn
from aolink.viewing.palette import APPLIED, TRUTH
from aolink.viewing.process import Server, serving
from aolink.viewing.save import save_rrd
from tests.commands import simulated_rig
from tests.needs import missing
from tests.recording.small import write_small
from tests.viewing import browser
from tests.viewing.browser import columns_with
from tests.viewing.test_viewer import LIVELY, listening

if browser.program() is None:
    missing("chromium", FileNotFoundError("chromium: apt-get install chromium"))

SHOWN_S = 240.0
"""How long the page may take: a software renderer on a busy machine is slow."""
Wanted = tuple[str, tuple[int, int, int]]
"""A view and a colour."""
ELSEWHERE = ("fonts.googleapis.com", "api.github.com", "tel.rerun.io", "app.rerun.io")
"""What Rerun's page asks for outside of this machine, in vain here: the page works without."""


def part(picture: browser.Picture, rows: tuple[float, float], columns: tuple[float, float]) -> browser.Picture:
    """A part of the page, in shares of its height and width."""
    height, width, _ = picture.shape
    return picture[int(rows[0] * height) : int(rows[1] * height), int(columns[0] * width) : int(columns[1] * width)]


def views(picture: browser.Picture) -> dict[str, browser.Picture]:
    """The views of the layout, without their titles and legends."""
    return {
        "camera": part(picture, (0.08, 0.42), (0.0, 0.26)),
        "profile": part(picture, (0.15, 0.42), (0.28, 0.53)),
        "path": part(picture, (0.08, 0.42), (0.56, 1.0)),
        "errors": part(picture, (0.48, 0.7), (0.02, 0.33)),
        "nis": part(picture, (0.48, 0.7), (0.35, 0.66)),
        "states": part(picture, (0.48, 0.7), (0.68, 1.0)),
        "input": part(picture, (0.8, 0.95), (0.02, 0.14)),
        "bare": part(picture, (0.65, 0.95), (0.02, 0.14)),  # the same in a layout of two rows
    }


async def shown(address: str, wanted: Sequence[Wanted]) -> tuple[browser.Picture, list[str]]:
    """The page once views have the colours that they are to have, and the errors in its console."""
    async with browser.browser() as tab:
        await tab.open(f"{address}&renderer=webgl")
        return await tab.once(lambda seen: not lacking(seen, wanted), SHOWN_S), tab.errors


def lacking(picture: browser.Picture, wanted: Sequence[Wanted]) -> list[Wanted]:
    """Which views lack which colours."""
    return [(view, colour) for view, colour in wanted if columns_with(views(picture)[view], colour) < 0.02]


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving([str(save_rrd(Recording(LIVELY), tmp_path_factory.mktemp("web") / "full.rrd"))]) as server:
        server.listen()
        yield server


@pytest.mark.slow
def test_every_view_shows_its_colours_in_a_browser_and_nothing_is_wrong(full: Server) -> None:
    best, baseline = estimator_colour("moments"), estimator_colour("open-loop")
    wanted = [
        ("camera", TRUTH), ("profile", best), ("path", TRUTH), ("path", best), ("errors", best), ("errors", baseline),
        ("nis", best), ("states", TRUTH), ("input", APPLIED),
    ]  # fmt: skip
    picture, errors = asyncio.run(shown(full.address, wanted))
    assert lacking(picture, wanted) == []
    ours = [error for error in errors if not any(host in error for host in ELSEWHERE)]
    assert [error for error in ours if "Failed to fetch" not in error] == []


@pytest.mark.slow
def test_a_recording_is_served_while_it_is_read(start_aolink: Callable[..., subprocess.Popen[str]]) -> None:
    process = start_aolink("view", LIVELY, "--web")
    assert process.stdout is not None
    best = estimator_colour("moments")
    wanted = [("path", best), ("errors", best), ("nis", best), ("input", APPLIED)]
    picture, _ = asyncio.run(shown(process.stdout.readline().strip(), wanted))
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert lacking(picture, wanted) == []
    assert process.returncode == 130


@pytest.mark.rare
def test_what_a_recording_lacks_has_no_colour_in_a_browser(tmp_path: Path) -> None:
    bare = Recording(write_small(tmp_path / "bare.mcap", 12))
    with serving([str(save_rrd(bare, tmp_path / "bare.rrd"))]) as server:
        server.listen()
        picture, _ = asyncio.run(shown(server.address, [("bare", APPLIED)]))
    assert lacking(picture, [("bare", APPLIED)]) == []
    for colour in (TRUTH, estimator_colour("open-loop")):
        assert columns_with(picture, colour) < 0.01


class _Empty(SimpleHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()

    def log_message(self, format: str, *arguments: object) -> None:
        pass


@pytest.mark.slow
def test_only_this_machine_is_listened_to_and_no_page_from_elsewhere(full: Server) -> None:
    """A page of another origin gets neither the viewer's page nor the recording; the viewer's own page does."""
    assert listening(psutil.Process(full.process.pid), *psutil.Process(full.process.pid).children(recursive=True)) == {
        "127.0.0.1"
    }
    page = urlsplit(full.address)
    (data,) = parse_qs(page.query)["url"]
    targets = [f"http://127.0.0.1:{page.port}/", f"http://127.0.0.1:{urlsplit(data).port}/"]
    ask = """
        fetch("{}rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages", {{method: "POST", body: new Uint8Array(5),
            headers: {{"content-type": "application/grpc-web+proto", "x-grpc-web": "1"}}}})
            .then(answer => "answered " + answer.status, error => "refused")
    """
    get = 'fetch("{}").then(answer => "answered " + answer.status, error => "refused")'

    async def answers(origin: str) -> list[str]:
        async with browser.browser() as tab:
            await tab.open(origin)
            return [await tab.run(get.format(targets[0])), await tab.run(ask.format(targets[1]))]

    with ThreadingHTTPServer(("127.0.0.1", 0), _Empty) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        other = asyncio.run(answers(f"http://elsewhere.example:{server.server_port}/"))
        server.shutdown()
    assert other == ["refused", "refused"]
    own = asyncio.run(answers(targets[0]))
    assert own[0] == "answered 200"
    assert own[1].startswith("answered")


@pytest.mark.rare
def test_a_session_that_goes_on_is_shown_in_a_browser(tmp_path: Path) -> None:
    rig, names, best = load_rig("section-vi-lively"), ["o1", "moments"], estimator_colour("moments")
    wanted = [("profile", best), ("path", best), ("errors", best), ("nis", best), ("input", APPLIED)]

    async def seen_after(session: Future[Report]) -> browser.Picture:
        async with browser.browser() as tab:
            await tab.open(f"{server.address}&renderer=webgl")
            return await tab.once(lambda seen: session.done() and not lacking(seen, wanted), SHOWN_S)

    with serving() as server:
        server.listen()
        with (
            simulated_rig("section-vi-lively", "--real-time", "--fault", "missing=0.1") as ports,
            drawn(server.data_address, rig, names) as live,
            ThreadPoolExecutor(1) as beside,
        ):
            path = tmp_path / "a.mcap"
            session = beside.submit(record, rig, *ports, path, estimators=names, exposures=20, sinks=[live])
            picture = asyncio.run(seen_after(session))
    assert lacking(picture, wanted) == []
