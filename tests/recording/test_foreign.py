"""Others read our recordings, and we read those of others."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from aolink.recording.compare import compare
from aolink.recording.reader import Recording
from aolink.recording.reestimate import reestimate, write_reestimated
from tests.conftest import Session

ROOT = Path(__file__).parents[2]
RERUN = Path(sys.executable).parent / "rerun"


def rerun_check(path: Path) -> str:
    """What an MCAP reader in another language, Rerun's, says of a file; it is asked to decode everything."""
    result = subprocess.run([RERUN, "mcap", "check", "--full", path], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_another_reader_finds_nothing_wrong(recorded: Session, tmp_path: Path) -> None:
    write_reestimated(Recording(recorded.path), ["moments"], tmp_path / "again.mcap")
    for path in (recorded.path, tmp_path / "again.mcap"):
        said = rerun_check(path)
        rows = [line for line in said.splitlines() if re.search(r" /\w", line)]
        assert len(rows) == len(Recording(path).counts)
        assert all(line.split()[0] == "ok" for line in rows), said


def test_the_page_for_other_software_is_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example runs as it stands, and what it writes can be estimated."""
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "recordings" / "FORMAT.md").read_text(), re.DOTALL)
    shutil.copytree(ROOT / "aolink" / "rigs", tmp_path / "aolink" / "rigs")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "FORMAT.md", "exec"), {})
    recording = Recording(tmp_path / "mine.mcap")
    assert len(reestimate(recording, ["o3"])["o3"]) == 10
    rerun_check(tmp_path / "mine.mcap")


def test_a_recording_of_the_first_version_reads_and_estimates_as_it_did() -> None:
    """Kept as it was written before channels and rig stood in the file twice, and fields were added since."""
    path = ROOT / "tests" / "data" / "first-version.mcap"
    recording = Recording(path, check=True)
    assert not recording.damage
    assert len(list(recording.exposures())) == 3
    assert [each.frame_id for each in recording.estimates("o3")] == [1, 2, 3]
    assert all(each.same for each in compare(recording, Recording(path)).values())
