"""A signal to a session with a serial mirror: it is left at the safe input, and the recording whole."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.recording.reader import Recording
from tests.devices.mirrors.serial_mirrors import MIRRORS, with_each

PATIENCE_S = 120.0
UNDER_WAY = 20
SIGNALS = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}
MIRRORS_OF = {
    signal.SIGINT: ["optotune"],
    signal.SIGTERM: ["pi_gcs2", "thorlabs_aligner"],
    signal.SIGHUP: ["pi_gcs2", "thorlabs_piezo"],
}


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_mirror_is_left_at_its_safe_input(
    start_aolink: Callable[..., subprocess.Popen[str]], tmp_path: Path, number: signal.Signals
) -> None:
    """Each mirror has a session in a process of its own, which is signalled once the mirror moves."""
    np.save(tmp_path / "film.npy", np.full((2, 20, 20), 400, dtype=np.uint16))

    def check(name: str) -> None:
        with MIRRORS[name].make() as device:
            rig = MIRRORS[name].rig(device, 'driver = "folder"\npath = "film.npy"')
            (tmp_path / f"{name}.toml").write_text(rig.toml)
            with start_aolink("record", "--rig", f"{name}.toml", "-o", f"{name}.mcap") as process:
                try:
                    deadline = time.monotonic() + PATIENCE_S
                    while device.moves < UNDER_WAY:
                        assert process.poll() is None, process.communicate()
                        assert time.monotonic() < deadline
                        time.sleep(0.005)
                    process.send_signal(number)
                    _, errors = process.communicate(timeout=PATIENCE_S)
                finally:
                    process.kill()
            assert process.returncode == SIGNALS[number]
            assert f"aolink: interrupted by {number.name}" in errors
            assert "Traceback" not in errors
            assert MIRRORS[name].is_parked(device)
        assert Recording(tmp_path / f"{name}.mcap").complete

    with_each(check, MIRRORS_OF[number])
