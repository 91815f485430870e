"""The report: what is on the page, of good recordings and of bad ones; and the command."""

from __future__ import annotations

import base64
import re
import subprocess
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

import aolink
from aolink.plotting import save_figure, write_report
from aolink.recording.reader import Recording
from aolink.recording.reestimate import scored
from aolink.rig import load_rig
from aolink.session import record
from tests.commands import simulated_rig
from tests.needs import needed
from tests.recording.small import write_small

needed("matplotlib")

RECORDINGS = Path(__file__).parents[2] / "recordings"
Aolink = Callable[..., subprocess.CompletedProcess[str]]


class Page(HTMLParser):
    """A page's texts, pictures and tags; and whether every tag that was opened was closed."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.open: list[str] = []
        self.sources: list[str] = []
        self.captions: list[str] = []
        self.text = ""
        self.feed(path.read_text(encoding="utf-8"))
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in ("img", "meta"):
            self.open.append(tag)
        for name, value in attrs:
            if name in ("src", "href"):
                self.sources.append(value or "")
            if name == "alt":
                self.captions.append(value or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data + "\n"


def page_of(recording: Recording, folder: Path) -> Page:
    return Page(write_report(recording, folder / "report.html"))


@pytest.mark.slow
def test_a_page_stands_alone_and_has_the_session_the_scores_and_three_figures(tmp_path: Path) -> None:
    recording = aolink.read(RECORDINGS / "section-vi-lively.mcap")
    page = page_of(recording, tmp_path)
    assert not {"script", "link", "iframe", "a"} & set(page.tags)
    assert len(page.sources) == 3
    for source in page.sources:
        kind, _, data = source.partition(",")
        assert kind == "data:image/svg+xml;base64"
        picture = base64.b64decode(data)
        assert ElementTree.fromstring(picture).tag.endswith("svg")
        assert b"<script" not in picture
    moved = [np.std(each.truth.path) for each in recording if each.truth is not None]
    assert page.captions[0].startswith(f"Exposure {np.argmax(moved)} ")
    for name, score in scored(recording, recording.estimators).items():
        assert re.search(rf"\n{name}\n.*?\n{score.path_rmse:.4f}\n", page.text, re.DOTALL)
    assert "virtual time" in page.text  # why there are no latencies
    assert recording.rig.toml in page.text


@pytest.mark.slow
def test_a_live_session_has_latencies(tmp_path: Path) -> None:
    with simulated_rig("section-vi-lively", "--real-time") as ports:
        record(load_rig("section-vi-lively"), *ports, tmp_path / "live.mcap", estimators=["o3"], exposures=4)
    assert "frame complete" in drawn_text(page_of(aolink.read(tmp_path / "live.mcap"), tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: write_small(path, 0), ["no exposure", "no estimates", "no commands"]),
        (lambda path: write_small(path, 1), ["no estimates", "truth is not known", "nothing was lost"]),
        (lambda path: write_small(path, 3, applied=False), ["no reports of the mirror"]),
        (lambda path: write_small(path, 2, "nothing", missing=True), ["frames incomplete", "no estimates"]),
        (lambda path: write_small(path, 2, rig="moving-scene"), ["were not restored"]),
    ],
    ids=["empty", "one frame", "no reports", "dark", "no scene"],
)
def test_a_poor_recording_shows_what_there_is_and_says_what_there_is_not(
    tmp_path: Path, make: Callable[[Path], Path], said: list[str]
) -> None:
    page = page_of(aolink.read(make(tmp_path / "poor.mcap")), tmp_path)
    text = page.text + drawn_text(page)
    assert [each for each in said if each not in text] == []


def drawn_text(page: Page) -> str:
    """The comments of the pictures, in which matplotlib puts what it writes."""
    return "".join(base64.b64decode(each.partition(",")[2]).decode() for each in page.sources)


@pytest.mark.slow
def test_a_recording_that_was_cut_off_says_so(tmp_path: Path) -> None:
    whole = (RECORDINGS / "section-vi-lively.mcap").read_bytes()
    (tmp_path / "broken.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    assert "It is damaged" in page_of(aolink.read(tmp_path / "broken.mcap"), tmp_path).text


@pytest.mark.slow
def test_the_command_writes_its_file_or_says_what_is_wrong(aolink: Aolink, tmp_path: Path) -> None:
    source = RECORDINGS / "tip-tilt.mcap"
    done = aolink("report", source, "-o", "report.html")
    assert (done.returncode, done.stdout) == (0, "written: report.html\n"), done.stderr
    figure = ("report", source, "-o", "x.png", "--figure")
    for arguments, code, text in (
        (("report", source, "-o", "report.html"), 12, "overwritten"),
        (("report", source, "-o", "x.pdf"), 12, ".html"),
        (("report", source, "--figure", "exposure", "-o", "x.jpg"), 12, ".svg"),
        (("report", source, "--frame", "1", "-o", "x.html"), 2, "--figure"),
        ((*figure, "moon"), 2, "moon"),
        ((*figure, "pupil"), 12, "lenslets"),
        ((*figure, "exposure", "--lenslet", "1,0"), 2, "1 x 1"),
        ((*figure, "exposure", "--frame", "99"), 12, "exposure 99"),
    ):
        failed = aolink(*arguments)
        assert failed.returncode == code, (arguments, failed.stderr)
        assert text in failed.stderr
        assert not list(tmp_path.glob("x.*"))


@pytest.mark.slow
def test_every_figure_is_a_file_of_its_size(tmp_path: Path) -> None:
    for what, name in (("exposure", "section-vi-lively"), ("exposure", "tip-tilt"), ("scene", "moving-scene")):
        path = save_figure(
            aolink.read(RECORDINGS / f"{name}.mcap"), what, tmp_path / f"{name}.png", estimators=["o3"], width_mm=88
        )
        with Image.open(path) as picture:
            assert picture.width == pytest.approx(88 / 25.4 * 300, abs=1)


@pytest.mark.slow
def test_a_figure_is_a_vector_graphic_too_and_the_same_each_time(tmp_path: Path) -> None:
    small = Recording(write_small(tmp_path / "small.mcap", 2, rig="single-lenslet", truth=True))
    for ending, begins in ((".svg", b"<?xml"), (".pdf", b"%PDF")):
        first, again = (save_figure(small, "exposure", tmp_path / f"{k}{ending}").read_bytes() for k in (1, 2))
        assert first.startswith(begins)
        assert first == again
