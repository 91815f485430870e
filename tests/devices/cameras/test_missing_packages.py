"""What a driver says whose library is not installed: what to install, in one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from aolink.extensions import install_command
from aolink.rig import load_rig

WITHOUT = """
import sys
sys.modules["{module}"] = None  # as if it were not there
from aolink.cli import main
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize(("driver", "module"), [("micromanager", "pymmcore"), ("opencv", "cv2")])
def test_a_missing_library_is_named_with_what_to_install(driver: str, module: str, tmp_path: Path) -> None:
    (tmp_path / "my.toml").write_text(f'{load_rig("section-vi").toml}\n[devices.camera]\ndriver = "{driver}"\n')
    command = [sys.executable, "-c", WITHOUT.format(module=module), "record", "--rig", "my.toml", "-o", "a.mcap"]
    done = subprocess.run([*command, "--exposures", "3"], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (4, "")
    assert done.stderr == f"aolink: this needs {module}: {install_command(driver)}\n"
    assert not (tmp_path / "a.mcap").exists()
