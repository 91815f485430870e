"""Frames of a film as a rig's camera would have taken them: their light, their times, and the exposures that they
belong to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aolink.assembly import Frame
from aolink.errors import ImportingError
from aolink.exposure import Truth
from aolink.importing.film import Film, FilmFrame
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.rig import Rig

_CLOSE = 0.01
"""Rates and exposure times that differ by a smaller share are the same."""
_IRREGULAR = 0.25
"""Frame periods by which a frame may come too early or too late."""


@dataclass(frozen=True, kw_only=True)
class FilmSettings:
    """The options with which a film is read."""

    rate_hz: float | None = None
    """Frames a second, where the film does not have it or is wrong."""
    exposure_s: float | None = None
    """Exposure time of a frame, where the film does not have it or is wrong."""
    start_ns: int | None = None
    """Start of the film, ns since 1970, where the film does not have it or is wrong."""
    gamma: float = 1.0
    """Exponent of the gamma curve: light was raised to its inverse before it was stored; 2.2 for most JPEG and
    video."""
    scale: float | None = None
    """Counts for a pixel value of one; None: full scale becomes full scale."""
    invert: bool = False
    """Whether objects are dark on a bright ground: light is then each frame's median less the pixel."""
    subtract_median: bool = False
    """Whether each frame's median is background, which is subtracted."""
    frames_per_exposure: int = 1
    """Number of frames of a fast film whose mean becomes one exposure."""
    track: int = 0
    """Number of objects that are followed, each in a window of its own; 0: the frames are those of the rig's sensor."""
    places: tuple[tuple[float, float], ...] = ()
    """Places of these objects in the first frame, (x, y) in pixels; empty: the brightest ones that are not at an
    edge."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImportedExposure:
    """The data that a session would have recorded for one exposure."""

    frame: Frame
    inputs: FloatArray
    """Inputs that the mirror held from the end of the exposure before this one to the end of this one, (steps,
    n_inputs)."""
    truth: Truth | None = None
    """The motion as measured in the single frames."""


@dataclass(kw_only=True, eq=False)
class FilmAccount:
    """Counts and notes for the user about how a film was read."""

    frames: int = 0
    exposures: int = 0
    saturated: int = 0
    """Pixels that are masked: at the end of their range in the film, hot or dead, no numbers, or with the light of two
    objects."""
    clipped: int = 0
    """Pixels whose counts do not fit into the rig's range, which are masked as well."""
    pixels: int = 0
    notes: tuple[str, ...] = ()


