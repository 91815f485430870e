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
from aolink.films.film import Film, Stored, array_film
from aolink.limits import check_picture, load_archive

_SER = np.dtype(
    [("magic", "S14"), ("lu", "<i4"), ("colour", "<i4"), ("big", "<i4"), ("columns", "<i4"), ("rows", "<i4"),
     ("bits", "<i4"), ("count", "<i4"), ("names", "S120"), ("date", "<i8"), ("utc", "<i8")]
)  # fmt: skip
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
    return array_film(arrays[_only(path, stacks, arrays, "name the array with the film 'frames'")], path.name,
                      **_known(path, arrays))  # fmt: skip


def hdf5_film(path: Path, topic: str | None) -> Film:
    """The dataset ``topic`` of an HDF5 file, or its only one of three axes or more; times are attributes of it, or
    datasets beside it, with the names that .npz has."""
    with needs_extra("films", ImportingError):
        import h5py
    with ExitStack() as stack:
        file = stack.enter_context(h5py.File(path))
        found: dict[str, Any] = {}
        file.visititems(lambda name, each: found.update({f"/{name}": each}) if hasattr(each, "dtype") else None)
        frames = [name for name, each in found.items() if each.ndim >= 3 and each.dtype.kind in "biuf"]
        wanted = frames if topic is None else [name for name in found if name == f"/{topic.strip('/')}"]
        chosen = found[_only(path, wanted, found, "say with --film topic=NAME which one has the frames")]
        if chosen.external or chosen.is_virtual:
            raise ImportingError(
                f"{path} keeps the pixels of {chosen.name} in other files, which are not read: write them into the file"
            )
        check_picture(math.prod(chosen.chunks or (1,)) * chosen.dtype.itemsize // 8, 1, ImportingError)
        beside = {name.rpartition("/")[2]: each for name, each in found.items() if each.parent == chosen.parent}
        known = _known(path, {key: np.asarray(each) for key, each in (*beside.items(), *chosen.attrs.items())
                              if key in _FACTS})  # fmt: skip
        stack.pop_all()  # it is read frame by frame, as long as the film lives
        return array_film(chosen, path.name, **known)


def _only(path: Path, names: list[str], arrays: Mapping[str, Any], what_to_do: str) -> str:
    if len(names) != 1:
        have = ", ".join(f"{name} {arrays[name].shape}" for name in arrays) or "nothing"
        raise ImportingError(f"{path} has {have}: {what_to_do}")
    return names[0]


_FACTS = {"rate_hz": (0,), "exposure_s": (0,), "times_s": (1,), "times_ns": (1,), "inputs": (1, 2)}
"""What may stand beside the frames, and how many axes it has."""


def _known(path: Path, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    known: dict[str, Any] = {}
    for key in _FACTS.keys() & arrays.keys():
        found = arrays[key]
        if found.ndim not in _FACTS[key] or found.dtype.kind not in "iuf" or not np.isfinite(found).all():
            axes = " or ".join(map(str, _FACTS[key]))
            raise ImportingError(
                f"{path}: {key} is {found.dtype} of shape {found.shape}, expected numbers of {axes} axes"
            )
        if not found.ndim and found <= 0:
            raise ImportingError(f"{path}: {key} is {found:g}, expected a number above 0")
        known[key] = found if found.ndim else float(found)
    if "inputs" in known:
        known["inputs"] = known["inputs"].reshape(len(known["inputs"]), -1).astype(np.float64)
    if "times_s" in known:
        times = known.pop("times_s")
        whole = np.floor(times)  # so that seconds since 1970 lose no more than they have lost
        known.setdefault("times_ns", whole.astype(np.int64) * 10**9 + np.rint((times - whole) * 1e9).astype(np.int64))
    if "times_ns" in known:
        known["times_ns"] = known["times_ns"].astype(np.int64)
    return known


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
