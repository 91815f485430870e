"""Every program in tools/ does its work, short and beside the repository, whose files stay as they are."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from aolink.recording.reader import Recording
from tests.needs import needed

Image = needed("PIL.Image")

TOOLS = Path(__file__).parents[2] / "tools"
ROOT = TOOLS.parent


def run(*command: str | Path, environment: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    arguments = [sys.executable, *map(str, command)]
    return subprocess.run(arguments, capture_output=True, text=True, timeout=600, cwd=ROOT, env=environment)


def test_what_protocol_generates_is_what_is_there(tmp_path: Path) -> None:
    needed("grpc_tools")
    done = run(TOOLS / "protocol", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    made = sorted(each.relative_to(tmp_path) for each in tmp_path.rglob("*") if each.is_file())
    assert len(made) == 7
    for each in made:
        assert (tmp_path / each).read_bytes() == (ROOT / each).read_bytes(), f"run tools/protocol: {each} is old"


def test_pages_that_are_made_from_the_code_say_what_it_says() -> None:
    done = run(TOOLS / "pages", "--check")
    assert done.returncode == 0, done.stderr


def test_the_scene_is_the_one_that_is_drawn(tmp_path: Path) -> None:
    done = run(TOOLS / "scene", tmp_path / "scene.png")
    assert done.returncode == 0, done.stderr
    made, there = (
        np.asarray(Image.open(each)).astype(int)
        for each in (tmp_path / "scene.png", ROOT / "aolink" / "rigs" / "moving-scene.png")
    )
    assert made.shape == there.shape
    # Another release of Pillow may draw a stroke's edge a little otherwise.
    assert np.abs(made - there).mean() < 0.5


@pytest.mark.rare
def test_the_reference_recordings_can_be_made_anew(tmp_path: Path) -> None:
    done = run(TOOLS / "recordings", "--out", tmp_path, "--exposures", "2")
    assert done.returncode == 0, done.stderr
    assert {each.name for each in tmp_path.iterdir()} == {each.name for each in (ROOT / "recordings").glob("*.mcap")}
    for each in tmp_path.iterdir():
        recording, there = Recording(each), Recording(ROOT / "recordings" / each.name)
        assert recording.complete
        assert recording.counts["/camera/image"] == 2
        assert recording.estimators == there.estimators


@pytest.mark.slow
def test_hostile_inputs_find_nothing() -> None:
    done = run(TOOLS / "fuzz", "--count", "20")
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert [line.split(":")[0] for line in lines] == ["packets", "to-host", "to-device", "files"]
    assert all("20 inputs" in line for line in lines)


# The benchmark


@pytest.mark.slow
def test_a_row_whose_peer_is_missing_says_so_and_the_others_go_on() -> None:
    code = (
        "import runpy, sys; sys.modules['skimage'] = None;"
        " sys.argv = ['bench', '--short', 'o3_step', 'restoration_time', 'recording_rate'];"
        f" runpy.run_path({str(TOOLS / 'bench')!r}, run_name='__main__')"
    )
    done = run("-c", code)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    (missing,) = [line for line in lines if "restoration.restoration_time" in line]
    assert "skimage is not installed" in missing
    assert any("o3 step of 1800 axes" in line for line in lines)
    assert any("recording small messages" in line for line in lines)
    assert "Traceback" not in done.stderr


def test_a_word_that_no_row_has_is_an_error() -> None:
    done = run(TOOLS / "bench", "--short", "o3_stepp")
    assert done.returncode == 2
    assert "no figure has 'o3_stepp' in its name" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["method", *(pytest.param(each, marks=pytest.mark.rare) for each in ("demo", "scene", "pupil", "loop"))]
)
def test_pictures_are_made(name: str, tmp_path: Path) -> None:
    done = run(TOOLS / "pictures", name, "--short", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    with Image.open(tmp_path / f"{name}.png") as picture:
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 50


def test_links_of_the_pages_lead_somewhere() -> None:
    pages = [
        *ROOT.glob("*.md"),
        *(page for top in ("aolink", "recordings", "tools") for page in (ROOT / top).rglob("*.md")),
    ]
    for page in pages:
        for link in re.findall(r"\]\(([^)#]+)", page.read_text()):
            assert link.startswith("https://") or (page.parent / link).exists(), f"{page}: {link}"
    assert len(pages) > 10
