"""Pictures and arrays that hold more than they should: one error, before the memory is asked for."""

from __future__ import annotations

import gzip
import resource
import struct
import subprocess
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink import limits
from aolink.errors import FrameError, ImportingError, RestorationError
from aolink.films.formats import open_film
from aolink.films.pictures import read_frame, read_picture
from aolink.limits import load_array

Run = Callable[..., subprocess.CompletedProcess[str]]
CARDS = ("SIMPLE  =                    T", "BITPIX  =                    8", "NAXIS   =                    2")


def fits(columns: int, rows: int) -> bytes:
    cards = (*CARDS, f"NAXIS1  = {columns:20}", f"NAXIS2  = {rows:20}", "END")
    return "".join(card.ljust(80) for card in cards).ljust(2880).encode()


def png(path: Path, width: int, height: int) -> Path:
    """A picture of black pixels, written row by row."""
    packer = zlib.compressobj(1)
    data = b"".join(packer.compress(bytes(1 + width)) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    with path.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, content in ((b"IHDR", head), (b"IDAT", data), (b"IEND", b"")):
            file.write(struct.pack(">I", len(content)) + kind + content)
            file.write(struct.pack(">I", zlib.crc32(kind + content)))
    return path


@pytest.mark.slow
def test_a_small_fits_file_that_holds_gigabytes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.fits.gz"
    with gzip.open(path, "wb", compresslevel=1) as file:
        file.write(fits(8192, 8192))
        for _ in range(64):
            file.write(bytes(1 << 20))
    assert path.stat().st_size < 1 << 20
    assert read_frame(path, FrameError).shape == (8192, 8192)
    monkeypatch.setattr(limits, "_UNPACKED_BYTES", 30_000_000)
    for error in (FrameError, ImportingError):
        with pytest.raises(error, match="very much more than its size without compression, which is above the limit"):
            read_frame(path, error)


def test_a_picture_with_too_many_pixels_is_refused_before_they_are_read(tmp_path: Path) -> None:
    path = png(tmp_path / "a.png", 13000, 13000)
    with pytest.raises(RestorationError, match=r"a\.png: it has 13000 x 13000 pixels, which is above the limit"):
        read_picture(path, RestorationError)
    with pytest.raises(ImportingError, match="13000 x 13000 pixels"):
        open_film(tmp_path)
    assert read_picture(png(tmp_path / "b.png", 300, 200), RestorationError).shape == (200, 300)


def test_an_archive_that_holds_more_than_it_should_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.savez_compressed(tmp_path / "a.npz", frames=np.zeros((100, 100, 100)))
    assert open_film(tmp_path / "a.npz").count == 100
    monkeypatch.setattr(limits, "_UNPACKED_BYTES", 1_000_000)
    with pytest.raises(ImportingError, match=r"it holds 8000\d* bytes without compression, which is above the limit"):
        open_film(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["/dev/zero", "empty.fits", "empty.png", "empty.npy", "empty.npz", "none.fits"])
def test_what_is_no_picture_is_one_error(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name.startswith("empty"):
        path.touch()
    with pytest.raises(ImportingError) as caught:
        open_film(path)
    assert "\n" not in str(caught.value)


def test_an_array_holds_what_its_header_says(tmp_path: Path) -> None:
    for version, values in (((1, 0), np.arange(6.0).reshape(2, 3)), ((2, 0), np.zeros((0, 3)))):
        with (tmp_path / "a.npy").open("wb") as file:
            np.lib.format.write_array(file, values, version=version)
        found = load_array((tmp_path / "a.npy").read_bytes())
        assert found.tolist() == values.tolist()
    data = (tmp_path / "a.npy").read_bytes().replace(b"(0, 3)", b"(9, 3)")
    with pytest.raises(ValueError, match=r"it is cut off: \(9, 3\) numbers are announced"):
        load_array(data)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("frames.npy", data)
    with pytest.raises(ImportingError, match="it is cut off"):
        open_film(tmp_path / "a.npz")


@pytest.mark.slow
@pytest.mark.parametrize(("limit_mb", "code"), [(200, 1), (500, 6)])
def test_a_process_with_too_little_memory_ends_with_one_line(
    aolink: Run, tmp_path: Path, limit_mb: int, code: int
) -> None:
    """Too little for the libraries, and for an estimator: both end such a process without a word, or never."""
    recording = Path(__file__).parents[1] / "recordings" / "section-vi.mcap"
    done = aolink(
        "estimate", recording, "-e", "o3",
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit_mb << 20, limit_mb << 20)),
    )  # fmt: skip
    assert (done.returncode, len(done.stderr.splitlines())) == (code, 1), done.stderr
    assert "raise " in done.stderr
    assert "ulimit -v" in done.stderr
