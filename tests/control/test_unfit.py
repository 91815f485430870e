"""A controller of another package that does not fit the rig: one line that names it, before anything is opened, and in
a session that has begun a parked mirror."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import ControlError
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import record
from tests.commands import simulated_rig
from tests.control.unfit import EXPOSURES, installed

Run = Callable[..., "subprocess.CompletedProcess[str]"]
UNFIT = [
    ("three", "the controller three gives an array of (3,), expected (1,) finite inputs"),
    ("refuses", "the controller refuses cannot say whether it works on loop: ValueError('no rig like this')"),
]


@pytest.fixture(scope="module")
def with_unfit(with_example: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return installed(tmp_path_factory.mktemp("unfit"), with_example)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded session of the rig `loop`, whose loop was open."""
    path = tmp_path_factory.mktemp("session") / "a.mcap"
    with simulated_rig("loop") as ports:
        record(load_rig("loop"), *ports, path, exposures=EXPOSURES + 3)
    return path


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    """The error of a command: one line, after what is said of the rig `loop`, and the code of controllers."""
    assert done.returncode == ControlError.exit_code, done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    *said, line = done.stderr.splitlines()
    assert all("sensor.noise_density: signal to noise is 391 " in each for each in said)
    return line


@pytest.mark.slow
@pytest.mark.parametrize(("name", "message", "force"), [*((*each, ()) for each in UNFIT), (*UNFIT[0], ("--force",))])
def test_a_session_with_it_ends_before_a_port_is_opened(
    aolink: Run, with_unfit: dict[str, str], tmp_path: Path, name: str, message: str, force: tuple[str, ...]
) -> None:
    ports = ("--camera", "/dev/none", "--mirror", "/dev/none", "--rig", "loop", "-o", "a.mcap")
    line = one_line(aolink("record", *ports, "--control", name, *force, env=with_unfit))
    assert line.startswith(f"aolink: {message}")
    assert "parked" not in line
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_inputs_that_grow_beyond_numbers_are_an_unstable_loop(aolink: Run, with_unfit: dict[str, str]) -> None:
    ports = ("--camera", "/dev/none", "--mirror", "/dev/none", "--rig", "loop", "-o", "a.mcap")
    line = one_line(aolink("record", *ports, "--control", "huge", env=with_unfit))
    assert "the loop of huge on loop is unstable: by the model a disturbance is inf times as large" in line


@pytest.mark.slow
def test_one_that_fails_in_a_session_parks_the_mirror_and_says_so(
    aolink: Run, with_unfit: dict[str, str], session: Path, tmp_path: Path
) -> None:
    """The recording has all until then. A replay, in which there is no mirror, does not speak of one."""
    said = "the controller late gives an array of (3,), expected (1,) finite inputs"
    with simulated_rig("loop") as (camera, mirror):
        done = aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "loop", "--control", "late",
            "--exposures", "60", "-o", "a.mcap", env=with_unfit,
        )  # fmt: skip
    assert done.returncode == ControlError.exit_code
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1] == f"aolink: {said}; the mirror is parked"
    recording = Recording(tmp_path / "a.mcap")
    assert recording.metadata["ended"] == f"error: {said}; the mirror is parked"
    exposures = list(recording.exposures())
    assert EXPOSURES <= len(exposures) < 60
    assert np.allclose(exposures[-1].inputs, 0.5, atol=1e-4)
    assert one_line(aolink("replay", session, "--control", "late", env=with_unfit)) == f"aolink: {said}"
