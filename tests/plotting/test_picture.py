"""The demo's picture of an exposure: what is in it."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise
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
    return np.asarray(np.abs(picture - colour).max(axis=2) < 25)


def panels(picture: np.ndarray, columns: tuple[float, ...]) -> list[np.ndarray]:
    """The columns of a picture, whose left edges are given as shares of its width."""
    edges = [round(share * picture.shape[1]) for share in (*columns, 1.0)]
    return [picture[:, left:right] for left, right in pairwise(edges)]


@pytest.mark.slow
def test_every_panel_shows_its_paths(tmp_path: Path) -> None:
    """The blur has the best path; the intensity profile has all; a panel for each estimator has its own and the truth,
    from the top by rank."""
    recording = Recording(LIVELY)
    left, bands = panels(pixels(draw_session(recording, tmp_path / "a.png")), (0.0, 0.5))
    blur, profile = np.array_split(left, 2)
    names = ["open-loop", "o1", "o2", "o3", "moments"]
    for part, drawn in ((blur, ["moments"]), (profile, names)):
        for name in names:
            assert (coloured(part, estimator_colour(name)).sum() > 50) == (name in drawn), name
    for k, panel in enumerate(np.array_split(bands, len(names))):
        for name in names:
            assert (coloured(panel, estimator_colour(name)).sum() > 100) == (name == names[k]), (name, names[k])
        assert coloured(panel, (0, 0, 0)).sum() > 500


@pytest.mark.slow
def test_the_scene_stands_beside_the_paths(tmp_path: Path) -> None:
    """As it came, and at rest below it, in the same greys."""
    recording = Recording(LIVELY.with_name("moving-scene.mcap"))
    scene = panels(pixels(draw_session(recording, tmp_path / "a.png")), (0.8,))[0]
    blurred, true = (part.mean(axis=2) for part in np.array_split(scene, 2))
    assert recording.true_scene is not None
    lit = float(np.mean(recording.true_scene > recording.true_scene.max() * 0.9))
    shown = [float(np.mean(grey[grey < 250] > 220)) for grey in (blurred, true)]
    assert shown[0] < 0.3 * shown[1]
    assert shown[1] == pytest.approx(lit, rel=0.5)


@pytest.mark.slow
def test_without_a_truth_and_estimates_the_blur_is_drawn_alone(tmp_path: Path) -> None:
    bare = Recording(write_small(tmp_path / "bare.mcap", 3, rig="sh-4x4"))
    left, bands = panels(pixels(draw_session(bare, tmp_path / "a.png")), (0.0, 0.5))
    assert (left.mean(axis=2) < 100).sum() > 200
    assert not any(coloured(bands, estimator_colour(name)).any() for name in ("open-loop", "o1", "moments"))


@pytest.mark.slow
def test_what_cannot_be_drawn_or_written_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="holds no exposure"):
        draw_session(Recording(write_small(tmp_path / "empty.mcap", 0)), tmp_path / "a.png")
    with pytest.raises(ExportError, match=r"cannot write .*a\.png: there is no folder"):
        draw_session(Recording(LIVELY), tmp_path / "absent" / "a.png")


@pytest.mark.slow
def test_without_matplotlib_the_demo_says_what_to_install(tmp_path: Path) -> None:
    code = "import sys; sys.modules['matplotlib'] = None; from aolink.cli import main; main()"
    command = [
        sys.executable,
        "-c",
        code,
        *["demo", "--rig", "single-lenslet", "--exposures", "4", "-o"],
        str(tmp_path),
    ]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    (line,) = [each for each in result.stdout.splitlines() if each.startswith("picture")]
    assert line.startswith("picture   none")
    assert line.endswith(install_command("plot"))
