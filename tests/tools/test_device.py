"""The reference device in C: its own tests and its fuzzer, under the sanitisers, on this machine's compiler."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.needs import missing

DEVICE = Path(__file__).parents[2] / "tools" / "device"


def make(build: Path, *what: str) -> str:
    try:
        done = subprocess.run(["make", "-C", DEVICE, f"BUILD={build}", *what], capture_output=True, text=True)
    except FileNotFoundError as error:
        missing("make", error)
    if done.returncode and "not found" in done.stderr and "gcc" in done.stderr:
        missing("a C compiler", RuntimeError(done.stderr))
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["cc", "clang"])
def test_the_vectors_and_the_states_hold(compiler: str, tmp_path: Path) -> None:
    """Every good, broken and parted packet that aolink publishes is taken as the file says."""
    if compiler == "clang" and shutil.which("clang") is None:
        pytest.skip("clang is a second opinion: .ci/run installs gcc only")
    said = make(tmp_path, "test", f"CC={compiler}")
    assert "checks hold" in said


@pytest.mark.slow
def test_random_bytes_and_packets_find_nothing(tmp_path: Path) -> None:
    make(tmp_path, f"{tmp_path}/fuzz")
    done = subprocess.run([tmp_path / "fuzz", "3", "7"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_it_allocates_nothing() -> None:
    for source in DEVICE.glob("*.c"):
        assert not [word for word in ("malloc(", "calloc(", "realloc(", "alloca(") if word in source.read_text()], (
            source
        )
