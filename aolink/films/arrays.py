"""Films from files of numbers: NumPy's .npy and .npz, HDF5, and SER."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ImportingError
from aolink.extensions import needs_extra
from aolink.films.facts import Said, facts, meaning
from aolink.films.film import Film, FilmFrame, Stored, array_film
from aolink.limits import check_picture, load_archive

_SER = np.dtype(
    [("magic", "S14"), ("lu", "<i4"), ("colour", "<i4"), ("big", "<i4"), ("columns", "<i4"), ("rows", "<i4"),
     ("bits", "<i4"), ("count", "<i4"), ("names", "S120"), ("date", "<i8"), ("utc", "<i8")]
)  # fmt: skip
_BLOCK_BYTES = 1 << 26
"""Bytes of frames that are read at once."""
_SER_MOSAICS = {8: "RGGB", 9: "GRBG", 10: "GBRG", 11: "BGGR"}
_SER_EPOCH = 621_355_968_000_000_000
"""The year 1970 in units of 100 ns from the year 1 on, in which SER keeps times."""


def npy_film(path: Path) -> Film:
    """The frames of a .npy file."""
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, columns_first, dtype = read(file)
        stored = Stored(path, dtype, shape[::-1] if columns_first else shape, file.tell())
    return array_film(np.asarray(stored).T if columns_first else stored, path.name)


def npz_film(path: Path) -> Film:
    """The frames of a .npz file, which may have times and inputs as well."""
    arrays = load_archive(path, ImportingError)
    stacks = [name for name in arrays if name == "frames"] or [n for n in arrays if arrays[n].ndim in (3, 4)]
    chosen = _only(path, stacks, arrays, "name the array with the film 'frames'")
    return _with_facts(path, arrays[chosen], [Said(name, each) for name, each in arrays.items() if name != chosen])


def hdf5_film(path: Path, topic: str | None) -> Film:
    """The dataset ``topic`` of an HDF5 file, or its only one of three axes or more; times are attributes of it or of
    the groups about it, or other datasets."""
    with needs_extra("films", ImportingError):
        import h5py
    with ExitStack() as stack:
        file = stack.enter_context(h5py.File(path))
        found: dict[str, Any] = {}
        file.visititems(lambda name, each: found.update({f"/{name}": each}) if hasattr(each, "dtype") else None)
        frames = [name for name, each in found.items() if each.ndim >= 3 and each.dtype.kind in "biuf"]
        wanted = frames if topic is None else [name for name in found if name == f"/{topic.strip('/')}"]
        chosen = found.pop(_only(path, wanted, found, "say with --film topic=NAME which one has the frames"))
        if chosen.external or chosen.is_virtual:
            raise ImportingError(f"{path} keeps pixels in other files, which are not read: write them into the file")
        check_picture(math.prod(chosen.chunks or (1,)) * chosen.dtype.itemsize // 8, 1, ImportingError)
        said, group = [Said(key, value) for key, value in chosen.attrs.items()], chosen.parent
        inside = {name: each for name, each in found.items() if not (each.external or each.is_virtual)}
        beside = {name: each for name, each in inside.items() if each.ndim < 3 and each.size < _BLOCK_BYTES // 8}
        for name, each in sorted(beside.items(), key=lambda one: one[1].parent != group):
            if each.parent == group or meaning(name.rpartition("/")[2])[0]:
                unit = each.attrs.get("units", each.attrs.get("unit", ""))
                said.append(Said(name.rpartition("/")[2], each[()], unit if isinstance(unit, str) else ""))
        for name in dict.fromkeys((group.name, "/")):
            said += [Said(key, value) for key, value in file[name].attrs.items()]
        stack.pop_all()  # it is read frame by frame, as long as the film lives
        last = _written(chosen)
        unwritten = f"the last {len(chosen) - last} of its {len(chosen)} frames were never written: they are left out"
        film = _with_facts(path, _Blocks(chosen, last), [each for each in said if each.name not in _OF_HDF5])
        return replace(film, notes=(*film.notes, *([unwritten] if last < len(chosen) else [])))


_OF_HDF5 = ("DIMENSION_LIST", "CLASS", "REFERENCE_LIST", "NAME", "units", "unit", "_FillValue")


def _written(data: Any) -> int:
    """The number of frames up to the last one that has a place in the file."""
    if not data.chunks or not data.id.get_num_chunks():
        return len(data) if data.id.get_storage_size() else 0
    firsts = list[int]()
    data.id.chunk_iter(lambda chunk: firsts.append(chunk.chunk_offset[0]))
    return min(len(data), max(firsts) + int(data.chunks[0]))


class _Blocks:
    """The first ``count`` frames of a dataset of HDF5, read chunk by chunk: each has to be decompressed at once."""

    def __init__(self, data: Any, count: int) -> None:
        self._data, self.dtype, self.shape, self._first = data, data.dtype, (count, *data.shape[1:]), 0
        many = _BLOCK_BYTES // (math.prod(data.shape[1:]) * data.dtype.itemsize)
        self._many = max(1, min(many, data.chunks[0] if data.chunks else 1))
        self._block = data[:0]

    def __len__(self) -> int:
        return int(self.shape[0])

    def __getitem__(self, k: int) -> FilmFrame:
        if not self._first <= k < self._first + len(self._block):
            self._first, self._block = k, self._data[k : k + self._many]
        return np.asarray(self._block[k - self._first])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self._data[: len(self)], dtype)


def _only(path: Path, names: list[str], arrays: Mapping[str, Any], what_to_do: str) -> str:
    if len(names) != 1:
        have = ", ".join(f"{name} {arrays[name].shape}" for name in arrays) or "nothing"
        raise ImportingError(f"{path} has {have}: {what_to_do}")
    return names[0]


_OWN = {"rate_hz": (0,), "exposure_s": (0,), "times_s": (1,), "times_ns": (1,), "inputs": (1, 2)}
"""Names that mean nothing else, and how many axes they have: what they have must be right."""


def _with_facts(path: Path, frames: Any, said: list[Said]) -> Film:
    """The film of frames with what stands beside them."""
    film, own = array_film(frames, path.name), {each.name: np.asarray(each.value) for each in said if each.name in _OWN}
    for name, each in own.items():
        numbers = each.ndim in _OWN[name] and each.dtype.kind in "iuf" and bool(np.isfinite(each).all())
        if not numbers or (not each.ndim and each <= 0) or (name.startswith("times") and len(each) != film.count):
            wanted = "a number above 0" if _OWN[name] == (0,) else f"finite numbers for {film.count} frames"
            raise ImportingError(f"{path}: {name} is {each.dtype} of shape {each.shape}, expected {wanted}")
    known, notes = facts([each for each in said if each.name != "inputs"], film.count, every=True)
    if "inputs" in own:
        known["inputs"] = own["inputs"].reshape(len(own["inputs"]), -1).astype(np.float64)
    return replace(film, notes=(*film.notes, *notes), **known)


def ser_film(path: Path) -> Film:
    """The frames of a SER file, with the time of each where it has them."""
    with path.open("rb") as file:
        header = np.frombuffer(file.read(_SER.itemsize), _SER)[0]
    if header["magic"] != b"LUCAM-RECORDER":
        raise ImportingError(f"{path} is no SER file: it does not begin with LUCAM-RECORDER")
    count, rows, columns, bits, colour = (int(header[key]) for key in ("count", "rows", "columns", "bits", "colour"))
    channels = 3 if colour in (100, 101) else 1
    if min(count, rows, columns) < 1 or not 1 <= bits <= 16:
        raise ImportingError(f"{path} is damaged: it announces {count} frames of {rows} x {columns} of {bits} bits")
    if channels == 1 and colour and colour not in _SER_MOSAICS:
        raise ImportingError(f"{path} has a mosaic of colours that is not known, {colour}")
    shape = (count, rows, columns, *((3,) if channels == 3 else ()))
    frames = Stored(path, np.dtype("u1" if bits <= 8 else "<u2"), shape, _SER.itemsize)
    end = _SER.itemsize + frames.dtype.itemsize * math.prod(shape)
    top = float((1 << bits) - 1)
    # The header's word on the order of bytes means the opposite to most programs, so the values decide if they can.
    if bits > 8 and ((fits := [frames[0].view(each).max() <= top for each in ("<u2", ">u2")]) == [False, True]
                     or (all(fits) and header["big"])):  # fmt: skip
        frames = replace(frames, dtype=np.dtype(">u2"))
    known: dict[str, Any] = {"top": top, "mosaic": _SER_MOSAICS.get(colour, "")}
    stamps = np.fromfile(path, "<i8", count, offset=end)
    if len(stamps) == count and stamps.min() > _SER_EPOCH:
        times = (stamps - _SER_EPOCH) * 100
        known |= {"times_ns": times, "start_ns": int(times[0])}
    elif header["utc"] > _SER_EPOCH:
        known |= {"start_ns": int(header["utc"] - _SER_EPOCH) * 100}
    film = array_film(frames, path.name, **known)
    return replace(film, pictures=lambda: (each[..., ::-1] for each in film.pictures())) if colour == 101 else film
