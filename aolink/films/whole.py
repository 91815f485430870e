"""Whether a frame is a frame: copies, frames that were never written, and blocks of pixels that were lost.

Noise makes it impossible that a camera gives a frame twice, a picture of one value, or a row of another frame.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ImportingError
from aolink.films.film import Film, FilmFrame
from aolink.numerics.arrays import BoolArray

_COPY, _TWICE = "a copy of a frame before", "a message that came twice"
_EMPTY, _LOST = "of one value, as if never written", "without most of its pixels"
_BUFFERS = 4
"""Frames before among which a copy is looked for, as many as drivers keep."""
_LONGEST_TURN = 12
"""The longest period, in frames, of copies that come in turn."""
_STEPS, _DARKEST = 4, 0.02
"""A zero is no light where the least other value has so many steps of the numbers, and such a share of the median."""
_STALE = 0.25
"""Share of the frames that may have rows of the frame before: in more, it is the picture that does not change."""
_SAMPLES, _FEW, _ROUGH = 3, 0.01, 0.15
"""Frames whose bits are checked; share of the pixels that shows that they have wrapped; and differences from pixel to
pixel, over the range of the values, that a picture whose bytes are in their order does not have."""


def whole_frames(film: Film) -> Film:
    """The film without frames that are none, whose pixels are NaN where they were lost.

    Copies that come in turn, as every second frame, make a film of a lower rate. Otherwise a gap stands for each frame
    that is left out. Raises `ImportingError` where no frame is left, or pixels have wrapped or swapped bytes.
    """
    if film.slopes or film.count < 2:
        return film
    why, holes = _looked_at(film)
    left, good = Counter(filter(None, why)), np.array([not each for each in why])
    if not good.any():
        raise ImportingError(f"{film.name}: all of its {film.count} frames are of one value: there is no light in them")

    def pictures() -> Iterator[FilmFrame]:
        for k, frame in enumerate(film.pictures()):
            if good[k]:
                lost = holes.get(k)
                yield frame if lost is None else np.where(lost if frame.ndim == 2 else lost[..., None], np.nan, frame)

    known: dict[str, Any] = {"numbers": (np.arange(film.count) if film.numbers is None else film.numbers)[good]}
    times, first, rate = film.times_ns, int(np.argmax(good)), film.rate_hz
    if times is not None:
        known["times_ns"], rate = times[good], rate or 1e9 / max(1.0, float(np.median(np.diff(times))))
    if film.start_ns is not None and rate:
        known["start_ns"] = film.start_ns + round(first * 1e9 / rate if times is None else times[first] - times[0])
    if film.inputs is not None and len(film.inputs) == film.count and film.input_times_ns is None:
        known["inputs"] = film.inputs[good]
    if lost := [k for k in holes if good[k]]:
        note = f"pixels are zero or those of the frame before in some frames, {len(lost)}: they are masked"
        known["notes"] = (*film.notes, note)
    account = " and ".join(f"{n} {'is' if n == 1 else 'are each'} {what}" for what, n in left.items())
    turn = _turn([each == _COPY for each in why]) if set(left) == {_COPY} else 0
    if turn:
        part = np.count_nonzero(good[-turn:]) / turn
        known |= {"numbers": None, "share": part, "rate_hz": film.rate_hz and film.rate_hz * part}
        if times is not None and part * turn > 1:  # as of a film for cinemas on television
            known |= {"times_ns": None, "rate_hz": rate and rate * part}
        account += f", in turn: the rate is {part:.4g} of the file's"
    elif set(left) - {_TWICE}:
        account += ", a gap stands for each"
    none = int(sum(left.values()))
    return replace(film, pictures=pictures, count=film.count - none, account=account, left_out=none, **known)


def _turn(copy: list[bool]) -> int:
    """The period, in frames, with which copies come in turn; 0 where they do not."""
    rest = copy[1:]  # the first frame is none, whatever comes after
    return next((n for n in range(2, min(_LONGEST_TURN, len(copy) // 3) + 1) if rest[n:] == rest[:-n]), 0)


def _looked_at(film: Film) -> tuple[list[str], dict[int, BoolArray]]:
    """Why each frame is none, empty where it is one; and the pixels that it lacks, by its number."""
    why, seen, zeros, before = list[str](), deque[bytes](maxlen=_BUFFERS), list[int](), None
    stale, dark, always = dict[int, BoolArray](), dict[int, NDArray[np.uint8]](), np.ones(film.shape, np.bool_)
    least, lowest, ground, step = math.inf, 0.0, 0.0, 0.0
    for k, each in enumerate(film.pictures()):
        frame: NDArray[Any] = each
        light = frame[..., :3] if frame.ndim == 3 else frame
        inner = frame[1:-1] if len(frame) > 8 else frame  # cameras keep counters in the first and the last row
        digest = hashlib.blake2b(inner.tobytes(), digest_size=16).digest()
        values = light[np.isfinite(light)] if light.dtype.kind == "f" else light.ravel()
        zero = ~light.astype(np.bool_).reshape(*film.shape, -1).any(axis=2)
        same = digest in seen and film.times_ns is not None and film.times_ns[k] == film.times_ns[k - 1]
        empty = not values.size or values.min() == values.max()
        why.append(_EMPTY if empty else _TWICE if same else _COPY if digest in seen else "")
        seen.append(digest)
        zeros.append(int(zero.sum()))
        if why[-1]:
            continue
        if k < _SAMPLES and not film.nonlinear and film.top is None and light.dtype.kind in "iu":
            _check_bits(film, light)
        if not ground:
            ground = float(np.median(values))
            step = float(np.gcd.reduce(values.astype(np.int64))) if light.dtype.kind in "iu" else 0.0
        lowest, least = (
            min(lowest, float(values.min())),
            min(least, float(values[values > 0].min(initial=values.max()))),
        )
        always &= zero
        if zeros[-1]:
            dark[k] = np.packbits(zero)
        if before is not None and not film.nonlinear and before.shape == frame.shape:
            rows = (before == frame).reshape(len(frame), -1).all(axis=1)
            rows &= np.ptp(light.reshape(len(frame), -1).astype(np.float64), axis=1) >= max(_STEPS * step, 1e-12)
            if rows.any():
                stale[k] = rows
        before = frame
    shown = [n for n, each in zip(zeros, why, strict=True) if not each]
    holes = dict[int, BoolArray]()
    if lowest >= 0 and least >= max(_STEPS * step, _DARKEST * ground):
        for k in (k for k in dark if zeros[k] > np.median(shown)):
            holes[k] = np.unpackbits(dark[k], count=always.size).reshape(always.shape).astype(np.bool_) & ~always
    for k, rows in stale.items() if len(stale) <= _STALE * len(shown) else ():
        holes[k] = holes.get(k, np.zeros(film.shape, np.bool_)) | rows[:, None]
    return [_LOST if k in holes and holes[k].mean() > 0.5 else each for k, each in enumerate(why)], holes


def _check_bits(film: Film, light: NDArray[Any]) -> None:
    """Raise an error for numbers that have wrapped below zero or whose bytes are in the other order."""
    full, values = 1 << 8 * light.dtype.itemsize, light.ravel()
    if light.dtype.kind == "u":
        high, low = ((values >= full // 16 * 15) & (values < full - 1)).mean(), (values < full // 16).mean()
        if min(high, low) > _FEW and ((values >= full // 4) & (values < full // 4 * 3)).mean() < high / 10:
            raise ImportingError(f"{film.name} has values that lost their sign: give --film pixels=signed,background")
    elif 0 < (values < -full // 4).mean() < 0.5 and np.median(values) > 0:
        raise ImportingError(f"{film.name} has values that got a wrong sign: give --film pixels=unsigned")
    swapped = light.byteswap().view(np.dtype("u2").newbyteorder(light.dtype.byteorder)) if full == 1 << 16 else None
    if swapped is not None and (
        (swapped.max() < 1 << 14 <= values.max() and len(np.unique(swapped & 255)) > 16)
        or _rough(light) > _ROUGH > 3 * _rough(swapped)
    ):
        raise ImportingError(f"{film.name} has 16 bits in the other order of bytes: give --film pixels=swapped")


def _rough(picture: NDArray[Any]) -> float:
    """Differences from pixel to pixel over the range of the values."""
    values = picture.astype(np.float64).reshape(len(picture), -1)
    size = float(np.ptp(np.quantile(values, (0.01, 0.99))))
    return float(np.median(np.abs(np.diff(values, axis=1)))) / size if size > 0 and values.shape[1] > 1 else 0.0
