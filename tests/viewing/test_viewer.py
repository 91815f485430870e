from __future__ import annotations

import contextlib
import io
import os
import signal
import socket
import subprocess
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import rerun as rr
from PIL import Image

from aolink.colours import estimator_colour
from aolink.errors import RendererError, ViewerError
from aolink.viewing import open_viewer, screenshot, serve_web
from aolink.viewing.palette import TRUTH
from aolink.viewing.process import WEB_PORT, free_port, is_free
from aolink.viewing.save import save_rrd
from aolink.viewing.viewer import headless_viewer, settled_picture
from aolink.viewing.vulkan import has_vulkan
from tests.commands import command_server
from tests.viewing.stand_in import StandIn, as_recording

TEXTS = ("Session", "Warnings", "Log")
PICTURES = ("Camera", "Intensity")


@pytest.fixture(scope="module")
def rrd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_rrd(
        as_recording(StandIn(n=60, names=("o3", "open-loop"))), tmp_path_factory.mktemp("rrd") / "session.rrd"
    )


@pytest.fixture(autouse=True)
def _no_viewer_left_behind() -> Iterator[None]:
    command_server()  # which stays for the tests that come after
    before = set(psutil.Process().children(recursive=True))
    yield
    assert set(psutil.Process().children(recursive=True)) <= before


def needs_a_renderer(error: ViewerError) -> None:
    if isinstance(error, RendererError) and not os.environ.get("AOLINK_REQUIRE_ALL"):
        pytest.skip(str(error))
    raise error


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def columns_with(picture: np.ndarray, colour: tuple[int, int, int]) -> float:
    """Share of the picture's columns in which a colour appears."""
    near = np.abs(picture.astype(int) - colour).max(axis=2) < 30
    return float(near.any(axis=0).mean())


def coloured_columns(picture: np.ndarray) -> float:
    """Share of the picture's columns in which something is not grey: lines do it, frames and grids do not."""
    return float((np.ptp(picture.astype(int), axis=2) > 40).any(axis=0).mean())


def listening(*processes: psutil.Process) -> set[str]:
    """Addresses on which they listen."""
    connections = [c for process in processes for c in process.net_connections()]
    return {c.laddr.ip for c in connections if c.status == psutil.CONN_LISTEN}


def spread_tabs(layout: dict[str, Any]) -> dict[str, Any]:
    """The layout with all tabs beside each other: the viewer draws only what is visible."""
    for part in layout.values():
        container = part.get("ContainerBlueprint", {})
        if container.get("container_kind") == "Tabs":
            container["container_kind"] = "Grid"
            container.pop("active_tab", None)
    return layout


@pytest.mark.slow
def test_every_view_shows_data(rrd: Path) -> None:
    try:
        with headless_viewer(rrd) as client:
            client.set_blueprint(spread_tabs(client.get_blueprint().blueprint), "recording")
            settled_picture(client)
            state = client.get_state()
            pictures = {view.name: pixels(client.take_screenshot(view.view_id)) for view in state.views}
            assert [view.name for view in state.views if view.reports] == []
            assert [entry.message for entry in client.get_logs() if entry.level == "ERROR"] == []
    except ViewerError as error:
        needs_a_renderer(error)
    assert len(pictures) > 20
    for name, picture in pictures.items():
        if name.startswith(TEXTS):
            assert (picture.min(axis=2) > 120).mean() > 0.002, name
        else:
            # A legend alone colours less than a tenth of a view's columns.
            assert coloured_columns(picture) > (0.15 if name.startswith(PICTURES) else 0.4), name
    (path,) = (picture for name, picture in pictures.items() if name.startswith("Path, o3"))
    assert columns_with(path, TRUTH) > 0.6
    assert columns_with(path, estimator_colour("o3")) > 0.4


@pytest.mark.slow
def test_a_screenshot_shows_the_layout(rrd: Path, tmp_path: Path) -> None:
    try:
        screenshot(rrd, tmp_path / "session.png", size=(1600, 1000))
    except ViewerError as error:
        needs_a_renderer(error)
    picture = pixels((tmp_path / "session.png").read_bytes())
    rows, columns, _ = picture.shape
    assert columns == 1600
    assert 900 < rows < 1000  # without the empty title bar
    assert coloured_columns(picture) > 0.8


@pytest.mark.rare
def test_a_screenshot_is_of_the_time_that_is_asked_for(rrd: Path, tmp_path: Path) -> None:
    """The camera's view, in the corner, has another exposure's row framed."""
    try:
        corners = [
            pixels(screenshot(rrd, tmp_path / f"{k}.png", at_ns=at_ns).read_bytes())[:300, :400]
            for k, at_ns in enumerate([100_000_000, 100_000_000, 900_000_000])
        ]
    except ViewerError as error:
        needs_a_renderer(error)
    np.testing.assert_array_equal(corners[0], corners[1])
    assert (corners[0] != corners[2]).any()


