"""Every command on recordings with few exposures, with dark ones, with none: it works, or says why it cannot."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from aolink.cli.common import app
from aolink.errors import AolinkError, EstimatorError, RecordingError, ViewerError
from aolink.recording.reader import Recording
from aolink.recording.reestimate import scored_anew
from tests.recording.small import write_small

Run = Callable[..., subprocess.CompletedProcess[str]]
SMALL: dict[str, dict[str, Any]] = {
    "one": {"exposures": 1},
    "two": {"exposures": 2},
    "with truth": {"exposures": 2, "truth": True},
    "without reports": {"exposures": 2, "applied": False},
    "zeros": {"exposures": 3, "pixels": "nothing"},
    "black": {"exposures": 3, "pixels": "black"},
    "below black": {"exposures": 3, "pixels": "below black"},
    "saturated": {"exposures": 3, "pixels": "full"},
    "missing": {"exposures": 3, "missing": True},
    "spots, black": {"exposures": 2, "pixels": "black", "rig": "sh-4x4"},
    "spots, missing": {"exposures": 2, "missing": True, "rig": "sh-4x4", "truth": True},
}
MEASURED = {"one", "two", "with truth", "without reports"}


def ran(*arguments: str | Path) -> tuple[str, AolinkError | None]:
    """What a command printed, and the error that it ended with."""
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    if result.exception is None or isinstance(result.exception, AolinkError):
        return result.output, result.exception
    raise result.exception


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", SMALL)
def test_a_small_recording_is_viewed_and_estimated(name: str, tmp_path: Path) -> None:
    path = write_small(tmp_path / "s.mcap", **SMALL[name])
    ran("view", path, "-o", tmp_path / "s.rrd")
    assert (tmp_path / "s.rrd").stat().st_size > 10_000
    for arguments in (["estimate"], ["replay"]):
        output, error = ran(*arguments, path, "-e", "o3", "-e", "open-loop")
        if name in MEASURED:
            assert error is None
            assert "o3: " not in output
        else:
            assert isinstance(error, EstimatorError)
            number = SMALL[name]["exposures"]
            assert f"none of {number} exposures" in str(error)
            assert f"o3: {number} of {number} exposures input invalid: " in output
    assert ran("estimate", path, "-e", "open-loop")[1] is None, "it does not look, so there is nothing to complain of"


@pytest.mark.slow
def test_a_recording_without_estimates_gets_the_default_ones(aolink: Run, tmp_path: Path) -> None:
    write_small(tmp_path / "s.mcap", 3)
    for command in ("estimate", "replay"):
        found = json.loads(aolink(command, "s.mcap", "--json").stdout)
        assert found.keys() == {"moments"}
    assert aolink("estimate", "s.mcap", "-o", "out/").returncode == 0
    assert [each.name for each in (tmp_path / "out").glob("*.mcap")] == ["s.moments.mcap"]
    assert aolink("estimate", "s.mcap", "-e", "o1", "-o", "with.mcap").returncode == 0
    again = json.loads(aolink("estimate", "with.mcap", "--json").stdout)
    assert again.keys() == {"o1"}


@pytest.mark.slow
def test_the_reason_is_in_the_table_in_info_and_in_json(aolink: Run, tmp_path: Path) -> None:
    """Once for all exposures that have it, with what differs in it from the first."""
    write_small(tmp_path / "dark.mcap", 3, "below black")
    result = aolink("estimate", "dark.mcap", "-e", "o3", "-o", "out.mcap")
    assert result.returncode == 6
    assert result.stdout.count("no spot: the brightest stretch is") == 1
    assert "(frame 1, the first)" in result.stdout
    assert result.stderr.startswith("aolink: dark.mcap: o3 only predicted: none of 3 exposures gave")
    printed = " ".join(aolink("info", "out.mcap").stdout.split())
    assert "o3: 3 of 3 exposures input invalid: no spot" in printed
    (unused,) = json.loads(aolink("info", "out.mcap", "--json").stdout)["estimates"]["o3"]["unused"]
    assert (unused["exposures"], unused["status"], unused["first_frame"]) == (3, "INPUT_INVALID", 1)
    again = json.loads(aolink("estimate", "out.mcap", "--json").stdout)["o3"]
    assert again["unused"] == [unused]
    assert (again["estimated"], again["measured"]) == (3, 0)


@pytest.mark.slow
def test_a_batch_in_which_nothing_was_measured_is_no_success(aolink: Run, tmp_path: Path) -> None:
    write_small(tmp_path / "dark.mcap", 2, "black")
    write_small(tmp_path / "lit.mcap", 2)
    for _ in range(2):  # the second time from what was kept of the first
        result = aolink("estimate", "dark.mcap", "lit.mcap", "-e", "o3", "-o", "out/")
        assert result.returncode == 6
        (line,) = result.stderr.splitlines()
        assert line.startswith("aolink: warning: dark.mcap: o3 only predicted: none of 2 exposures gave")


def test_without_truth_there_is_a_nis_all_the_same(tmp_path: Path) -> None:
    """A camera in a laboratory knows no truth; whether a filter believes itself rightly shows without it."""
    scores = []
    for truth in (True, False):
        recording = Recording(write_small(tmp_path / f"{truth}.mcap", 6, truth=truth))
        found = scored_anew(recording, ["o3"])
        scores.append(found["o3"])
    assert scores[0].nis == scores[1].nis
    assert scores[1].nis.mean > 0
    assert (scores[0].exposures, scores[1].exposures) == (6, 0)


@pytest.mark.parametrize("command", ["estimate", "replay", "deblur", "view"])
def test_no_exposure_is_one_clear_error_and_leaves_nothing(command: str, tmp_path: Path) -> None:
    path = write_small(tmp_path / "none.mcap", 0)
    out = tmp_path / ("out.rrd" if command == "view" else "out.mcap")
    _, error = ran(command, path) if command == "replay" else ran(command, path, "-o", out)
    assert isinstance(error, RecordingError | ViewerError)
    assert " no exposure" in str(error)
    assert list(tmp_path.iterdir()) == [path]


def test_frames_of_another_camera_are_one_clear_error(tmp_path: Path) -> None:
    path = write_small(tmp_path / "wide.mcap", 2, "black", shape=(1, 30))
    said, error = ran("view", path, "-o", tmp_path / "s.rrd")
    assert isinstance(error, ViewerError)
    assert "there is no exposure in" in str(error)
    assert "1 x 40 pixels" in said


def test_info_has_date_and_units_and_json_has_numbers(aolink: Run, tmp_path: Path) -> None:
    write_small(tmp_path / "s.mcap", 6)
    printed = aolink("info", "s.mcap").stdout
    assert "2023-11-14 22:13:20 UTC" in printed
    assert "UTC, 1 s" in printed
    assert " kB " in printed
    facts = json.loads(aolink("info", "s.mcap", "--json").stdout)
    assert facts["start_ns"] == 1_700_000_000_000_000_000
    assert facts["start_utc"] == "2023-11-14T22:13:20+00:00"
    assert facts["duration_s"] == 1.0
    assert facts["bytes"] == (tmp_path / "s.mcap").stat().st_size


def test_info_prints_what_the_session_said(tmp_path: Path) -> None:
    path = Path(__file__).parents[2] / "recordings" / "section-vi.mcap"
    text, error = ran("info", path, "--log")
    assert error is None
    first, last = text.splitlines()
    assert "INFO     session of 20 exposures" in first
    assert last.endswith("session complete: 20 exposures")
    (entry, _) = map(json.loads, ran("info", path, "--log", "--json")[0].splitlines())
    assert entry["level"] == "INFO"
    assert ran("info", write_small(tmp_path / "a.mcap", 1), "--log") == ("", None)
