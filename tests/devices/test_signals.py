"""Ctrl-C and SIGTERM to a session with a serial mirror: it is left at the safe input, and the recording whole."""

from __future__ import annotations

import math
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.recording.reader import Recording
from tests.devices.mirrors import bench
from tests.devices.simulators.optotune import OptotuneSimulator
from tests.devices.simulators.playzerx import PlayzerX

Start = Callable[..., "subprocess.Popen[str]"]
PATIENCE_S = 120.0
SIGNALS = {signal.SIGINT: 130, signal.SIGTERM: 143}
UNIT_RAD = 0.5


def end_by_signal(start_aolink: Start, folder: Path, mirror: str, moves: Callable[[], bool], number: int) -> None:
    """Begin a session with a mirror whose safe input is [0.25, -0.5], and signal it once the mirror moves."""
    np.save(folder / "film.npy", np.full((2, 20, 20), 400, dtype=np.uint16))
    toml = bench.rig_with(f'[devices.camera]\ndriver = "folder"\npath = "film.npy"\n[devices.mirror]\n{mirror}').toml
    (folder / "rig.toml").write_text(
        toml.replace("dac_bits = 16", "dac_bits = 12\nqueue_steps = 150\npark = [0.25, -0.5]")
    )
    with start_aolink("record", "--rig", "rig.toml", "-o", "a.mcap") as process:
        try:
            deadline = time.monotonic() + PATIENCE_S
            while not moves():
                assert process.poll() is None, process.communicate()
                assert time.monotonic() < deadline
                time.sleep(0.005)
            process.send_signal(number)
            _, errors = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert process.returncode == SIGNALS[signal.Signals(number)]
    assert f"aolink: interrupted by {signal.Signals(number).name}" in errors
    assert "Traceback" not in errors
    assert Recording(folder / "a.mcap").complete


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_mirror_with_a_queue_is_left_at_the_safe_input(start_aolink: Start, tmp_path: Path, number: int) -> None:
    with PlayzerX() as device:

        def moves() -> bool:
            with device.lock:
                return len({sample[:2] for sample in device.put_out}) > 10

        mirror = f'driver = "playzerx"\nport = "{device.port}"\nahead_s = 0.4\nlaser = 200'
        end_by_signal(start_aolink, tmp_path, mirror, moves, number)
        assert device.at_rest() == (2559, 1024, (0,))


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_mirror_without_a_queue_is_left_at_the_safe_input(start_aolink: Start, tmp_path: Path, number: int) -> None:
    with OptotuneSimulator() as device:
        mirror = f'driver = "optotune"\nport = "{device.port}"\nunit_rad = {UNIT_RAD}'
        end_by_signal(start_aolink, tmp_path, mirror, lambda: len(device.held) > 20, number)
        expected = [math.tan(UNIT_RAD * u) / math.tan(math.radians(50)) for u in (0.25, -0.5)]
        assert device.now() == pytest.approx(expected, abs=1e-3)
