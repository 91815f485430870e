"""A film costs what its size allows, reads no other file of the user, and may be shortened while it is read."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from astropy.io import fits

from aolink.errors import ImportingError
from aolink.films.formats import open_film
from tests.films.test_values import write_ser
from tests.importing import others
from tests.importing.others import numbers, refused

FRAMES = numbers(np.uint16, 4, 16, 16)


def hdf5(shape: tuple[int, ...], chunks: tuple[int, ...]) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        with h5py.File(folder / "a.h5", "w") as file:
            frames = file.create_dataset("a", shape, "<u2", chunks=chunks, compression="gzip", maxshape=(None,) * 3)
            frames[-1, -1, -1] = 1
        return folder / "a.h5"

    return write


def tiff(count: int, side: int) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        pages = (np.zeros((side, side), np.uint8) for _ in range(count))
        tifffile.imwrite(folder / "a.tif", pages, shape=(count, side, side), dtype=np.uint8, compression="zstd")
        return folder / "a.tif"

    return write


def negative(folder: Path) -> Path:
    others.write_fits(folder / "a.fits", FRAMES)
    path = folder / "a.fits"
    path.write_bytes(path.read_bytes().replace(b"NAXIS1  =                   16", b"NAXIS1  =                  -16"))
    return path


@pytest.mark.parametrize(
    "write",
    [
        hdf5((3, 20_000, 20_000), (1, 2000, 2000)),
        hdf5((10**9, 16, 16), (1, 16, 16)),
        hdf5((4, 16, 16), (1, 50_000, 20_000)),
        tiff(1, 9000),
        tiff(200, 2000),
        negative,
    ],
)  # fmt: skip
@pytest.mark.slow
def test_a_small_file_that_asks_for_much_is_refused_before_a_frame_is_read(write, tmp_path):
    path = write(tmp_path)
    with pytest.raises(ImportingError, match=r"limit|damaged"):
        open_film(path)


def external(folder: Path) -> Path:
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("a", FRAMES.shape, "<u2", external=[(str(folder / "secret"), 0, FRAMES.nbytes)])
    return folder / "a.h5"


def virtual(folder: Path) -> Path:
    with h5py.File(folder / "secret.h5", "w") as file:
        file["a"] = FRAMES
    layout = h5py.VirtualLayout(FRAMES.shape, "<u2")
    layout[:] = h5py.VirtualSource(str(folder / "secret.h5"), "a", FRAMES.shape)
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_virtual_dataset("a", layout)
    return folder / "a.h5"


def named(folder: Path) -> Path:
    """An OME-TIFF of a file in another folder."""
    inner = folder / "inner"
    inner.mkdir()
    tifffile.imwrite(inner / "a.ome.tif", FRAMES[0], metadata={"axes": "YX"})
    with tifffile.TiffFile(inner / "a.ome.tif") as file:
        ome = file.ome_metadata or ""
    data = '<TiffData IFD="0" PlaneCount="1"><UUID FileName="../secret.tif">urn:uuid:0</UUID></TiffData>'
    ome = ome[: ome.index("<TiffData")] + data + ome[ome.index("</Pixels>") :]
    tifffile.imwrite(
        inner / "a.ome.tif", FRAMES[0], description=ome.replace("<OME ", '<OME UUID="urn:uuid:1" ', 1), metadata=None
    )
    return inner / "a.ome.tif"


def listed(folder: Path) -> Path:
    """A list of films in the guise of one."""
    (folder / "a.mp4").write_text("ffconcat version 1.0\nfile secret.mkv\n")
    return folder / "a.mp4"


@pytest.mark.parametrize("write", [external, virtual, named, listed])
def test_other_files_of_the_user_are_not_read(write, tmp_path):
    (tmp_path / "secret").write_bytes(FRAMES.tobytes())
    tifffile.imwrite(tmp_path / "secret.tif", FRAMES[0])
    others.write_stream(tmp_path / "secret.mkv", FRAMES, "ffv1", "gray16le")
    refused(write(tmp_path))


@pytest.mark.parametrize("kind", ["npy", "ser", "fits", "h5"])
def test_a_film_that_is_shortened_while_it_is_read_is_one_error(kind, tmp_path):
    path, frames = tmp_path / f"a.{kind}", numbers(np.uint16, 64, 128, 128)
    if kind == "npy":
        np.save(path, frames)
    elif kind == "ser":
        write_ser(path, frames, 16, 0)
    elif kind == "fits":
        fits.PrimaryHDU(frames.astype(np.int16)).writeto(path)
    else:
        with h5py.File(path, "w") as file:
            file["frames"] = frames
    film = open_film(path).pictures()
    next(film)
    os.truncate(path, 40_000)
    with pytest.raises(ImportingError):
        list(film)
