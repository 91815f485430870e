"""The commands that exchange recordings with other programs."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.batch import estimate_file
from aolink.errors import ExportError, RecordingError
from aolink.extensions import install_command
from aolink.recording.reader import Recording
from tests.recording.small import write_small

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def lively() -> Recording:
    return Recording(Path(__file__).parents[2] / "recordings" / "section-vi-lively.mcap")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "suffix", "extra"),
    [
        ("pandas", ".csv", "tables"),
        ("pyarrow", ".parquet", "tables"),
        ("h5py", ".nc", "tables"),
        ("aotpy", ".fits", "aot"),
    ],
)
def test_a_package_that_is_missing_is_named_with_its_extra(
    lively: Recording, tmp_path: Path, module: str, suffix: str, extra: str
) -> None:
    code = f"import sys; sys.modules[{module!r}] = None; from aolink.cli import main; main()"
    command = [sys.executable, "-c", code, "export", str(lively.path), "-o", f"out{suffix}"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=60)
    (line,) = done.stderr.splitlines()
    assert done.returncode == ExportError.exit_code
    assert line.endswith(f"needs {module}: {install_command(extra)}")
    assert not list(tmp_path.iterdir())


def test_the_command(aolink: Run, lively: Recording, tmp_path: Path) -> None:
    done = aolink("export", lively.path, "-o", "out.npz", "-e", "o3", "-e", "o1")
    assert (done.returncode, done.stdout) == (0, "written: out.npz\n"), done.stderr
    with np.load(tmp_path / "out.npz") as found:
        assert found["estimator"].tolist() == ["o3", "o1"]


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["-o", "out.docx"], ExportError.exit_code, "its name must end with one of .npz"),
        (["-o", "out"], ExportError.exit_code, "its name must end with one of .npz"),
        (["-o", "out.csv", "-e", "o9"], RecordingError.exit_code, "holds no estimates of o9 (it has: open-loop, o1"),
        (["-o", "there.csv"], ExportError.exit_code, "there.csv exists and is not overwritten"),
        (["-o", "nowhere/out.csv"], ExportError.exit_code, "there is no folder nowhere"),
    ],
)
def test_bad_input_is_one_line(
    aolink: Run, lively: Recording, tmp_path: Path, arguments: list[str], code: int, says: str
) -> None:
    (tmp_path / "there.csv").touch()
    done = aolink("export", lively.path, *arguments)
    (line,) = done.stderr.splitlines()
    assert done.returncode == code
    assert says in line
    assert [each.name for each in tmp_path.iterdir()] == ["there.csv"]


def test_a_damaged_recording_gives_what_is_whole_and_says_so(aolink: Run, lively: Recording, tmp_path: Path) -> None:
    whole = lively.path.read_bytes()
    (tmp_path / "broken.mcap").write_bytes(whole[: len(whole) // 2])
    done = aolink("export", "broken.mcap", "-o", "out.npz")
    assert done.returncode == 0
    assert done.stderr.startswith("aolink: warning: broken.mcap: ")
    with np.load(tmp_path / "out.npz") as found:
        assert 0 < len(found["time"]) < len(lively)


@pytest.mark.slow
def test_a_side_file_alone_is_refused(aolink: Run, tmp_path: Path) -> None:
    source = write_small(tmp_path / "a.mcap", 2)
    estimate_file(source, tmp_path / "a.o1.mcap", "o1")
    done = aolink("export", "a.mcap", "-o", "out.npz")
    assert done.returncode == 0, done.stderr
    done = aolink("export", "a.o1.mcap", "-o", "side.npz")
    assert done.returncode == RecordingError.exit_code
    assert "is a side file" in done.stderr
    assert not (tmp_path / "side.npz").exists()
