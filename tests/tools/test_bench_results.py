"""What tools/bench writes, and what it says has moved since."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture(scope="module")
def results() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(TOOLS))
        yield importlib.import_module("bench_rows.results")


@pytest.fixture
def result(results: Any) -> Any:
    def made(name: str, *values: float, error: str | None = None) -> Any:
        return results.Result(
            name=name, figure=f"figure {name}", ours="1 s", peer="limit 2 s", values=list(values), error=error,
            target=None if error else 1.0,
        )  # fmt: skip

    return made


def bench(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, TOOLS / "bench", *arguments]
    return subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=300, cwd=TOOLS.parent)


@pytest.mark.slow
def test_a_run_is_written_with_its_machine_and_compared_with_the_next(tmp_path: Path) -> None:
    done = bench("--short", "recording_rate", "--json", tmp_path / "a.json")
    assert done.returncode == 0, done.stderr
    written = json.loads((tmp_path / "a.json").read_text())
    assert written["short"] is True
    assert written["machine"]["python"] == sys.version.split()[0]
    assert written["machine"]["cores"] >= 1
    assert all(written["machine"]["packages"][name] for name in ("numpy", "scipy", "rerun-sdk"))
    (row,) = written["rows"]
    assert row["name"] == "recording.recording_rate"
    assert len(row["values"]) == 3
    assert row["target"] > 0
    assert row["error"] is None
    row["values"] = [1e4 * value for value in row["values"]]
    (tmp_path / "faster.json").write_text(json.dumps(written))
    again = bench("--short", "recording_rate", "--against", tmp_path / "faster.json")
    assert again.returncode == 0, again.stderr
    assert "Moved beyond its noise since faster.json" in again.stdout
    assert "times as good" in again.stdout


def test_what_moves_less_than_it_scatters_has_not_moved(results: Any, result: Any) -> None:
    before = [result("steady", 1.0, 1.01, 0.99), result("noisy", 1.0, 1.6, 0.8), result("slower", 1.0, 1.01, 0.99)]
    now = [result("steady", 1.02, 1.01, 1.03), result("noisy", 1.5, 1.4, 2.0), result("slower", 0.8, 0.81, 0.79)]
    ((figure, _, _, what),) = results.moved(before, now)
    assert figure == "figure slower"
    assert what == "0.80 times as good, noise 2 %"


def test_of_one_run_the_noise_is_not_known_and_that_is_said(results: Any, result: Any) -> None:
    ((_, _, _, what),) = results.moved([result("a", 1.0)], [result("a", 2.0)])
    assert what == "2.00 times as good (one run: noise not known)"


def test_rows_that_are_new_or_fail_now_or_failed_before_are_named(results: Any, result: Any) -> None:
    before = [result("a", 1.0, 1.0), result("b", error="OSError: no disk"), result("c", error="OSError: no disk")]
    now = [result("a", error="ValueError: no"), result("b", 1.0, 1.0), result("c", error="OSError"), result("d", 1.0)]
    said = {figure: what for figure, _, _, what in results.moved(before, now)}
    assert said == {"figure a": "fails now", "figure b": "failed before", "figure d": "is new"}


@pytest.mark.parametrize("text", ["", "[]", '{"rows": []}', '{"machine": {}, "rows": [{"nonsense": 1}]}'])
def test_a_file_of_something_else_is_one_line(tmp_path: Path, text: str) -> None:
    other = tmp_path / "other.json"
    other.write_text(text)
    done = bench("command_start", "--against", other)
    assert done.returncode == 2
    assert done.stderr == f"tools/bench: {other} is not a file that tools/bench --json has written\n"


def test_rows_that_take_minutes_are_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))
    groups = importlib.import_module("bench_rows.groups")
    assert {name for names in groups.ROWS.values() for name in names} >= groups.LONG
