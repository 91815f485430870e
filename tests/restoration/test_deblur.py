"""`aolink deblur`: a picture and a PSF as files to a picture as a file."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner

from aolink.cli.common import app
from aolink.errors import RestorationError
from aolink.films.film import array_film
from aolink.films.pictures import read_picture, read_psf, write_pictures
from aolink.restoration import restore
from tests.restoration.scenes import UNIFORM, blocks, blurred

Run = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def picture(tmp_path: Path) -> np.ndarray:
    image, _ = blurred(blocks(40, 66, seed=2), UNIFORM, (3,))
    image = image + 0.005 * np.random.default_rng(1).standard_normal(image.shape)
    counts = np.clip(np.rint(10_000 + 20_000 * image), 0, 65535).astype(np.uint16)
    Image.fromarray(counts).save(tmp_path / "in.png")
    (tmp_path / "psf.csv").write_text(",".join(["2"] * 7) + "\n")
    return counts


def test_a_picture_is_deblurred(aolink: Run, tmp_path: Path, picture: np.ndarray) -> None:
    done = aolink("deblur", "--image", "in.png", "--psf", "psf.csv", "-o", "out.png", "--json")
    assert done.returncode == 0, done.stderr
    printed, expected = json.loads(done.stdout), restore(picture, np.full(7, 2.0))
    assert printed["noise_sd"] == pytest.approx(expected.noise_sd)
    assert (read_picture(tmp_path / "out.png", RestorationError) == expected.image).all()
    again = aolink("deblur", "--image", "in.png", "--psf", "psf.csv", "-o", "out.png")
    assert again.returncode == 10
    assert again.stderr == (
        "aolink: out.png exists and is not overwritten: give another name, or --overwrite to replace it\n"
    )


def test_bad_files_are_one_line(aolink: Run, tmp_path: Path, picture: np.ndarray) -> None:
    (tmp_path / "bad.csv").write_text("1, two, 3\n")
    done = aolink("deblur", "--image", "in.png", "--psf", "bad.csv", "-o", "out.png")
    assert done.returncode == 10
    assert done.stderr.count("\n") == 1
    assert "cannot be read as a PSF" in done.stderr
    assert not (tmp_path / "out.png").exists()


def test_what_is_not_a_number_is_filled_in(aolink: Run, tmp_path: Path, picture: np.ndarray) -> None:
    holed = picture.astype(np.float32)
    holed[10:13, 20:24] = np.nan
    np.save(tmp_path / "in.npy", holed)
    done = aolink("deblur", "--image", "in.npy", "--psf", "psf.csv", "-o", "out.npy")
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith(", 12 pixels that are not numbers filled in\n")
    whole = restore(picture.astype(np.float32), UNIFORM).image
    assert abs(read_picture(tmp_path / "out.npy", RestorationError) - whole).max() < 0.2 * np.ptp(whole)
    np.save(tmp_path / "in.npy", np.full_like(holed, np.nan))
    none = aolink("deblur", "--image", "in.npy", "--psf", "psf.csv", "-o", "b.npy")
    assert none.returncode == 10
    assert "2400 of the picture's 2400 pixels are not finite" in none.stderr


def test_transparency_is_no_light(tmp_path: Path, picture: np.ndarray) -> None:
    grey = (picture // 200).astype(np.uint8)
    colours = np.dstack([grey, grey[::-1], grey[:, ::-1]])
    alpha = np.random.default_rng(1).integers(0, 255, grey.shape, dtype=np.uint8)
    Image.fromarray(np.dstack([colours, alpha])).save(tmp_path / "in.png")
    (tmp_path / "psf.csv").write_text(",".join(["1"] * 7))
    out = tmp_path / "out.png"
    printed = CliRunner().invoke(
        app, ["deblur", "--image", str(tmp_path / "in.png"), "--psf", str(tmp_path / "psf.csv"), "-o", str(out)]
    )
    assert printed.exit_code == 0, printed.output
    found = read_picture(out, RestorationError)
    assert (found[..., 3] == alpha).all()
    assert (found[..., :3] == restore(colours, np.ones(7)).image).all()


def test_the_inverse_says_how_it_scanned(tmp_path: Path, picture: np.ndarray) -> None:
    (tmp_path / "psf.csv").write_text("0.2 0.5 1")
    files = ["--image", str(tmp_path / "in.png"), "--psf", str(tmp_path / "psf.csv")]
    printed = CliRunner().invoke(app, ["deblur", *files, "-o", str(tmp_path / "o.png"), "--method", "inverse"])
    assert printed.output.endswith(": inverse, scanned backwards\n")


def write(path: Path, picture: NDArray[Any]) -> None:
    write_pictures(path, [picture], array_film(picture, "a"))


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(RestorationError, match=r"there is no folder .*none; make it first"):
        write(tmp_path / "none" / "a.png", np.zeros((4, 4), np.uint8))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("suffix", [".png", ".tif", ".npy"])
def test_what_is_written_is_read_back(tmp_path: Path, dtype: type, suffix: str) -> None:
    image: np.ndarray = np.random.default_rng(1).integers(0, 250, (9, 11)).astype(dtype)
    path = tmp_path / f"a{suffix}"
    if dtype is np.float32 and suffix == ".png":
        with pytest.raises(RestorationError, match=r"type float32 fits in a \.npy"):
            write(path, image)
        return
    write(path, image)
    assert read_picture(path, RestorationError).dtype == dtype
    assert (read_picture(path, RestorationError) == image).all()


def test_colours_and_palettes_are_read_as_colours(tmp_path: Path) -> None:
    colours = np.random.default_rng(1).integers(0, 255, (6, 7, 3), dtype=np.uint8)
    write(tmp_path / "a.png", colours)
    assert (read_picture(tmp_path / "a.png", RestorationError) == colours).all()
    Image.fromarray(colours).convert("P").save(tmp_path / "p.png")
    assert read_picture(tmp_path / "p.png", RestorationError).shape == (6, 7, 3)


@pytest.mark.parametrize(
    ("text", "psf"),
    [("1,2,3", [1, 2, 3]), (" 1 2  3\n", [1, 2, 3]), ("1\n2\n3\n", [[1], [2], [3]]), ("0 1\n2 3\n", [[0, 1], [2, 3]])],
)
def test_a_column_of_text_is_a_psf_along_the_columns(text: str, psf: list[Any], tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    assert read_psf(tmp_path / "a.csv")[0].tolist() == psf
    np.save(tmp_path / "a.npy", np.array(psf))
    assert read_psf(tmp_path / "a.npy")[0].tolist() == psf


def test_a_picture_is_a_psf_and_its_pedestal_is_said(tmp_path: Path) -> None:
    picture = np.zeros((15, 15), np.uint16)
    picture[7, 4:11] = 900
    tifffile.imwrite(tmp_path / "a.tif", picture)
    psf, notes = read_psf(tmp_path / "a.tif")
    assert (psf == picture).all()
    assert notes == ()
    tifffile.imwrite(tmp_path / "b.tif", picture + 100)
    assert "of the PSF's sum is an even ground of 100" in read_psf(tmp_path / "b.tif")[1][0]


@pytest.mark.parametrize(("name", "content"), [("a.csv", "1 2\n3\n"), ("a.npy", "junk"), ("a.csv", None)])
def test_a_file_that_is_no_psf_is_refused(tmp_path: Path, name: str, content: str | None) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(RestorationError, match="cannot be read as a PSF"):
        read_psf(tmp_path / name)


@pytest.mark.parametrize("name", ["a.png", "a.npy"])
def test_a_file_that_is_no_picture_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("junk")
    with pytest.raises(RestorationError, match=name):
        read_picture(tmp_path / name, RestorationError)
