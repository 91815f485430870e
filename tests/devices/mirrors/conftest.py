"""A session with each serial mirror, for the tests of what goes wrong in one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from aolink.extensions import installed
from aolink.session import Report, record
from tests.devices.mirrors import bench
from tests.devices.mirrors.serial_mirrors import MIRRORS
from tests.devices.simulators.serial_device import SerialDevice


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """Records exposures with a mirror, by its name; gives the file."""
    bench.install(monkeypatch, tmp_path)

    def run(name: str, device: SerialDevice, report: Report, exposures: int = 0) -> Path:
        path = tmp_path / f"{name}.mcap"
        record(MIRRORS[name].rig(device), None, None, path, exposures=exposures, report=report)
        return path

    yield run
    installed.cache_clear()
