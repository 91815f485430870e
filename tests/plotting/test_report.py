"""The report: what is on the page, of good recordings and of bad ones; and the commands `report` and `plot`."""

from __future__ import annotations

import base64
import re
import shutil
import subprocess
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest

import aolink
from aolink.errors import ExportError
from aolink.plotting import FIGURES, save_figure, write_report
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import record
from tests.commands import simulated_rig
from tests.needs import needed
from tests.recording.small import write_small

needed("matplotlib")

ROOT = Path(__file__).parents[2]
RECORDINGS = ROOT / "recordings"
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


def page_of(folder: Path, *names: Path | str) -> Page:
    return Page(write_report([aolink.read(name) for name in names], folder / "report.html", overwrite=True))


@pytest.mark.slow
def test_a_page_stands_alone_and_has_every_section(tmp_path: Path) -> None:
    page = page_of(tmp_path, RECORDINGS / "section-vi-lively.mcap")
    assert not {"script", "link", "iframe", "a"} & set(page.tags)
    assert all(source.startswith("data:image/svg+xml;base64,") for source in page.sources)
    for source in page.sources:
        picture = base64.b64decode(source.partition(",")[2])
        assert ElementTree.fromstring(picture).tag.endswith("svg")
        assert b"<script" not in picture
    for text in ("The session", "The estimates", "Inside the most telling exposures", "Configuration"):
        assert text in page.text
    assert any("the largest blur" in each for each in page.captions)
    assert any("moments is furthest from the truth" in each for each in page.captions)
    assert any("bounds" in each for each in page.captions)
    score = {name: each.path_rmse for name, each in scores(RECORDINGS / "section-vi-lively.mcap").items()}
    for name, value in score.items():
        assert re.search(rf"\n{name}\n.*?\n{value:.4f}\n", page.text, re.DOTALL)
    assert "virtual time" in page.text  # why there are no latencies
    assert aolink.read(RECORDINGS / "section-vi-lively.mcap").rig.toml in page.text


def scores(path: Path) -> dict[str, aolink.estimation.Score]:
    from aolink.recording.reestimate import scored

    recording = aolink.read(path)
    return scored(recording, recording.estimators)


@pytest.mark.slow
def test_two_recordings_stand_side_by_side_and_many_in_a_table(tmp_path: Path) -> None:
    four = [write_small(tmp_path / f"small-{number}.mcap", 2, truth=True) for number in range(4)]
    two = page_of(tmp_path, *four[:2])
    assert "Beside each other" in two.text
    assert sum("the largest blur" in each for each in two.captions) == 2
    many = page_of(tmp_path, *four)
    assert all(f"small-{number}.mcap" in many.text for number in range(4))
    assert len(many.sources) == 4


@pytest.mark.slow
def test_a_live_session_has_latencies(tmp_path: Path) -> None:
    rig = load_rig("section-vi-lively")
    with simulated_rig("section-vi-lively", "--real-time") as ports:
        record(rig, *ports, tmp_path / "live.mcap", estimators=["o3"], exposures=4)
    page = page_of(tmp_path, tmp_path / "live.mcap")
    assert any("how long an estimate took" in each for each in page.captions)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: write_small(path, 0), ["holds no exposure", "holds no estimates", "holds no commands"]),
        (lambda path: write_small(path, 1), ["holds no estimates", "The truth is not known", "holds no NIS"]),
        (lambda path: write_small(path, 3, applied=False), ["no reports of the mirror"]),
        (lambda path: write_small(path, 2, "nothing", missing=True), ["frames incomplete", "holds no estimates"]),
        (lambda path: write_small(path, 2, rig="sh-4x4"), ["Over the pupil", "holds no estimates"]),
        (lambda path: write_small(path, 2, rig="moving-scene"), ["were not restored"]),
    ],
    ids=["empty", "one frame", "no reports", "dark", "lenslets", "no scene"],
)
def test_a_poor_recording_shows_what_there_is_and_says_what_there_is_not(
    tmp_path: Path, make: Callable[[Path], Path], said: list[str]
) -> None:
    make(tmp_path / "poor.mcap")
    page = page_of(tmp_path, tmp_path / "poor.mcap")
    text = page.text + "\n".join(page.captions)
    for each in said:
        assert each in text or each in drawn_text(page), each


