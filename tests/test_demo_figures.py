"""README's table of the demo's figures: what it says of the digits that hold on any processor is true."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
COLUMNS = ("RMSE start", "RMSE end", "RMSE path", "NIS", "NEES start", "NEES end")
ITERATED = ("profile", "mixture")
"""They amplify the last bit's rounding, which is another one on another processor."""

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
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return table(done.stdout)


def tolerances() -> tuple[float, float]:
    """By what share README says that figures of `profile` and `mixture` may differ: RMSE, and NIS and NEES."""
    text = " ".join(README.read_text().split())
    match = re.search(r"`profile` and `mixture` within (\d+) % \(NIS and NEES: (\d+) %\)", text)
    assert match, "README no longer says to how many digits the figures hold"
    return int(match[1]) / 100, int(match[2]) / 100


@pytest.mark.long
def test_the_demo_prints_what_readme_says(readme: Rows, printed: Rows) -> None:
    assert list(readme) == list(printed)
    of_rmse, of_squares = tolerances()
    for name, figures in readme.items():
        for column, there, here in zip(COLUMNS, figures, printed[name], strict=True):
            if there == "-":
                assert here == "-"
                continue
            digits = len(there.partition(".")[2])
            share = (of_rmse if column.startswith("RMSE") else of_squares) if name in ITERATED else 0.0
            allowed = max(share * float(there), 10.0**-digits) + 1e-9
            assert math.isclose(float(here), float(there), rel_tol=0, abs_tol=allowed), (name, column, there, here)