class FilmLight:
    """Pixel values as light: the gamma curve undone, background taken off, dark made bright."""

    def __init__(self, film: Film, settings: FilmSettings, defects: BoolArray | None = None) -> None:
        self._settings, self._defects = settings, defects
        kind = film.dtype.kind
        self.full_scale = float(np.iinfo(film.dtype.name).max) if kind in "iu" else 1.0
        """The largest value that a pixel can hold."""
        self.step = settings.gamma if kind in "iub" else 0.0
        """Largest step of light from one value to the next; zero where it is not known."""
        # A saturated background does not harm a dark object.
        self._saturated = math.inf if settings.invert else film.saturates_at

    def of(self, frame: FilmFrame) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Light of a frame and where its pixels are saturated, hot or dead, or no numbers, (rows, columns) each.

        Hot and dead pixels are replaced by the light about them.
        """
        settings = self._settings
        values = frame.astype(np.float64)
        bad = (values >= self._saturated) | ~np.isfinite(values)
        if not (known := np.isfinite(values)).all():
            values[~known] = np.median(values[known]) if known.any() else 0.0  # as dark as the ground
        if settings.gamma != 1.0:
            values = self.full_scale * np.maximum(values / self.full_scale, 0.0) ** settings.gamma
        if settings.subtract_median or settings.invert:
            values -= np.median(values)
        if self._defects is not None and self._defects.any():
            values, bad = mended(values, self._defects), bad | self._defects
        return (-values if settings.invert else values), bad


def mended(values: FloatArray, defects: BoolArray) -> FloatArray:
    """A picture whose ``defects`` are interpolated from the pixels about them, (rows, columns).

    The weights of the neighbours are those of a product of parabolas along x and y; where another defect is among
    them, their median is taken.
    """
    known = np.pad(np.where(defects, np.nan, values), 1, mode="reflect")
    rows, columns = np.nonzero(defects)
    around = np.array([[known[rows + i, columns + j] for j in range(3)] for i in range(3)])
    if (lost := np.isnan(around).all(axis=(0, 1))).any():
        around[1, 1, lost] = np.median(values)
    beside = around[0, 1] + around[2, 1] + around[1, 0] + around[1, 2]
    across = around[0, 0] + around[0, 2] + around[2, 0] + around[2, 2]
    middle = np.nanmedian(around.reshape(9, -1), axis=0)
    whole = values.copy()
    whole[defects] = np.where(np.isfinite(beside + across), beside / 2 - across / 4, middle)
    return whole


def frame_times(film: Film, rig: Rig, settings: FilmSettings) -> tuple[NDArray[np.int64], list[str]]:
    """Number of each frame in frame periods from the first on, (count,), and notes on what was assumed.

    Raises `ImportingError` where rate, times or exposure time contradict each other or the rig file; the message says
    what to change.
    """
    timing, K = rig.timing, settings.frames_per_exposure
    periods, rate, notes = film_rate(film, settings)
    own = K / (timing.frame_period_steps * timing.fast_step_s)
    if rate is None:
        notes.append(f"the film does not state its frame rate: that of the rig file is assumed, {own:.6g} frames/s")
    elif abs(rate / own - 1) > _CLOSE:
        each = f"{K} frames" if K > 1 else "a frame"
        whole = round(rate / own)
        summed = f"give --sum {whole} as the rig file has it, " if K == 1 < whole == timing.exposure_steps else ""
        raise ImportingError(
            f"{film.name} has {rate:.6g} frames/s, and the rig file {rig.name} wants {each} every"
            f" {timing.frame_period_steps * timing.fast_step_s:.6g} s, {own:.6g} frames/s: {summed}change its"
            " [timing], or give the right --rate"
        )
    if K > 1 and settings.exposure_s is not None:
        raise ImportingError(
            f"--exposure {settings.exposure_s:g} is not used with --sum {K}, where each frame is a whole fast step:"
            " leave it out"
        )
    if K > 1 and (timing.exposure_steps, timing.frame_period_steps) != (K, K):
        raise ImportingError(
            f"--sum {K} makes exposures of {K} fast steps without dead time: set timing.exposure_steps = {K} and"
            f" frame_period_steps = {K} in the rig file {rig.name}"
        )
    exposure_s = film.exposure_s
    if settings.exposure_s is not None:
        if exposure_s is not None and abs(exposure_s / settings.exposure_s - 1) > _CLOSE:
            notes.append(f"the film says {exposure_s:g} s a frame; {settings.exposure_s:g} s as given are taken")
        exposure_s = settings.exposure_s
    if exposure_s is not None and K == 1:
        own_s = timing.exposure_steps * timing.fast_step_s
        if abs(exposure_s / own_s - 1) > _CLOSE:
            raise ImportingError(
                f"{film.name} was exposed for {exposure_s:.6g} s a frame, the rig file {rig.name} says {own_s:.6g} s:"
                " change timing.exposure_steps, or give the right --exposure"
            )
    if None not in (settings.start_ns, film.start_ns) and settings.start_ns != film.start_ns:
        notes.append(f"the film says that it starts at {_date(film.start_ns)}; {_date(settings.start_ns)} is taken")
    return periods, notes


def _date(time_ns: int | None) -> str:
    return f"{np.datetime64(time_ns or 0, 'ns')}"


def nonlinear_note(film: Film) -> str:
    """A note for the user on a film that is `Film.nonlinear`, where no gamma curve is undone."""
    return f"light may not be linear: {film.nonlinear}; --gamma 2.2 undoes the usual curve"


def film_rate(film: Film, settings: FilmSettings) -> tuple[NDArray[np.int64], float | None, list[str]]:
    """`film_periods`, frames a second where they are known, and notes on what was taken.

    Raises `ImportingError` where the rate and the times contradict each other, or the times are damaged.
    """
    rate, notes = film.rate_hz, []
    if settings.rate_hz is not None:
        if rate is not None and abs(rate / settings.rate_hz - 1) > _CLOSE:
            notes.append(f"the film says {rate:g} frames/s; {settings.rate_hz:g} frames/s as given are taken")
        rate = settings.rate_hz
    periods, timed = film_periods(film)
    if timed is not None and rate is not None and abs(rate / timed - 1) > _CLOSE:
        raise ImportingError(
            f"{film.name}: {rate:g} frames/s contradict its times, which say {timed:.6g}: give --rate {timed:.6g}, or a"
            " file with the right times"
        )
    return periods, timed or rate, notes


def film_periods(film: Film) -> tuple[NDArray[np.int64], float | None]:
    """Number of each frame in frame periods from the first on, (count,), and frames a second, by the film's times;
    without times no frame is missing, and the rate is None.

    Raises `ImportingError` where the times do not follow each other at a steady rate.
    """
    periods = np.arange(film.count, dtype=np.int64)
    if film.times_ns is None or film.count < 2:
        return periods, None
    gaps = np.diff(film.times_ns) / 1e9
    period = float(np.median(gaps))
    if period <= 0 or (gaps <= 0).any():
        late = int(np.argmax(gaps <= 0)) + 1
        raise ImportingError(
            f"{film.name}: frame {late} is not later than the one before: frames are not in the order of their times,"
            " or the times are damaged"
        )
    counts = np.rint(gaps / period).astype(np.int64)
    off = np.abs(gaps / period - counts)
    if (counts < 1).any() or (off > _IRREGULAR).any():
        worst = int(np.argmax(np.where(counts < 1, np.inf, off)))
        raise ImportingError(
            f"{film.name}: frame {worst + 1} comes {gaps[worst]:.4g} s after the one before, at a frame period of"
            f" {period:.4g} s: exposures must follow at a steady rate, only whole frames may be missing"
        )
    periods[1:] = np.cumsum(counts)
    return periods, 1 / period


def counts_of(
    counts: FloatArray, usable: NDArray[np.bool_], rig: Rig, account: FilmAccount
) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Whole counts and the mask of the pixels that can be used, (rows, columns) each; the other pixels are counted in
    ``account``."""
    whole = np.rint(counts)
    outside = ~((whole >= 0) & (whole <= rig.sensor.full_scale))  # also what is no number
    account.pixels += whole.size
    account.saturated += int(np.count_nonzero(~usable))
    account.clipped += int(np.count_nonzero(outside & usable))
    return np.clip(np.nan_to_num(whole), 0, rig.sensor.full_scale).astype(np.uint16), usable & ~outside