@pytest.mark.slow
def test_a_viewer_ends_with_its_block_whatever_happens_in_it(rrd: Path) -> None:
    viewers: list[psutil.Process] = []

    def interrupted() -> None:
        with headless_viewer(rrd):
            viewers.extend(p for p in psutil.Process().children(recursive=True) if "rerun" in p.name().lower())
            assert listening(*viewers) == {"127.0.0.1"}
            raise KeyboardInterrupt

    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted()
    except ViewerError as error:
        needs_a_renderer(error)
    assert not viewers[0].is_running()


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["dx12", "gl"])
def test_without_a_driver_the_error_names_the_package(
    rrd: Path, tmp_path: Path, without_vulkan: pytest.MonkeyPatch, backend: str
) -> None:
    """With dx12, which Linux does not have, the viewer ends before it answers; with gl it ends while it answers."""
    without_vulkan.setenv("WGPU_BACKEND", backend)
    try:
        screenshot(rrd, tmp_path / "session.png")
    except ViewerError as error:
        failed = error
    else:
        assert backend == "gl"
        pytest.skip("this machine's OpenGL is good enough for Rerun: it needs no Vulkan")
    assert isinstance(failed, RendererError), failed
    assert "no Vulkan driver" in str(failed)
    assert str(failed).endswith("apt-get install mesa-vulkan-drivers")
    assert not (tmp_path / "session.png").exists()


def test_a_viewer_that_ends_for_another_reason_is_not_the_drivers_fault(
    rrd: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not has_vulkan():
        needs_a_renderer(RendererError("this machine has no Vulkan driver"))
    monkeypatch.setenv("WGPU_BACKEND", "dx12")
    with pytest.raises(ViewerError, match=r"Rerun ended: .*panicked") as ended:
        screenshot(rrd, tmp_path / "session.png")
    assert not isinstance(ended.value, RendererError)


def test_a_missing_file_is_one_clear_error(tmp_path: Path) -> None:
    for view in (open_viewer, serve_web, lambda path: screenshot(path, tmp_path / "x.png")):
        with pytest.raises(ViewerError, match="there is no file"):
            view(tmp_path / "absent.rrd")


def test_without_a_display_the_error_says_what_else_works(rrd: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ViewerError, match=r"-o X\.png"):
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


@pytest.mark.slow
def test_a_viewer_that_gets_the_data_over_the_network_shows_the_layout(rrd: Path, tmp_path: Path) -> None:
    with rr.RecordingStream("another") as stream:
        stream.save(tmp_path / "another.rrd")
        stream.send_columns(
            "line", [rr.TimeColumn("fast_step", sequence=[0, 1])], rr.Scalars.columns(scalars=[0.0, 1.0])
        )
    names: set[str] = set()

    def look(address: str) -> None:
        (data,) = urllib.parse.parse_qs(urllib.parse.urlsplit(address).query)["url"]
        with headless_viewer(tmp_path / "another.rrd") as client:
            client.open(data)
            deadline = time.monotonic() + 30
            while "Session" not in names and time.monotonic() < deadline:
                time.sleep(0.1)
                names.update(view.name for view in client.get_state().views)
        raise KeyboardInterrupt

    try:
        with free_port() as port, pytest.raises(KeyboardInterrupt):
            serve_web(rrd, port, on_ready=look)
    except ViewerError as error:
        needs_a_renderer(error)
    assert {"Session", "Log", "Path, all (slope units)"} <= names


@pytest.mark.slow
def test_a_file_without_time_is_shown_as_it_is(tmp_path: Path) -> None:
    """As `aolink slopes -o X.rrd` writes one."""
    with rr.RecordingStream("another") as stream:
        stream.save(tmp_path / "still.rrd")
        stream.log("picture", rr.Image(np.random.default_rng(1).integers(0, 255, (40, 60, 3), np.uint8)), static=True)
    try:
        screenshot(tmp_path / "still.rrd", tmp_path / "still.png")
    except ViewerError as error:
        needs_a_renderer(error)
    colours = np.asarray(Image.open(tmp_path / "still.png")).reshape(-1, 3)
    assert len(np.unique(colours, axis=0)) > 1000


@pytest.mark.slow
@pytest.mark.parametrize("how", [(), ("--follow",)])
def test_a_recording_is_served_while_it_is_read(
    how: tuple[str, ...], tmp_path: Path, start_aolink: Callable[..., subprocess.Popen[str]]
) -> None:
    """A viewer that takes what `aolink view RECORDING --web` serves has its exposures and its layout."""
    recording = Path(__file__).parents[2] / "recordings" / "section-vi-lively.mcap"
    with rr.RecordingStream("another") as stream:
        stream.save(tmp_path / "another.rrd")
        stream.send_columns("line", [rr.TimeColumn("time", duration=[0, 1])], rr.Scalars.columns(scalars=[0.0, 1.0]))
    serving = start_aolink("view", recording, "--web", *how)
    assert serving.stdout is not None
    address = serving.stdout.readline().strip()
    (data,) = urllib.parse.parse_qs(urllib.parse.urlsplit(address).query)["url"]
    wanted = {"Path, all (slope units)", "NIS (no unit) with its 95% bounds"} | ({"Session"} if not how else set())
    names: set[str] = set()
    try:
        with headless_viewer(tmp_path / "another.rrd") as client:
            client.open(data)
            deadline = time.monotonic() + 30
            while wanted - names and time.monotonic() < deadline:
                time.sleep(0.1)
                names.update(view.name for view in client.get_state().views)
    except ViewerError as error:
        needs_a_renderer(error)
    finally:
        serving.send_signal(signal.SIGINT)
        serving.communicate(timeout=60)
    assert wanted <= names
    assert serving.returncode == 130


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
    assert "is a Rerun file already" in " ".join(result.stderr.replace("│", " ").split())