def drawn_text(page: Page) -> str:
    """The comments of the pictures, in which matplotlib puts what it writes."""
    return "".join(base64.b64decode(each.partition(",")[2]).decode() for each in page.sources)


@pytest.mark.slow
def test_a_recording_that_was_cut_off_says_so(tmp_path: Path) -> None:
    whole = (RECORDINGS / "section-vi-lively.mcap").read_bytes()
    (tmp_path / "broken.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    assert "It is damaged" in page_of(tmp_path, tmp_path / "broken.mcap").text


def test_a_report_needs_a_recording_and_never_replaces_one(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="needs a recording"):
        write_report([], tmp_path / "x.html")
    copy = shutil.copy(RECORDINGS / "section-vi.mcap", tmp_path / "a.mcap")
    with pytest.raises(ExportError, match="made from"):
        write_report([aolink.read(copy)], copy, overwrite=True)


@pytest.mark.slow
def test_the_commands_write_their_files_and_say_what_is_wrong(aolink: Aolink, tmp_path: Path) -> None:
    source = RECORDINGS / "tip-tilt.mcap"
    (tmp_path / "some").mkdir()
    write_small(tmp_path / "some" / "a.mcap", 1)
    done = aolink("report", "some", "-o", "report.html")
    assert (done.returncode, done.stdout) == (0, "written: report.html\n"), done.stderr
    assert (tmp_path / "report.html").exists()
    for arguments, code, text in (
        (("report", source, "-o", "report.html"), 12, "exists and is not overwritten"),
        (("report", source, "-o", "report.pdf"), 12, "ends with .html"),
        (("report", tmp_path, "-o", "x.html"), 5, "holds no recording"),
        (("report", source, "--figure", "exposure", "-o", "x.jpg"), 12, "a figure is a .png, .svg, .pdf file"),
        (("report", source, "--figure", "moon", "-o", "x.png"), 2, "moon"),
        (("report", source, "--figure", "pupil", "-o", "x.png"), 12, "fewer than 4 lenslets"),
        (
            ("report", source, "--figure", "exposure", "--lenslet", "1,0", "-o", "x.png"),
            2,
            "the grid has 1 x 1 lenslets",
        ),
        (("report", source, "--figure", "exposure", "--frame", "99", "-o", "x.png"), 12, "there is no exposure 99"),
    ):
        failed = aolink(*arguments)
        assert failed.returncode == code, (arguments, failed.stderr)
        assert text in failed.stderr
        assert not list(tmp_path.glob("x.*"))


@pytest.mark.slow
def test_every_figure_is_a_file_of_its_size(tmp_path: Path) -> None:
    from PIL import Image

    for what in FIGURES.keys() - {"pupil", "latency"}:
        recording = aolink.read(RECORDINGS / f"{'moving-scene' if what == 'scene' else 'section-vi-lively'}.mcap")
        path = save_figure(recording, what, tmp_path / f"{what}.png", estimators=["o3"], width_mm=88)
        with Image.open(path) as picture:
            assert picture.width == pytest.approx(88 / 25.4 * 300, abs=1)


@pytest.mark.slow
def test_a_figure_is_a_vector_graphic_too_and_the_same_each_time(aolink: Aolink, tmp_path: Path) -> None:
    small = write_small(tmp_path / "small.mcap", 2, rig="single-lenslet", truth=True)
    for ending, begins in ((".svg", b"<?xml"), (".pdf", b"%PDF")):
        done = aolink("report", small, "--figure", "exposure", "--lenslet", "0,0", "-o", f"x{ending}")
        assert (done.returncode, done.stdout) == (0, f"written: x{ending}\n"), done.stderr
        assert (tmp_path / f"x{ending}").read_bytes().startswith(begins)
    again = save_figure(Recording(small), "exposure", tmp_path / "again.pdf")
    assert again.read_bytes() == (tmp_path / "x.pdf").read_bytes()
