"""Frames from files: FITS against astropy, and files that are none."""

import gzip
import warnings
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st

from aolink.errors import FrameError
from aolink.optics.frame_file import fits_arrays, parse_fits, read_frame


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "int32", "int64", "float32", "float64"])
@pytest.mark.parametrize("suffix", [".fits", ".fits.gz"])
def test_every_type_reads_as_another_library_wrote_it(tmp_path, dtype, suffix):
    picture = np.random.default_rng(1).integers(0, 200, (7, 1301)).astype(dtype)
    if dtype == "uint16":
        picture[0, 0] = 65535  # written with BZERO
    path = tmp_path / f"frame{suffix}"
    fits.writeto(path, picture)
    np.testing.assert_array_equal(read_frame(path), picture)


def test_real_frames_read_as_another_library_reads_them(mmirs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its header has keywords in lower case
        expected = fits.getdata(mmirs / "mmirs_wfs_0150.fits.gz")
    np.testing.assert_array_equal(read_frame(mmirs / "mmirs_wfs_0150.fits.gz"), expected)


def test_numpys_own_files_are_read(tmp_path):
    np.save(tmp_path / "a.npy", np.eye(3, dtype=np.uint16))
    np.testing.assert_array_equal(read_frame(tmp_path / "a.npy"), np.eye(3))


def whole() -> bytes:
    cards = ["SIMPLE  =                    T", "BITPIX  =                   16", "NAXIS   =                    2",
             "NAXIS1  =                   30", "NAXIS2  =                   20", "END"]  # fmt: skip
    return "".join(card.ljust(80) for card in cards).ljust(2880).encode() + bytes(2880)


@given(cut=st.integers(0, 2880 + 1199), flips=st.lists(st.integers(0, 479), max_size=6))
@settings(max_examples=200)
def test_a_damaged_file_is_an_error_or_a_picture_and_nothing_else(cut, flips):
    data = bytearray(whole())
    for place in flips:
        data[place] ^= 0x55
    try:
        picture = parse_fits(bytes(data))
    except FrameError:
        pass
    else:
        assert picture.ndim == 2
    with pytest.raises(FrameError):
        parse_fits(whole()[:cut])


def test_bad_files_say_what_is_wrong(tmp_path):
    cases = {
        "text.fits": (b"hello", "not a FITS file"),
        "cut.fits.gz": (gzip.compress(whole())[:50], "damaged or no picture"),
        "cube.fits": (
            whole().replace(b"NAXIS   =                    2", b"NAXIS   =                    1"),
            "two axes",
        ),
        "bad.npy": (b"x", "damaged or no picture"),
    }
    for name, (data, says) in cases.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(FrameError, match=says):
            read_frame(tmp_path / name)
    with pytest.raises(FrameError, match="no such file"):
        read_frame(tmp_path / "none.fits")
    np.save(tmp_path / "cube.npy", np.zeros((2, 2, 2)))
    with pytest.raises(FrameError, match="rows and columns"):
        read_frame(tmp_path / "cube.npy")


def fits_bytes(*units: Any) -> bytes:
    file = BytesIO()
    fits.HDUList(list(units)).writeto(file)
    return file.getvalue()


def test_a_picture_in_an_extension_is_read_past_tables():
    picture = np.arange(12, dtype=np.int16).reshape(3, 4)
    table = fits.BinTableHDU.from_columns([fits.Column(name="t", format="D", array=np.arange(700.0))])
    primary = fits.PrimaryHDU()
    primary.header["EXPTIME"] = 0.25
    data = fits_bytes(primary, table, fits.ImageHDU(picture))
    values, found, scale, zero = next(fits_arrays(data))
    np.testing.assert_array_equal(found, picture)
    assert (scale, zero, values["EXPTIME"]) == (1.0, 0.0, "0.25")


def test_a_file_without_a_picture_says_what_it_has():
    with pytest.raises(FrameError, match="compressed in tiles"):
        next(fits_arrays(fits_bytes(fits.PrimaryHDU(), fits.CompImageHDU(np.ones((40, 40), np.int16)))))
    with pytest.raises(FrameError, match="no array of pixels"):
        next(fits_arrays(fits_bytes(fits.PrimaryHDU())))
