"""`aolink import` as a process: what it writes, what it says, and how it refuses."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from aolink.recording.reader import Recording
from tests.importing import others
from tests.importing.others import KINDS, numbers
from tests.importing.rigs import small_rig

FRAMES = np.minimum(numbers(np.uint8, 7, 8, 8), 254)


@pytest.fixture
def rig(tmp_path: Path) -> str:
    """A rig file of 50 frames/s of 8 x 8 pixels."""
    (tmp_path / "rig.toml").write_text(small_rig().toml)
    return "rig.toml"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["TIFF", "pictures", "ROS 2 bag"])
def test_a_film_of_every_kind_becomes_a_recording(kind, aolink, rig, tmp_path):
    source = KINDS[kind](tmp_path, FRAMES)
    made = aolink("import", source, "-o", "session.mcap", "--rig", rig, "--rate", "50", "--exposure", "0.01")
    assert (made.returncode, made.stderr) == (0, "")
    assert made.stdout.endswith("session.mcap: 7 exposures of 7 frames\n")
    pixels = [each.pixels for each in Recording(tmp_path / "session.mcap")]
    np.testing.assert_array_equal(pixels, FRAMES.astype(int) * 256)


@pytest.mark.slow
def test_the_recording_is_one_like_any_other(aolink, rig, tmp_path):
    source = others.written_npy(tmp_path, FRAMES)
    start = ["--film", "start=2026-09-21T10:30:00.25"]
    assert aolink("import", source, "-o", "a.mcap", "--rig", rig, "--rate", "50", *start).returncode == 0
    recording = Recording(tmp_path / "a.mcap")
    assert recording.complete
    assert next(iter(recording)).host_start_ns == 1_789_986_600_250_000_000
    done = aolink("estimate", "a.mcap", "-e", "o1", "-o", "b.mcap")
    assert (done.returncode, done.stderr) == (0, "")
    assert len(Recording(tmp_path / "b.mcap").estimates("o1")) == 7


def test_notes_and_warnings_are_printed(aolink, rig, tmp_path):
    frames = FRAMES.copy()
    frames[3, :2, :2] = 255
    source = others.written_npy(tmp_path, frames)
    made = aolink("import", source, "-o", "a.mcap", "--rig", rig)
    assert made.stdout.splitlines() == [
        "note: the film does not state its frame rate: that of the rig file is assumed, 50 frames/s",
        "note: when it was taken is not known: its times count from 1970 without --film start=DATE",
        "note: whether its rows were exposed one after the other is not known: give --film row_time=S, or 0",
        "warning: 4 pixels (0.89%) are saturated in the film, hot or dead, or no numbers: they are masked",
        "a.mcap: 7 exposures of 7 frames",
    ]
    made = aolink("import", source, "-o", "b.mcap", "--rig", rig, "--film", "scale=300")
    clipped = np.count_nonzero((frames > 65_535 / 300) & (frames < 255))
    assert f"warning: {clipped} pixel" in made.stdout


def test_a_film_without_its_dark_level_is_told_of_the_option(aolink, rig, tmp_path):
    frames = np.random.default_rng(1).normal(0, 20, (7, 8, 8)).round().astype(np.int16)
    source = others.written_npy(tmp_path, frames)
    made = aolink("import", source, "-o", "a.mcap", "--rig", rig, "--rate", "50")
    assert "of the pixels are below zero" in made.stdout
    assert "--film background" in made.stdout
    made = aolink("import", source, "-o", "b.mcap", "--rig", rig, "--rate", "50", "--film", "background")
    assert "below zero" not in made.stdout


def test_missing_frames_are_counted(aolink, rig, tmp_path):
    np.savez(tmp_path / "film.npz", frames=FRAMES, times_s=np.array([0, 1, 2, 5, 6, 7, 9]) / 50)
    made = aolink("import", "film.npz", "-o", "a.mcap", "--rig", rig)
    assert made.stdout.endswith("a.mcap: 7 exposures of 7 frames, 3 frames are missing\n")


def test_frames_are_summed(aolink, tmp_path):
    (tmp_path / "rig.toml").write_text(small_rig(3, 3).toml)
    source = others.written_npy(tmp_path, FRAMES)
    made = aolink(
        "import", source, "-o", "a.mcap", "--rig", "rig.toml", "--film", "sum=3,start=2026-11-22", "--rate", "1000",
        "--film", "row_time=0",
    )  # fmt: skip
    assert made.stdout == "a.mcap: 2 exposures of 6 frames\n"
    first = next(iter(Recording(tmp_path / "a.mcap")))
    np.testing.assert_array_equal(first.pixels, np.rint(FRAMES[:3].mean(axis=0) * 256))


def test_a_window_of_a_larger_picture_is_imported(aolink, rig, tmp_path):
    wide = numbers(np.uint16, 9, 30, 40)
    source = others.written_npy(tmp_path, wide)
    made = aolink("import", source, "-o", "a.mcap", "--rig", rig, "--rate", "50", "--at", "20.4,11.5")
    assert made.returncode == 0, made.stderr
    pixels = [each.pixels for each in Recording(tmp_path / "a.mcap")]
    np.testing.assert_array_equal(pixels, wide[:, 8:16, 17:25])


def test_one_of_two_topics_is_imported(aolink, rig, tmp_path):
    topics = {name: [others.foxglove_raw(each, "mono8") for each in FRAMES] for name in ("/a", "/b")}
    source = others.write_mcap(tmp_path / "two.mcap", topics)
    refused = aolink("import", source, "-o", "a.mcap", "--rig", rig)
    assert refused.returncode == 11
    assert "say which with --film topic=NAME" in refused.stderr
    assert aolink("import", source, "-o", "a.mcap", "--rig", rig, "--film", "topic=/b").returncode == 0


@pytest.mark.slow
def test_a_target_is_replaced_only_on_request_and_never_the_source(aolink, rig, tmp_path):
    source = others.written_mcap(tmp_path, FRAMES)
    before = source.read_bytes()
    taken = aolink("import", source, "-o", source, "--rig", rig, "--overwrite")
    assert taken.returncode == 5
    assert "is what the new file is made from" in taken.stderr
    shutil.copy(source, tmp_path / "copy.mcap")
    taken = aolink("import", source, "-o", "copy.mcap", "--rig", rig)
    assert taken.returncode == 5
    assert "--overwrite" in taken.stderr
    assert (tmp_path / "copy.mcap").read_bytes() == source.read_bytes() == before
    assert aolink("import", source, "-o", "copy.mcap", "--rig", rig, "--overwrite").returncode == 0
    assert len(list(Recording(tmp_path / "copy.mcap"))) == 7


@pytest.mark.slow
def test_two_films_with_the_same_name_and_settings_are_two_sessions(aolink, rig, tmp_path):
    """The same film is the same session, and the same bytes."""
    sessions = []
    for k, frames in enumerate((FRAMES, FRAMES, FRAMES[:, ::-1])):
        others.written_npy(tmp_path, frames)
        made = aolink("import", "film.npy", "-o", f"{k}.mcap", "--rig", rig, "--rate", "50")
        assert made.returncode == 0, made.stderr
        sessions.append(Recording(tmp_path / f"{k}.mcap").metadata["session"])
    assert sessions[0] == sessions[1] != sessions[2]
    assert (tmp_path / "0.mcap").read_bytes() == (tmp_path / "1.mcap").read_bytes()


def bright(folder: Path) -> Path:
    """Floating point that is counts."""
    return others.written_npy(folder, FRAMES.astype(np.float32))


def mixed(folder: Path) -> Path:
    """Pictures of two sizes."""
    path = others.write_pictures(folder / "film", FRAMES)
    others.write_pictures(folder / "more", numbers(np.uint8, 1)).joinpath("frame5.png").rename(path / "frame99.png")
    return path


def of_words(folder: Path) -> Path:
    (folder / "film.mp4").write_text("Dear reader, this is no film.\n")
    return folder / "film.mp4"


def good(folder: Path) -> Path:
    return others.written_npy(folder, FRAMES)


def timed(folder: Path) -> Path:
    """Frames whose times and whose rate contradict each other."""
    np.savez(folder / "film.npz", frames=FRAMES, rate_hz=50, times_s=np.arange(7) / 40)
    return folder / "film.npz"


def missing(folder: Path) -> Path:
    return folder / "film.tif"


@pytest.mark.parametrize(
    ("source", "options", "code", "says"),
    [
        (missing, [], 11, "there is no such file or folder"),
        (of_words, [], 11, "film.mp4"),
        (mixed, [], 11, "frame99.png has 6 x 9 pixels of uint8, those before it have 8 x 8 pixels"),
        (timed, [], 11, "50 frames/s contradict its times, which say 40"),
        (good, ["--rate", "60"], 11, "change its [timing], or give the right --rate"),
        (bright, ["--rate", "50"], 11, "where 1.0 would be full scale: say with --film scale=COUNTS"),
        (good, ["--rate", "0"], 11, "--rate 0 must be above 0"),
        (good, ["--rate", "-25"], 11, "--rate -25 must be above 0"),
        (good, ["--rate", "50", "--film", "scale=0"], 11, "--film scale=0 must be a finite number other than 0"),
        (good, ["--rate", "50", "--film", "scale=-2"], 11, "--film scale=-2 must be above 0 for pictures"),
        (good, ["--film", "topic=/camera"], 11, "has no topics: --film topic=/camera says which"),
        (good, ["--exposure", "0"], 11, "--exposure 0 must be above 0"),
        (good, ["--exposure", "-1"], 11, "--exposure -1 must be above 0"),
        (
            good,
            ["--exposure", "0.01", "--rate", "100", "--film", "sum=2"],
            11,
            "0.01 is not used with --film sum=2",
        ),
        (good, ["--film", "start=yesterday"], 11, "--film start=yesterday is no date: give one such as"),
        (good, ["--rate", "50", "--film", "start=2500-01-01"], 11, "a start or an end that is not from 1970 to 2262"),
        (good, ["--rate", "50", "--film", "start=1600-01-01"], 11, "a start or an end that is not from 1970 to 2262"),
        (good, ["--film", "gama=2"], 11, "--film gama: there is no such option, but gamma, invert, "),
        (good, ["--film", "invert=1"], 11, "--film invert=1: write --film invert"),
        (good, ["--film", "invert,gamma"], 11, "--film gamma: write --film gamma=2.2"),
        (good, ["--film", "gamma=20"], 11, "--film gamma=20: give a number from 0.1 to 10"),
        (good, ["--film", "sum=1.5"], 11, "--film sum=1.5: give a whole number from 1"),
        (good, ["--film", "row_time=x"], 11, "20ms"),
        (good, ["--film", "colour=pink"], 11, "--film colour=pink is no colour: give red, green, blue or all"),
        (good, ["--at", "here"], 11, "--at here is no place: give X,Y in pixels"),
        (good, ["--at", "nan,3"], 11, "--at nan,3 is no place: give X,Y in pixels"),
        (good, ["--at", "3,3", "--at", "4,4"], 11, "2 places, the rig file single-lenslet has 1 spots"),
        (good, ["--at", "30,3"], 11, "the window of 8 x 8 pixels about --at 30,3 is not inside its pictures of 8 x 8"),
        (good, ["--at", "3,3", "--film", "row_time=1e-3"], 11, "leave out row_time"),
        (good, ["-o", "nowhere/a.mcap"], 5, "there is no folder nowhere; make it first"),
        (good, ["--rig", "none.toml"], 2, "none.toml"),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing(source, options, code, says, aolink, rig, tmp_path):
    path = source(tmp_path)
    refused = aolink("import", path, "-o", "a.mcap", "--rig", rig, *options)
    assert refused.returncode == code
    assert says in refused.stderr.replace("\n", " ")
    assert refused.stderr.count("\n") == 1
    assert refused.stdout == ""
    assert not list(tmp_path.rglob("*.mcap")) + list(tmp_path.rglob("*.partial"))


def test_a_start_other_than_the_films_is_noted(aolink, rig, tmp_path):
    source = others.write_fits(tmp_path / "a.fits", FRAMES, DATE_OBS="2026-09-21T10:30:00")
    made = aolink("import", source, "-o", "a.mcap", "--rig", rig, "--rate", "50", "--film", "start=2026-09-22")
    assert "starts at 2026-09-21T10:30:00.000000000; 2026-09-22T00:00:00.000000000 is taken" in made.stdout


def test_a_rate_and_a_time_may_have_units_and_the_error_names_them(aolink, rig, tmp_path):
    source = others.written_npy(tmp_path, FRAMES)
    made = aolink("import", source, "-o", "a.mcap", "--rig", rig, "--rate", "50fps", "--exposure", "1/100s")
    assert made.returncode == 0, made.stderr
    refused = aolink("import", source, "-o", "b.mcap", "--rig", rig, "--exposure", "20mm")
    assert refused.returncode == 2
    assert "20ms" in refused.stderr