def default_scale(film: Film, rig: Rig) -> float:
    """Counts for a pixel value of one: full scale becomes full scale, but numbers of 16 bits stay as they are."""
    if film.dtype.kind in "iub" and film.dtype.itemsize > 1:
        return 1.0
    if film.dtype.kind == "b":
        return float(rig.sensor.full_scale)
    if film.dtype.kind in "iu":
        return float(2.0 ** (rig.sensor.bit_depth - 8))
    return float(rig.sensor.full_scale)


@dataclass(frozen=True, eq=False)
class Group:
    """Frames that become one exposure."""

    first_period: int
    """Frame periods from the start of the film to its first frame."""
    first_frame: int
    """Number of its first frame in the film, from 0."""
    mean: FloatArray
    """Mean of the light of its frames, (rows, columns)."""
    bad: NDArray[np.bool_]
    """Pixels that are bad in one of its frames or more."""


def grouped(
    film: Film, count: int, periods: NDArray[np.int64],
    light: Callable[[FilmFrame], tuple[FloatArray, NDArray[np.bool_]]],
) -> Iterator[Group]:  # fmt: skip
    """Frames by exposures, each frame's ``light`` summed as it comes; a film that lost a frame goes on with the next
    whole exposure."""
    held = first = 0
    total, bad = np.zeros(film.shape), np.zeros(film.shape, dtype=np.bool_)
    for k, frame in enumerate(film.frames()):
        if held and periods[k] != periods[k - 1] + 1:
            held = 0
        if not held:
            if periods[k] % count:
                continue  # exposures stay at multiples of one period, as a camera's do
            first = k
        shown, wrong = light(frame)
        total, bad = (total + shown, bad | wrong) if held else (shown, wrong)
        held += 1
        if held == count:
            yield Group(int(periods[first]), first, total / count, bad)
            held = 0


def rig_frame(
    film: Film, rig: Rig, settings: FilmSettings, period: int, pixels: NDArray[np.uint16], mask: NDArray[np.bool_]
) -> Frame:
    """The frame of an exposure that begins the given number of the rig's frame periods after the film."""
    timing = rig.timing
    first = period * timing.frame_period_steps
    began_ns = settings.start_ns if settings.start_ns is not None else film.start_ns or 0
    start_ns = began_ns + round(first * timing.fast_step_s * 1e9)
    end_ns = start_ns + timing.exposure_steps * timing.fast_step_ns
    return Frame(
        frame_id=period + 1, first_step=first, last_step=first + timing.exposure_steps - 1, pixels=pixels, mask=mask,
        chunks_lost=0, frames_lost_before=0, device_start_ns=first * timing.fast_step_ns,
        device_end_ns=(first + timing.exposure_steps) * timing.fast_step_ns, host_first_byte_ns=end_ns,
        host_receive_ns=end_ns, host_start_ns=start_ns, clock_sigma_ns=math.nan,
        exposure_offset_ns=timing.exposure_offset_ns,
    )  # fmt: skip
