"""Recordings that lack something, or have much of it: each opens in the viewer and in every figure, shows what there
is, and says what there is not.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import ExportError, ViewerError
from aolink.plotting import FIGURES, save_figure, write_report
from aolink.recording.editing import cut, merge
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.viewing import save_rrd
from tests.needs import needed
from tests.recording.small import write_small
from tests.viewing.rrd import Entities, read_rrd
from tests.viewing.test_save import absent_from_views

needed("matplotlib")

ROOT = Path(__file__).parents[2]
LENSLETS = 50
"""In a row of the largest grid."""


def with_a_gap(path: Path) -> Path:
    """Exposures 0 to 4 and 12 to 19 of a recorded session: frames in between are not there."""
    session = ROOT / "recordings" / "section-vi-lively.mcap"
    parts = [path.with_name("first.mcap"), path.with_name("last.mcap")]
    for part, (start, end) in zip(parts, ((0.0, 1.0), (2.4, 9.0)), strict=True):
        cut(session, part, start, end)
    merge(parts, path)
    return path


def with_many_lenslets(path: Path) -> Path:
    """Two exposures of 2500 spots."""
    text = load_rig("sh-30x30").toml
    text = text.replace("axes = 1800", f"axes = {2 * LENSLETS**2}").replace(
        "grid = [30, 30]", f"grid = [{LENSLETS}, {LENSLETS}]"
    )
    (rig := path.with_suffix(".toml")).write_text(text.replace("window = [16, 16]", "window = [8, 8]"))
    return write_small(path, 2, rig=str(rig))


CASES: dict[str, tuple[Callable[[Path], object], list[str], list[str]]] = {
    "bare": (
        lambda path: write_small(path, 3, applied=False),
        ["/camera/image", "/profile/measured", "/status/exposure"],
        ["no estimates", "truth is not known", "no commands", "no latencies"],
    ),
    "one frame": (
        lambda path: write_small(path, 1, truth=True),
        ["/camera/history", "/path/truth", "/mirror/applied"],
        ["1 exposure of", "no estimates"],
    ),
    "a gap": (
        with_a_gap,
        ["/path/o3/mean", "/warnings", "/nis/o3/value"],
        ["frames lost"],
    ),
    "2500 lenslets": (
        with_many_lenslets,
        ["/camera/image", "/pupil/light", "/pupil/slope_x"],
        ["no estimates"],
    ),
}  # fmt: skip
"""What makes a recording, entities that it has, and words that its page says."""


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Recording]:
    path = tmp_path_factory.mktemp("poor") / "poor.mcap"
    CASES[request.param][0](path)
    return request.param, Recording(path)


def page_of(entities: Entities) -> str:
    """What the session's page says."""
    ((text,),) = [each for each in entities["/session"]["TextDocument:text"] if each is not None]
    return str(text)


@pytest.mark.slow
def test_the_viewer_shows_what_there_is_and_its_page_says_what_there_is_not(
    case: tuple[str, Recording], tmp_path: Path
) -> None:
    name, recording = case
    path = save_rrd(recording, tmp_path / "poor.rrd")
    entities = read_rrd(path)
    _, there, said = CASES[name]
    assert [each for each in there if each not in entities] == []
    assert [words for words in said if words not in page_of(entities)] == []
    assert len(entities["/camera/image"]["Image:buffer"]) == len(recording)
    assert absent_from_views(path) == []


@pytest.mark.slow
def test_every_figure_is_drawn_or_says_what_it_needs(case: tuple[str, Recording], tmp_path: Path) -> None:
    name, recording = case
    refused = {}
    for what in FIGURES:
        try:
            save_figure(recording, what, tmp_path / f"{what}.png")
        except ExportError as error:
            refused[what] = str(error)
            assert not (tmp_path / f"{what}.png").exists()
    assert "exposure" not in refused
    for what, why in refused.items():
        assert str(recording.path) in why, what
    if name in ("a gap", "2500 lenslets"):  # the others are in tests/plotting/test_report.py
        write_report(recording, tmp_path / "report.html")
        assert (tmp_path / "report.html").stat().st_size > 10_000


def test_frames_that_are_not_there_break_the_lines_and_are_named(tmp_path: Path) -> None:
    recording = Recording(with_a_gap(tmp_path / "gap.mcap"))
    entities = read_rrd(save_rrd(recording, tmp_path / "gap.rrd"))
    frames = [exposure.frame_id for exposure in recording]
    lost = frames[-1] - frames[0] + 1 - len(frames)
    assert lost > 3
    (warning,) = [text for (text,) in entities["/warnings"]["TextLog:text"] if "lost" in text]
    assert warning.startswith(f"{lost} frames lost")
    assert np.isnan(np.array(entities["/path/o3/mean"]["Scalars:scalars"])).sum() == 1
    states = [state for (state,) in entities["/status/exposure"]["StateChange:state"]]
    assert states.count("LOST") == 1


def test_a_recording_without_exposures_says_so(tmp_path: Path) -> None:
    write_small(tmp_path / "empty.mcap", 0)
    with pytest.raises(ViewerError, match=r"no exposure in .*empty\.mcap"):
        save_rrd(Recording(tmp_path / "empty.mcap"), tmp_path / "empty.rrd")
    assert not (tmp_path / "empty.rrd").exists()
