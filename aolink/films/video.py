"""Films from videos, animated pictures and all else that FFmpeg reads, with the time of each frame."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ImportingError
from aolink.extensions import needs_extra
from aolink.films.facts import Said, facts, meaning
from aolink.films.film import Film
from aolink.films.stills import COMPRESSED
from aolink.limits import LOSSY_EXPANSION, check_film, check_picture

_LINEAR = ("ffv1", "huffyuv", "rawvideo", "utvideo", "png", "tiff", "ffvhuff")
"""Codecs that lose nothing."""
_SHORTER = 0.02
"""Share of the frames by which a header may announce too many."""


def video_film(path: Path) -> Film:
    """The frames of a video, and when each is shown."""

    def decoded() -> Iterator[Any]:
        with _opened(path) as file:
            for frame in file.decode(file.streams.video[0]):
                if frame.interlaced_frame:
                    raise ImportingError(
                        f"{path} is interlaced: a frame is two of half the rows, half a period apart. `ffmpeg -i {path}"
                        " -vf separatefields -c:v ffv1 fields.mkv` makes a film of these; where frames are whole in"
                        f" truth, `ffmpeg -i {path} -vf setfield=prog -c:v ffv1 whole.mkv`"
                    )
                if frame.is_corrupt:
                    raise ImportingError(f"{path} is damaged: a frame cannot be decoded")
                yield frame

    if path.suffix.lower() == ".gif" and not path.read_bytes().rstrip(b"\0").endswith(b";"):
        raise ImportingError(f"{path} is cut off: it has no end")
    with _opened(path) as file:
        if not file.streams.video:
            raise ImportingError(f"{path} has no pictures")
        stream = file.streams.video[0]
        shape = (stream.codec_context.height, stream.codec_context.width)
        check_picture(shape[1], shape[0], ImportingError)
        tick, codec, rate = stream.time_base, stream.codec_context.name, stream.guessed_rate
        lasts = stream.duration * tick if stream.duration and tick else None
        if lasts is None and file.duration and len(file.streams) == 1:
            lasts = Fraction(file.duration, 10**6)
        announced = stream.frames or (round(lasts * rate) if lasts and rate else 0)
        said = [Said(name, value) for name, value in {**file.metadata, **stream.metadata}.items()]
    shown: list[int | None] = []
    first = None
    for frame in decoded():
        check_film(shape, 1, len(shown), path.stat().st_size, ImportingError, LOSSY_EXPANSION)
        shown.append(frame.pts)
        first = frame if first is None else first
    if first is None:
        raise ImportingError(f"{path} has no pictures")
    pixels = _pixels(first)
    known, notes = facts([each for each in said if meaning(each.name)[0] in ("rate", "exposure")], len(shown))
    bits = _bits(first)
    times = [each * tick for each in shown if each is not None and tick is not None]
    if tick is not None and len(times) == len(shown):
        if rate:  # what a container has rounded to its ticks is meant to be at whole frames
            numbers = [round((each - times[0]) * rate) for each in times]
            if all(abs(each - times[0] - k / rate) <= tick for each, k in zip(times, numbers, strict=True)):
                times = [k / rate for k in numbers]
        known["times_ns"] = np.array([round(each * 10**9) for each in times], np.int64)
        there = round((times[-1] - times[0]) * rate) + 1 if rate else len(times)
        if max(there, len(times)) < announced - max(2, _SHORTER * announced):
            raise ImportingError(f"{path} is cut off: `ffmpeg -i {path} -c copy rest.mkv` makes a film of the rest")
    elif rate:
        known.setdefault("rate_hz", float(rate))
    linear = codec in _LINEAR and not first.format.name.startswith("yuv")
    mosaic = first.format.name.removeprefix("bayer_")[:4].upper() if first.format.name.startswith("bayer") else ""
    return Film(
        name=path.name, shape=(int(pixels.shape[0]), int(pixels.shape[1])), dtype=pixels.dtype, count=len(shown),
        pictures=lambda: map(_pixels, decoded()), nonlinear="" if linear else COMPRESSED,
        top=float((1 << bits) - 1) if bits not in (8, 16, 32) else None,
        mosaic=mosaic, played=True, notes=notes, **known,
    )  # fmt: skip


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The container. A list of other files, which FFmpeg knows by what it holds, opens none."""
    with needs_extra("films", ImportingError):
        import av

    def other(url: str, *_: Any) -> None:
        raise ImportingError(f"{path} names {url}: films in other files are not read; give that file")

    options = {"min_delay": "0", "protocol_whitelist": "none"}  # the first of a GIF: it is not slowed down
    with path.open("rb") as file, av.open(file, options=options, io_open=other) as opened:
        yield opened


def _bits(frame: Any) -> int:
    if frame.format.name.startswith("bayer"):
        return int(frame.format.bits_per_pixel)
    return int(max(each.bits for each in frame.format.components))


def _pixels(frame: Any) -> NDArray[Any]:
    """A frame's numbers as a player would turn them."""
    pixels = _unturned(frame)
    found = frame.side_data.get("DISPLAYMATRIX")
    if found is None:
        return pixels
    a, b, _, c, d = np.frombuffer(bytes(found), "<i4", 5).tolist()
    if abs(a) < abs(b):
        pixels, a, d = pixels.swapaxes(0, 1), c, b
    return np.ascontiguousarray(pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


def _unturned(frame: Any) -> NDArray[Any]:
    """A frame's numbers as they are; colours that are no red, green and blue are made these, of as many bits."""
    name, bits = frame.format.name, _bits(frame)
    if name.startswith(("gray", "bayer", "gbrp", "rgb24", "rgb48")) and not name.startswith(("gray8a", "grayf")):
        pixels = frame.to_ndarray()
        return np.asarray(pixels.astype(pixels.dtype.newbyteorder("=")))
    if name.startswith("mono"):
        return np.asarray(frame.to_ndarray(format="gray"))
    if bits <= 8:
        return np.asarray(frame.to_ndarray(format="rgb24"))
    return np.asarray(frame.to_ndarray(format="rgb48le") >> (16 - min(bits, 16)))
