"""`aolink deblur`: a picture and a PSF as files to a picture as a file."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from astropy.io import fits
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner, Result

from aolink.cli.common import app
from aolink.cli.tables.sessions import deblurred_lines
from aolink.errors import RestorationError
from aolink.films.film import array_film
from aolink.films.formats import open_film
from aolink.films.pictures import read_picture
from aolink.recording.deblur import RestoredCounts
from aolink.restoration import restore
from aolink.restoration.films import write_pictures
from aolink.restoration.texts import read_psf
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


def deblur(source: Path, psf: Path, out: Path, *options: str) -> Result:
    return CliRunner().invoke(app, ["deblur", str(source), "--psf", str(psf), "-o", str(out), *options])


def test_a_picture_is_deblurred(aolink: Run, tmp_path: Path, picture: np.ndarray) -> None:
    done = aolink("deblur", "in.png", "--psf", "psf.csv", "-o", "out.png")
    assert done.returncode == 0, done.stderr
    expected = restore(picture, np.full(7, 2.0))
    assert f"noise sd {expected.noise_sd:.3g}" in done.stdout
    assert (read_picture(tmp_path / "out.png", RestorationError) == expected.image).all()
    again = aolink("deblur", "in.png", "--psf", "psf.csv", "-o", "out.png")
    assert again.returncode == 10
    assert "--overwrite" in again.stderr


def test_bad_files_are_one_line(aolink: Run, tmp_path: Path, picture: np.ndarray) -> None:
    (tmp_path / "bad.csv").write_text("1, two, 3\n")
    done = aolink("deblur", "in.png", "--psf", "bad.csv", "-o", "out.png")
    assert done.returncode == 10
    assert done.stderr.count("\n") == 1
    assert "cannot be read as a PSF" in done.stderr
    assert not (tmp_path / "out.png").exists()


def test_what_is_not_a_number_is_filled_in(aolink: Run, tmp_path: Path, picture: np.ndarray) -> None:
    holed = picture.astype(np.float32)
    holed[10:13, 20:24] = np.nan
    np.save(tmp_path / "in.npy", holed)
    done = aolink("deblur", "in.npy", "--psf", "psf.csv", "-o", "out.npy")
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith(", 12 pixels that are not numbers filled in\n")
    whole = restore(picture.astype(np.float32), UNIFORM).image
    assert abs(read_picture(tmp_path / "out.npy", RestorationError) - whole).max() < 0.2 * np.ptp(whole)
    np.save(tmp_path / "in.npy", np.full_like(holed, np.nan))
    none = aolink("deblur", "in.npy", "--psf", "psf.csv", "-o", "b.npy")
    assert none.returncode == 10
    assert "2400 of the picture's 2400 pixels are not finite" in none.stderr


def test_transparency_is_no_light(tmp_path: Path, picture: np.ndarray) -> None:
    grey = (picture // 200).astype(np.uint8)
    colours = np.dstack([grey, grey[::-1], grey[:, ::-1]])
    alpha = np.random.default_rng(1).integers(0, 255, grey.shape, dtype=np.uint8)
    Image.fromarray(np.dstack([colours, alpha])).save(tmp_path / "in.png")
    (tmp_path / "psf.csv").write_text(",".join(["1"] * 7))
    out = tmp_path / "out.png"
    printed = deblur(tmp_path / "in.png", tmp_path / "psf.csv", out)
    assert printed.exit_code == 0, printed.output
    found = read_picture(out, RestorationError)
    assert (found[..., 3] == alpha).all()
    assert (found[..., :3] == restore(colours, np.ones(7)).image).all()


def test_the_inverse_says_how_it_scanned(tmp_path: Path, picture: np.ndarray) -> None:
    (tmp_path / "psf.csv").write_text("0.2 0.5 1")
    printed = deblur(tmp_path / "in.png", tmp_path / "psf.csv", tmp_path / "o.png", "--method", "inverse")
    assert printed.output.endswith(": inverse, scanned backwards\n")


def write(path: Path, picture: NDArray[Any]) -> None:
    write_pictures(path, [picture], array_film(picture, "a"))


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


def test_a_picture_is_a_psf_and_its_pedestal_is_subtracted_and_said(tmp_path: Path) -> None:
    picture = np.zeros((15, 15), np.uint16)
    picture[7, 4:11] = 900
    tifffile.imwrite(tmp_path / "a.tif", picture)
    psf, notes = read_psf(tmp_path / "a.tif")
    assert (psf == picture).all()
    assert notes == ()
    tifffile.imwrite(tmp_path / "b.tif", picture + 100)
    psf, (note,) = read_psf(tmp_path / "b.tif")
    assert "of the PSF's sum is an even ground of 100" in note
    assert (psf == picture).all()
    broad = np.exp(-np.hypot(*np.mgrid[-7:8, -7:8]) / 5)
    np.save(tmp_path / "c.npy", broad)  # its edge is no ground
    psf, notes = read_psf(tmp_path / "c.npy")
    assert notes == ()
    assert (psf == broad).all()


@pytest.mark.parametrize(("name", "content"), [("a.csv", "1 2\n3\n"), ("a.npy", "junk"), ("a.png", "junk")])
def test_files_that_hold_something_else_are_refused(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    for path in (tmp_path / name, tmp_path / f"none-{name}"):
        with pytest.raises(RestorationError, match="cannot be read as a PSF" if name != "a.png" else name):
            read_psf(path)
        with pytest.raises(RestorationError, match=name):
            read_picture(path, RestorationError)
    with pytest.raises(RestorationError, match="no folder"):
        write(tmp_path / "none" / "a.png", np.zeros((4, 4), np.uint8))


def moved(count: int, top: float, dtype: type, channels: int = 0) -> NDArray[Any]:
    """Pictures of a scene blurred along the rows, (count, rows, columns, any channels)."""
    rng = np.random.default_rng(2)
    shape = (24, 40, channels) if channels else (24, 40)
    sharp = np.repeat(np.repeat(rng.uniform(0.2, 0.8, (count, 4, 5, *shape[2:])), 6, axis=1), 8, axis=2)
    return np.rint(top * sum(np.roll(sharp, k, axis=2) for k in (-1, 0, 1)) / 3).astype(dtype)


@pytest.mark.parametrize("kind", ["stack", "white is zero", "colours", "12 bits", "FITS"])
def test_what_is_written_is_what_was_read(kind: str, tmp_path: Path) -> None:
    """Its type, channels and pictures, and its meaning of black and white."""
    channels, top = (3 if kind == "colours" else 0), 4095 if kind == "12 bits" else 60_000
    frames = moved(1 if kind in ("colours", "12 bits") else 3, top, np.uint16, channels)
    name = {"colours": "a.png", "12 bits": "a.pgm", "FITS": "a.fits"}.get(kind, "a.tif")
    if kind in ("colours", "12 bits"):
        write_pictures(tmp_path / name, [frames[0]], replace(array_film(frames, "a"), top=top if top == 4095 else None))
    elif kind == "FITS":
        fits.PrimaryHDU(frames).writeto(tmp_path / name)
    else:
        stored, meaning = (65535 - frames, "miniswhite") if kind == "white is zero" else (frames, "minisblack")
        tifffile.imwrite(tmp_path / name, stored, photometric=meaning)
    np.save(tmp_path / "psf.npy", np.ones((1, 3)))
    done = deblur(tmp_path / name, tmp_path / "psf.npy", tmp_path / f"out-{name}")
    assert done.exit_code == 0, done.output
    before, after = open_film(tmp_path / name), open_film(tmp_path / f"out-{name}")
    for field in ("count", "shape", "dtype", "top", "white_is_zero"):
        assert getattr(before, field) == getattr(after, field)
    expected = [restore(each, np.ones(3)).image for each in frames]
    np.testing.assert_array_equal(list(after.pictures()), expected)


def test_a_stack_does_not_become_one_picture(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", moved(2, 200, np.uint8))
    (tmp_path / "psf.csv").write_text("1 1 1")
    done = deblur(tmp_path / "a.npy", tmp_path / "psf.csv", tmp_path / "b.png")
    assert isinstance(done.exception, RestorationError)
    assert "holds one picture" in str(done.exception)


@pytest.mark.parametrize(("top", "dtype"), [(255, np.uint8), (1023, np.uint16), (16383, np.uint16), (65535, np.uint16)])
def test_saturated_pixels_are_left_out(top: int, dtype: type, tmp_path: Path) -> None:
    scene = np.full((40, 60), 0.02 * top)
    scene[20, 30] = 40.0 * top
    blurred = sum(np.roll(scene, k, axis=1) for k in range(-3, 4)) / 7 + np.random.default_rng(1).normal(
        0, 2e-3 * top, scene.shape
    )
    np.save(tmp_path / "a.npy", np.clip(np.rint(blurred), 0, top).astype(dtype))
    np.save(tmp_path / "psf.npy", np.ones((1, 7)))
    done = deblur(tmp_path / "a.npy", tmp_path / "psf.npy", tmp_path / "b.npy")
    assert "7 saturated pixels left out" in done.output
    assert abs(np.load(tmp_path / "b.npy")[20, :20] / top - 0.02).max() < 0.02


def test_a_motion_that_a_log_has_restores_as_its_psf_does(tmp_path: Path) -> None:
    """The log's clock is 2.5 s behind; the exposure is a part of it."""
    picture = moved(1, 200, np.float64)[0]
    t = np.linspace(0, 10, 1001)
    x = np.where(t < 4, 50.0, np.where(t < 6, 50.0 + 1.5 * (t - 5), 80.0))
    rows = "".join(f"{time - 2.5 + 1_790_000_000:.6f},{place:.6f},0\n" for time, place in zip(t, x, strict=True))
    (tmp_path / "log.csv").write_text("time,x,y\n" + rows)
    fits.PrimaryHDU(picture, fits.Header({"DATE-OBS": "2026-09-21T14:13:24", "EXPTIME": 2.0})).writeto(
        tmp_path / "a.fits"
    )
    files = [str(tmp_path / "a.fits"), "--path", str(tmp_path / "log.csv"), "-o", str(tmp_path / "b.npy")]
    done = CliRunner().invoke(app, ["deblur", *files, "--offset", "2.5"])
    assert done.exit_code == 0, done.output
    psf = np.ones(3)  # a motion of three pixels at a steady velocity
    expected = restore(picture, psf).image
    assert np.sqrt(np.mean((np.load(tmp_path / "b.npy") - expected)[:, 4:-4] ** 2)) < 0.3 * np.std(picture - expected)
    wrong = CliRunner().invoke(app, ["deblur", *files, "--overwrite", "--offset", "20"])
    assert "give the right --offset or --exposure" in str(wrong.exception)


def test_what_was_not_restored_is_not_counted() -> None:
    done = RestoredCounts(exposures=3, spots=1)
    assert deblurred_lines(done, "moments", "tv")[0].startswith("spots in 1 of 3 exposures restored")
