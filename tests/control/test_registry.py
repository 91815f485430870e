"""Controllers of other packages: found by their entry points, used like aolink's own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from aolink.errors import ControlError
from aolink.recording.reader import Recording
from tests.commands import simulated_rig
from tests.control.rigs import DRIFT, small_rig
from tests.packages import package

Run = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.mark.rare
def test_an_installed_package_adds_a_controller(aolink: Run, with_example: dict[str, str], tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(small_rig(DRIFT).toml)
    with simulated_rig(path) as (camera, mirror):
        done = aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "rig.toml", "--control", "double",
            "--exposures", "20", "-o", "a.mcap", env=with_example,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert Recording(tmp_path / "a.mcap").metadata["controller"] == "double"
    asked = aolink("replay", "a.mcap", "--control", "double", "--json", env=with_example)
    assert asked.returncode == 0, asked.stderr
    result = json.loads(asked.stdout)
    assert result["difference_rms"] == 0
    assert result["closed_rms"] == result["recorded_rms"] < result["open_rms"]
    alone = aolink("replay", "a.mcap", "--control", "double")
    assert alone.returncode == ControlError.exit_code
    assert "there is no controller 'double': use one of integrator, lqg" in alone.stderr


def test_it_may_refuse_a_rig(with_example: dict[str, str]) -> None:
    code = (
        "from aolink.control import find_controller; from tests.control.rigs import small_rig;"
        "find_controller('double', small_rig(control='gain = 0.9'))"
    )
    done = subprocess.run([sys.executable, "-c", code], env=with_example, capture_output=True, text=True)
    assert "ControlError: double follows drifts over many exposures" in done.stderr


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("nowhere.at_all:ROW", "cannot be loaded: ModuleNotFoundError"),
        ("math:pi", "(math:pi) is 3.14159"),
        ("ends:ROW", "cannot be loaded: SystemExit"),
    ],
)
def test_a_broken_package_is_one_line_for_who_asks_for_it(
    with_example: dict[str, str], tmp_path: Path, value: str, why: str
) -> None:
    site = package(tmp_path / "site", "broken", f"[aolink.controllers]\ncracked = {value}\n")
    (site / "ends.py").write_text("raise SystemExit")
    environment = with_example | {"PYTHONPATH": f"{site}:{with_example['PYTHONPATH']}"}
    code = (
        "from aolink.control import find_controller; from tests.control.rigs import small_rig; rig = small_rig();"
        "find_controller('lqg', rig); find_controller('cracked', rig)"
    )
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    last = done.stderr.splitlines()[-1]
    assert last.startswith("aolink.errors.ControlError: the controller cracked of broken")
    assert why in last


@pytest.mark.slow
def test_the_commands_say_what_they_need(aolink: Run, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(small_rig(control="gain = 4.0").toml)
    ports = ("--camera", "/dev/none", "--mirror", "/dev/none", "--rig", "rig.toml", "-o", "a.mcap")
    for arguments, why in (
        (("--control", "pid"), "there is no controller 'pid': use one of integrator, lqg"),
        (("--control", "integrator"), "is unstable: by the model"),
        (("--control", "integrator", "--calibration", "still"), "a controller gives the inputs itself"),
        (("--force",), "--force is for --control"),
    ):
        done = aolink("record", *ports, *arguments)
        assert done.returncode in (ControlError.exit_code, 2)
        assert why in " ".join(done.stderr.replace("│", " ").split()), done.stderr
        assert not (tmp_path / "a.mcap").exists()
