"""The picture of a session where the viewer cannot draw: what is in it, and when the demo makes it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from aolink.colours import estimator_colour
from aolink.errors import ExportError
from aolink.extensions import install_command
from aolink.plotting import draw_session
from aolink.recording.reader import Recording
from tests.needs import needed
from tests.recording.small import write_small

needed("matplotlib")

LIVELY = Path(__file__).parents[2] / "recordings" / "section-vi-lively.mcap"


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def coloured(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Where a colour is, (rows, columns)."""
    return np.asarray(np.abs(picture - colour).max(axis=2) < 12)


def parts(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The session, the inside of exposures, and the errors: from the top a share of 0.28, 0.49 and the rest."""
    rows = len(picture)
    return picture[: int(0.28 * rows)], picture[int(0.28 * rows) : int(0.77 * rows)], picture[int(0.77 * rows) :]


def test_every_part_shows_its_estimators(tmp_path: Path) -> None:
    """The session has the best estimator's path, the exposures also that of o1, the errors have all."""
    session, inside, errors = parts(pixels(draw_session(Recording(LIVELY), tmp_path / "a.png")))
    for part, names in ((session, ["moments"]), (inside, ["o1", "moments"]), (errors, ["open-loop", "o1", "o3"])):
        for name in names:
            assert coloured(part, estimator_colour(name)).sum() > 200, name
    assert coloured(session, estimator_colour("o1")).sum() == 0


@pytest.mark.slow
def test_without_a_truth_and_estimates_the_blur_is_drawn_and_errors_are_not(tmp_path: Path) -> None:
    bare = Recording(write_small(tmp_path / "bare.mcap", 3, rig="sh-4x4"))
    session, _, errors = parts(pixels(draw_session(bare, tmp_path / "a.png")))
    assert (session.mean(axis=2) < 100).sum() > 200
    assert coloured(errors, estimator_colour("o3")).sum() == 0


def test_what_cannot_be_drawn_or_written_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="holds no exposure"):
        draw_session(Recording(write_small(tmp_path / "empty.mcap", 0)), tmp_path / "a.png")
    with pytest.raises(ExportError, match=r"cannot write .*a\.png: there is no folder"):
        draw_session(Recording(LIVELY), tmp_path / "absent" / "a.png")


@pytest.mark.slow
@pytest.mark.usefixtures("without_vulkan")
def test_the_demo_draws_it_and_names_the_package(
    aolink: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    result = aolink("demo", "--rig", "single-lenslet", "--exposures", "4", "--out", tmp_path)
    assert result.returncode == 0, result.stderr
    (folder,) = tmp_path.glob("demo-*")
    (line,) = [each for each in result.stdout.splitlines() if each.startswith("picture")]
    assert line == (
        f"picture   {folder / 'session.png'}, drawn with matplotlib: this machine has no Vulkan driver, which the"
        " Rerun viewer needs to draw; on Debian: apt-get install mesa-vulkan-drivers"
    )
    assert coloured(pixels(folder / "session.png"), estimator_colour("moments")).sum() > 200


@pytest.mark.slow
@pytest.mark.usefixtures("without_vulkan")
def test_without_matplotlib_the_demo_says_what_to_install(tmp_path: Path) -> None:
    code = "import sys; sys.modules['matplotlib'] = None; from aolink.cli import main; main()"
    command = [
        sys.executable,
        "-c",
        code,
        "demo",
        "--rig",
        "single-lenslet",
        "--exposures",
        "4",
        "--out",
        str(tmp_path),
    ]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    (line,) = [each for each in result.stdout.splitlines() if each.startswith("picture")]
    assert line.startswith("picture   none: this machine has no Vulkan driver")
    assert line.endswith(f"a picture without the viewer needs matplotlib: {install_command('plot')}")
