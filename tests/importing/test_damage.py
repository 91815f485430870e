"""Films that are damaged, cut off, or not what their names say: one error of one line each, and no hang."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from aolink.errors import ImportingError
from aolink.extensions import install_command
from aolink.films.formats import open_film
from tests.importing import others
from tests.importing.others import KINDS, ROS2, numbers, refused

# Packages that raise an error leave files to the collection of garbage.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


def parts(path: Path) -> list[Path]:
    """The files of a film, the largest first."""
    files = [each for each in path.rglob("*") if each.is_file()] if path.is_dir() else [path]
    return sorted(files, key=lambda each: -each.stat().st_size)


@pytest.mark.parametrize("kind", [*KINDS, "video", "GIF", "TIFF by LZW"])
def test_what_is_left_of_a_film_that_is_cut_off_is_refused(kind, tmp_path):
    """Whichever of its files is cut off, wherever."""
    frames = numbers(np.uint8, 7, 32, 48)
    if kind == "video":
        path = others.write_video(tmp_path / "film.mp4", np.repeat(frames[..., None], 3, axis=3))
    elif kind == "GIF":
        path = tmp_path / "film.gif"
        first, *rest = (Image.fromarray(frame) for frame in frames)
        first.save(path, save_all=True, append_images=rest, duration=40)
    elif kind == "TIFF by LZW":
        path = tmp_path / "film.tif"
        first, *rest = (Image.fromarray(frame) for frame in frames)
        first.save(path, save_all=True, append_images=rest, compression="tiff_lzw")
    else:
        path = KINDS[kind](tmp_path, frames)
    shares = (0.0, 0.5, 0.9) if kind == "video" else (0.0, 0.001, 0.1, 0.3, 0.5, 0.7, 0.9)
    for file in parts(path)[:3]:
        whole = file.read_bytes()
        for share in shares:
            file.write_bytes(whole[: int(share * len(whole))])
            refused(path)
        file.write_bytes(whole)
    assert len(list(open_film(path).frames())) == 7


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_film_gives_frames_or_one_error(kind, tmp_path):
    path = KINDS[kind](tmp_path, numbers(np.uint8))
    rng = np.random.default_rng(5)
    for file in parts(path)[:2]:
        whole = file.read_bytes()
        for k in range(12):
            damaged = bytearray(whole)
            start = int(rng.integers(len(whole))) // (1 if k % 2 else 10)  # often in the header
            damaged[start : start + 4] = rng.bytes(len(damaged[start : start + 4]))
            file.write_bytes(damaged)
            try:
                film = open_film(path)
                shapes = {each.shape for each in film.frames()}
            except ImportingError as error:
                text = str(error)
                assert "\n" not in text
            else:
                assert shapes == {film.shape}
        file.write_bytes(whole)


@pytest.mark.parametrize(
    "name", ["a.npy", "a.npz", "a.tif", "a.fits", "a.fits.gz", "a.mp4", "a.gif", "a.mcap", "a.bag"]
)  # fmt: skip
def test_a_file_that_is_not_what_its_name_says_is_refused(name, tmp_path):
    (tmp_path / name).write_text("Dear reader, this is no film.\n" * 50)
    refused(tmp_path / name)


def test_unknown_kinds_and_missing_files_are_refused(tmp_path):
    (tmp_path / "a.xlsx").write_bytes(b"PK")
    assert "give .npy" in refused(tmp_path / "a.xlsx")
    assert "there is no such file or folder" in refused(tmp_path / "nothing.npy")


BLOCKED = """
import sys
for name in sys.argv[2].split(","):
    sys.modules[name] = None
from aolink.errors import ImportingError
from aolink.films.formats import open_film
try:
    open_film(sys.argv[1])
except ImportingError as error:
    print(error)
"""


@pytest.mark.parametrize(
    ("name", "blocked", "extra"),
    [
        ("a.tif", "tifffile", "films"),
        ("a.mp4", "av", "films"),
        ("b.fits", "astropy,astropy.io", "films"),
        ("a.h5", "h5py", "films"),
        ("a.bag", "rosbags,rosbags.highlevel", "ros"),
        ("a.mcap", "rosbags,rosbags.typesys", "ros"),
        ("a.fits", "aotpy", "aot"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(name, blocked, extra, tmp_path):
    path, frames = tmp_path / name, numbers(np.uint8)
    if extra == "aot":
        others.write_aot(path, frames)
    elif name == "a.mcap":
        others.write_cdr_mcap(path, others.ros_images(ROS2, frames, "mono8"))
    else:
        path.write_bytes(b"film")
    said = subprocess.run([sys.executable, "-c", BLOCKED, path, blocked], capture_output=True, text=True, timeout=60)
    assert said.stderr == ""
    assert install_command(extra) in said.stdout
    assert said.stdout.count("\n") == 1
