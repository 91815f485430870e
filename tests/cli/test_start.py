"""What a command loads before it begins: no more than it uses, for everything else is time that somebody waits."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = {"filterpy", "matplotlib", "numba", "numpy", "pandas", "rerun", "scipy.linalg", "scipy.sparse", "scipy.special"}
SESSION = Path(__file__).parents[2] / "recordings" / "section-vi.mcap"


def loaded_by(code: str, folder: Path, *arguments: str | Path) -> set[str]:
    """Which of the heavy modules a program has loaded at its end."""
    code = f"import sys\ntry:\n    {code}\nfinally:\n    print('LOADED', *({HEAVY!r} & sys.modules.keys()))"
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], cwd=folder, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return set(done.stdout.splitlines()[-1].split()[1:])


def loaded_by_command(folder: Path, *arguments: str | Path) -> set[str]:
    return loaded_by("from aolink.__main__ import main; main()", folder, *arguments)


def test_help_and_the_package_itself_load_nothing_heavy(tmp_path: Path) -> None:
    assert loaded_by_command(tmp_path, "--help") == set()
    assert loaded_by("import aolink", tmp_path) == set()


@pytest.mark.slow
@pytest.mark.parametrize("part", [("--frame", "3"), ()])
def test_looking_at_a_recording_that_holds_its_estimates_loads_rerun_and_no_estimator(
    tmp_path: Path, part: tuple[str, ...]
) -> None:
    loaded = loaded_by_command(tmp_path, "view", SESSION, *part, "-o", "part.rrd")
    assert loaded - {"pandas"} == {"numpy", "rerun"}  # pyarrow looks for pandas with the first array that it makes
    assert (tmp_path / "part.rrd").stat().st_size > 100_000


@pytest.mark.slow
def test_what_a_recording_holds_is_told_without_scipy(tmp_path: Path) -> None:
    assert loaded_by_command(tmp_path, "info", SESSION) == {"numpy"}
