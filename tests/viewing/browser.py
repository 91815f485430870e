"""A real browser without a screen, driven over its DevTools protocol."""

from __future__ import annotations

import asyncio
import base64
import io
import shutil
import subprocess
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import numpy.typing as npt
from PIL import Image

OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--disable-extensions",
    "--disable-background-networking", "--disable-component-update", "--mute-audio",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--remote-debugging-port=0", "--window-size=1100,800",
    "--host-resolver-rules=MAP elsewhere.example 127.0.0.1, MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)  # fmt: skip
"""WebGL without a graphics card; no network, but another name for this machine, as a page from elsewhere would have."""
_START_S = 60.0
_SLICE_S = 0.5
Picture = npt.NDArray[np.uint8]


def columns_with(picture: Picture, colour: tuple[int, int, int]) -> float:
    """Share of the picture's columns in which a colour appears."""
    near = np.abs(picture.astype(int) - colour).max(axis=2) < 30
    return float(near.any(axis=0).mean())


def program() -> str | None:
    """The browser's, or None where there is none."""
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class NotNow(Exception):
    """The browser cannot do it, such as while a page takes the place of another."""


@dataclass
class Tab:
    """A page in the browser."""

    socket: aiohttp.ClientWebSocketResponse
    errors: list[str] = field(default_factory=list)
    """What the page's console has said is an error."""
    _asked: int = 0

    async def ask(self, method: str, **parameters: Any) -> Any:
        """Send a command and give its result; events before it are looked through for errors."""
        self._asked += 1
        await self.socket.send_json({"id": self._asked, "method": method, "params": parameters})
        while True:
            message = await self.socket.receive_json(timeout=_START_S)
            if message.get("id") == self._asked:
                if "error" in message:
                    raise NotNow(str(message["error"]))
                return message["result"]
            method, what = message.get("method"), message.get("params", {})
            if method == "Runtime.exceptionThrown":
                self.errors.append(str(what["exceptionDetails"]))
            elif method == "Log.entryAdded" and what["entry"]["level"] == "error":
                self.errors.append(f"{what['entry']['text']} {what['entry'].get('url', '')}")
            elif method == "Runtime.consoleAPICalled" and what["type"] == "error":
                self.errors.append(" ".join(str(each.get("value", each.get("description"))) for each in what["args"]))

    async def open(self, address: str) -> None:
        """Go to an address and wait until its document is there."""
        await self.ask("Page.navigate", url=address)
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline:
            with suppress(NotNow):
                if await self.run("location.href != 'about:blank' && document.readyState == 'complete'"):
                    return
            await asyncio.sleep(_SLICE_S / 5)
        raise AssertionError(f"{address} was not loaded")

    async def picture(self) -> Picture:
        shot = await self.ask("Page.captureScreenshot", format="png")
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(shot["data"]))).convert("RGB"))

    async def once(self, shows: Callable[[Picture], bool], within_s: float) -> Picture:
        """The page's picture as soon as it shows something; the last one where it never does."""
        deadline = time.monotonic() + within_s
        while True:
            seen = await self.picture()
            if shows(seen) or time.monotonic() > deadline:
                return seen
            await asyncio.sleep(_SLICE_S)

    async def run(self, script: str) -> Any:
        """The value of a promise or an expression."""
        done = await self.ask("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        return done["result"].get("value")


@asynccontextmanager
async def browser() -> AsyncIterator[Tab]:
    """A new browser with an empty page; it ends with the block."""
    name = program()
    assert name is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        command = [name, *OPTIONS, f"--user-data-dir={folder}", "about:blank"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port = await _port(Path(folder) / "DevToolsActivePort", process)
            async with aiohttp.ClientSession() as session:
                async with session.get(f"http://127.0.0.1:{port}/json/list") as pages:
                    (page,) = [each for each in await pages.json() if each["type"] == "page"]
                async with session.ws_connect(page["webSocketDebuggerUrl"], max_msg_size=0) as socket:
                    tab = Tab(socket)
                    for domain in ("Page", "Runtime", "Log"):
                        await tab.ask(f"{domain}.enable")
                    dark = [{"name": "prefers-color-scheme", "value": "dark"}]
                    await tab.ask("Emulation.setEmulatedMedia", features=dark)
                    yield tab
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


async def _port(said: Path, process: subprocess.Popen[bytes]) -> int:
    """The port that the browser listens on, once it says so."""
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline and process.poll() is None:
        lines = said.read_text().splitlines() if said.exists() else []
        if len(lines) > 1:
            return int(lines[0])
        await asyncio.sleep(_SLICE_S / 5)
    raise AssertionError("the browser did not start")
