"""Whether a frame is a frame: copies, frames that were never written, and blocks of pixels that were lost.

Noise makes it impossible that a camera gives a frame twice, a picture of one value, or a row of another frame.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from aolink.errors import ImportingError
from aolink.films.film import Film, FilmFrame
from aolink.numerics.arrays import BoolArray

_COPY, _EMPTY, _LOST = "copies of a frame before", "of one value, as if never written", "without most of their pixels"
_LONGEST_TURN = 12
"""The longest period, in frames, of copies that come in turn."""
_STEPS, _DARKEST = 4, 0.02
"""A zero is no light where the least other value has so many steps of the numbers, and such a share of the median."""
_STALE = 0.25
"""Share of the frames that may have rows of the frame before: in more, it is the picture that does not change."""
_SAMPLES = 3
_FEW = 0.01


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

    notes = list(film.notes)
    if lost := [k for k in holes if good[k]]:
        notes.append(f"{len(lost)} frames lack pixels, which are zero or those of the frame before: they are masked")
    known: dict[str, object] = {"numbers": (np.arange(film.count) if film.numbers is None else film.numbers)[good]}
    times, first = film.times_ns, int(np.argmax(good))
    if times is not None:
        known["times_ns"] = times[good]
    if film.start_ns is not None and first and (times is not None or film.rate_hz):
        known["start_ns"] = film.start_ns + round(
            times[first] - times[0] if times is not None else first * 1e9 / (film.rate_hz or 1)
        )
    if film.inputs is not None and len(film.inputs) == film.count and film.input_times_ns is None:
        known["inputs"] = film.inputs[good]
    account = ""
    if left:
        said = [f"{n} {'is' if n == 1 else 'are'} {what}" for what, n in left.items()]
        account, turn = f"{' and '.join(said)}, a gap stands for each", _turn(np.array([each == _COPY for each in why]))
        if turn and set(left) == {_COPY}:
            part = np.count_nonzero(good[-turn:]) / turn
            usual = None if times is None else float(np.median(np.diff(times)))
            rate = film.rate_hz if usual is None or usual <= 0 else 1e9 / usual
            known |= {"numbers": None, "share": part, "rate_hz": rate and rate * part}
            known["times_ns"] = times[good] if times is not None and part * turn == 1 else None
            account = f"{left[_COPY]} are copies of a frame before, in turn: the rate is {part:.4g} of the file's"
    return replace(
        film, pictures=pictures, count=int(good.sum()), notes=tuple(notes), account=account,
        left_out=int(sum(left.values())), **known,
    )  # type: ignore[arg-type]  # fmt: skip


def _turn(copy: BoolArray) -> int:
    """The period, in frames, with which copies come in turn; 0 where they do not."""
    for n in range(2, min(_LONGEST_TURN, len(copy) // 3) + 1):
        rest = copy[1:]  # the first frame is none, whatever comes after
        if copy.any() and (rest[n:] == rest[:-n]).all():
            return n
    return 0


def _looked_at(film: Film) -> tuple[list[str], dict[int, BoolArray]]:
    """Why each frame is none, empty where it is one; and the pixels that it lacks, by its number."""
    why, seen, zeros, before = list[str](), set[bytes](), list[int](), None
    stale, dark = dict[int, BoolArray](), dict[int, BoolArray]()
    always: BoolArray | None = None
    least, ground, step, negative = math.inf, 0.0, 0.0, False
    for k, frame in enumerate(film.pictures()):
        light = frame[..., :3] if frame.ndim == 3 else frame
        inner = frame[1:-1] if len(frame) > 8 else frame  # cameras keep counters in the first and the last row
        digest = hashlib.blake2b(np.ascontiguousarray(inner), digest_size=16).digest()
        zero = ~light.astype(np.bool_, copy=False)
        zero = zero.all(axis=2) if light.ndim == 3 else zero
        values = light[np.isfinite(light)] if light.dtype.kind == "f" else light.ravel()
        why.append(_EMPTY if not values.size or values.min() == values.max() else _COPY if digest in seen else "")
        seen.add(digest)
        zeros.append(int(zero.sum()))
        if why[-1]:
            continue
        if len(seen) <= _SAMPLES and not film.nonlinear:
            _check_bits(film, light)
        if not ground:
            ground = float(np.median(values))
            step = float(np.gcd.reduce(values.astype(np.int64))) if light.dtype.kind in "iu" else 0.0
        negative |= bool(values.min() < 0)
        least = min(least, float(values[values > 0].astype(np.float64).min(initial=np.inf)))
        always = zero if always is None else always & zero
        if zeros[-1]:
            dark[k] = np.packbits(zero)  # type: ignore[assignment]
        if before is not None and not film.nonlinear and before.shape == frame.shape:
            rows = (before == frame).reshape(len(frame), -1).all(axis=1)
            rows &= np.ptp(light.reshape(len(frame), -1).astype(np.float64), axis=1) >= max(_STEPS * step, 1e-12)
            if rows.any():
                stale[k] = rows
        before = frame
    shown = [k for k in range(len(why)) if not why[k]]
    usual = np.median([zeros[k] for k in shown]) if shown else 0
    holes = dict[int, BoolArray]()
    if not negative and least >= max(_STEPS * step, _DARKEST * ground) and always is not None:
        for k in (k for k in dark if zeros[k] > usual):
            holes[k] = np.unpackbits(dark[k], count=always.size).reshape(always.shape).astype(np.bool_) & ~always
    if len(stale) <= _STALE * len(shown):
        for k, rows in stale.items():
            holes[k] = holes.get(k, np.zeros(film.shape, np.bool_)) | rows[:, None]
    for k, each in holes.items():
        if each.mean() > 0.5:
            why[k] = _LOST
    return why, holes


def _check_bits(film: Film, light: FilmFrame) -> None:
    """Raise an error for numbers that have wrapped below zero or whose bytes are in the other order."""
    if light.dtype.kind not in "iu" or film.top is not None:
        return
    bits, values = 8 * light.dtype.itemsize, light.ravel()
    full = 1 << bits
    if light.dtype.kind == "u":
        high = np.count_nonzero((values >= full // 16 * 15) & (values < full - 1))
        middle = np.count_nonzero((values >= full // 4) & (values < full // 4 * 3))
        low = np.count_nonzero(values < full // 16)
        if high > _FEW * values.size and low > _FEW * values.size and middle < high / 10:
            raise ImportingError(
                f"{film.name} has values near 0 and near {full} and few between, as numbers below zero that were kept"
                " without their sign: give --film pixels=signed,background"
            )
    elif np.count_nonzero(values < -full // 4) > 2 and np.count_nonzero(values > full // 4) > 2:
        raise ImportingError(
            f"{film.name} has values down to {values.min()} and up to {values.max()}, as numbers without a sign that"
            " were kept with one: give --film pixels=unsigned"
        )
    if bits != 16:
        return
    swapped = light.byteswap()
    unsigned = swapped.view(np.dtype("u2").newbyteorder(light.dtype.byteorder))
    used = len(np.unique(unsigned & 255))
    few = unsigned.max() < 1 << 14 and used > 16 and values.max() >= 1 << 14
    if few or _rough(light) > 0.15 > 3 * _rough(swapped):
        raise ImportingError(
            f"{film.name} has numbers of 16 bits whose bytes seem to be in the other order: give --film pixels=swapped"
        )


def _rough(picture: FilmFrame) -> float:
    """Differences from pixel to pixel over the range of the values."""
    values = picture.astype(np.float64).reshape(len(picture), -1)
    range_of = float(np.ptp(np.quantile(values, (0.01, 0.99))))
    return float(np.median(np.abs(np.diff(values, axis=1)))) / range_of if range_of > 0 and values.shape[1] > 1 else 0.0
