"""The reference device in C: its own tests and its fuzzer, under the sanitisers, on this machine's compiler."""

from __future__ import annotations

import secrets
import shutil
import subprocess
from pathlib import Path

import pytest

from aolink.devices.discovery import identify_port
from aolink.devices.opening import signed
from aolink.errors import DeviceError
from aolink.rig import load_rig
from aolink.session import record
from tests.needs import missing

RIG = load_rig("section-vi")
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


@pytest.mark.slow
def test_a_signed_session(tmp_path: Path) -> None:
    """Its signatures were written from the page; aolink's own take them, and it takes aolink's."""
    make(tmp_path, f"{tmp_path}/device")
    (key := tmp_path / "rig.key").write_text(secrets.token_hex(32))
    key.chmod(0o640)
    refused = subprocess.run([tmp_path / "device", "-k", key], capture_output=True, text=True, timeout=20)
    assert refused.returncode == 1
    assert "a file that only its owner may read" in refused.stderr
    key.chmod(0o600)
    command = [str(tmp_path / "device"), "-k", str(key)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, bufsize=1) as process:
        try:
            assert process.stdout is not None
            camera, mirror = (process.stdout.readline().split()[1] for _ in range(2))
            with pytest.raises(DeviceError, match="takes signed packets only"):
                identify_port(mirror)
            reports = [
                record(signed(RIG, camera, mirror, key), None, None, tmp_path / f"{k}.mcap", exposures=3) for k in "ab"
            ]
        finally:
            process.terminate()
    assert [(report.ended, report.exposures) for report in reports] == [("complete", 3)] * 2
    assert reports[0].connection_faults["bad_payload"] == 0


def test_it_allocates_nothing() -> None:
    for source in DEVICE.glob("*.c"):
        assert not [word for word in ("malloc(", "calloc(", "realloc(", "alloca(") if word in source.read_text()], (
            source
        )
