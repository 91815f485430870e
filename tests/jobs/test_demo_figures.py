"""README's table of the demo's figures: what it says of the digits that hold on any processor is true."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).parents[2] / "README.md"
COLUMNS = ("RMSE start", "RMSE end", "RMSE path", "NIS", "NEES start", "NEES end")
ELSEWHERE = {"profile": (0.01, 0.03), "mixture": (0.01, 0.03)}
"""By what share figures may differ on processors other than x86-64, as README says: RMSE, and NIS and NEES."""

Rows = dict[str, list[str]]


def table(text: str) -> Rows:
    """Estimators with their figures as they are printed, without the mark of what is out of bounds."""
    lines = text[text.index("estimator   RMSE start") :].splitlines()[1:]
    rows: Rows = {}
    for line in lines:
        cells = line.replace("!", "").split()
        if len(cells) == 1 + len(COLUMNS):
            rows[cells[0]] = cells[1:]
        elif rows:
            break
    return rows


@pytest.fixture(scope="module")
def readme() -> Rows:
    return table(README.read_text())


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    out = tmp_path_factory.mktemp("demo")
    command = [sys.executable, "-m", "aolink", "demo", "--rig", "section-vi-lively", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stderr
    return table(done.stdout)


@pytest.mark.slow
def test_the_demo_prints_what_readme_says(readme: Rows, printed: Rows) -> None:
    """To a unit of the last digit on x86-64, whatever its vector units are."""
    assert list(readme) == list(printed)
    tried = platform.machine().lower() in ("x86_64", "amd64")
    for name, figures in readme.items():
        for column, there, here in zip(COLUMNS, figures, printed[name], strict=True):
            if there == "-":
                assert here == "-"
                continue
            of_rmse, of_squares = (0.0, 0.0) if tried else ELSEWHERE.get(name, (0.0, 0.0))
            share = of_rmse if column.startswith("RMSE") else of_squares
            unit = 10.0 ** -len(there.partition(".")[2])
            allowed = max(share * float(there), unit) + 1e-9
            assert abs(float(here) - float(there)) <= allowed, (name, column, there, here)


def test_the_readme_says_how_near_its_figures_are() -> None:
    text = " ".join(README.read_text().split())
    assert "on x86-64 your figures agree with these to one unit of the last digit" in text
    assert "allow `profile` and `mixture` 1 % (NIS and NEES 3 %)" in text
