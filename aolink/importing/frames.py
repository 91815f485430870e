"""Frames of a film as a rig's camera would have taken them: their light, their times, and the exposures that they
belong to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aolink.assembly import Frame
from aolink.errors import ImportingError
from aolink.films.film import Film, FilmFrame
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.maxima import mended
from aolink.rig import Rig

_CLOSE = 0.01
"""Rates and exposure times that differ by a smaller share are the same."""
_EQUAL = 1e-4
"""Rates that differ by a smaller share need no word."""
_SHOWN = 10
"""Gaps of which a note says the length."""
_DAY_NS = 86_400_000_000_000
_LATEST_NS = 2**63
"""Nanoseconds since 1970 that a recording can hold."""
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
    row_time_s: float | None = None
    """As `BaseSensor.row_time_s`, where the rig file does not have it or is wrong; NaN: `look` is to find it."""
    places: tuple[tuple[float, float], ...] = ()
    """Places about which the windows of the rig's spots are cut out, (x, y) in pixels; empty: the frames are those of
    the rig's sensor."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImportedExposure:
    """The data that a session would have recorded for one exposure."""

    frame: Frame
    inputs: FloatArray
    """Inputs that the mirror held from the end of the exposure before this one to the end of this one, (steps,
    n_inputs)."""


@dataclass(kw_only=True, eq=False)
class FilmAccount:
    """Counts and notes for the user about how a film was read."""

    frames: int = 0
    """Frames that became exposures, and those of the file that are none."""
    exposures: int = 0
    left_out: str = ""
    """The frames of the file that are none, in words."""
    missing: int = 0
    """Frames that are missing between others, by their times."""
    saturated: int = 0
    """Pixels that are masked: at the end of their range in the film, hot or dead, or no numbers."""
    clipped: int = 0
    """Pixels whose counts do not fit into the rig's range, which are masked as well."""
    below: int = 0
    """Those of the clipped pixels that are below zero."""
    pixels: int = 0
    notes: tuple[str, ...] = ()

    @property
    def said(self) -> str:
        """How many frames there are, and how many are none or missing, in words."""
        missing = f", {self.missing} frames are missing" if self.missing else ""
        return f"{self.frames} frames{f': {self.left_out}' if self.left_out else ''}{missing}"


class FilmLight:
    """Pixel values as light: the gamma curve undone, background taken off, dark made bright."""

    def __init__(self, film: Film, settings: FilmSettings, defects: BoolArray | None = None) -> None:
        self._settings, self._defects = settings, defects
        kind = film.dtype.kind
        self.full_scale = film.full_scale
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


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameTimes:
    """The times of a film's frames, by their own clock."""

    periods: NDArray[np.int64]
    """Number of each frame in frame periods from the first on, (count,)."""
    starts_ns: NDArray[np.int64]
    """Start of each frame, ns since 1970, or from 0 where that is not known, (count,)."""
    rate_hz: float | None
    """Frames a second; None where they are not known."""
    notes: tuple[str, ...]
    """Notes for the user on what was taken, and on gaps."""

    @property
    def missing(self) -> int:
        """Number of frames that are missing between the first and the last."""
        return int(self.periods[-1]) + 1 - len(self.periods)


def film_times(film: Film, settings: FilmSettings) -> FrameTimes:
    """The times of a film's frames. Without times of their own no frame is missing, but for those that are known.

    A rate that is given goes before the times, which then say the order and the gaps alone. Raises `ImportingError`
    where the film's own rate and times contradict each other, or the times do not follow each other at a steady rate.
    """
    rate, notes = film.rate_hz, []
    given = None if settings.rate_hz is None else settings.rate_hz * film.share
    if given is not None:
        if rate is not None and abs(rate / given - 1) > _CLOSE:
            notes.append(f"the film says {rate:g} frames/s; {given:g} frames/s as given are taken")
        rate = given
    start = settings.start_ns if settings.start_ns is not None else film.start_ns or 0
    if None not in (settings.start_ns, film.start_ns) and settings.start_ns != film.start_ns:
        notes.append(f"the film says that it starts at {_date(film.start_ns)}; {_date(settings.start_ns)} is taken")
    lasts = film.count * 1e9 / (rate or 1.0) if film.times_ns is None else int(film.times_ns[-1] - film.times_ns[0])
    if not 0 <= start < _LATEST_NS - lasts - _DAY_NS:
        raise ImportingError(f"{film.name} has a start or an end that is not from 1970 to 2262: give --film start=DATE")
    periods = np.arange(film.count) if film.numbers is None else film.numbers - film.numbers[0]
    if film.times_ns is None or film.count < 2:
        if (gone := int(periods[-1]) + 1 - film.count - film.left_out) > 0:
            notes.append(f"by their numbers frames are missing: {gone}")
        since = np.rint(periods * (1e9 / rate if rate else 0.0)).astype(np.int64)
        return FrameTimes(periods=periods, starts_ns=start + since, rate_hz=rate, notes=tuple(notes))
    gaps = np.diff(film.times_ns) / 1e9
    usual = float(np.median(gaps))
    if usual <= 0 or (gaps <= 0).any():
        late = int(np.argmax(gaps <= 0)) + 1
        raise ImportingError(f"{film.name}: frame {late} is not later than the one before: its order or time is wrong")
    period = float(gaps[gaps < 1.5 * usual].mean())  # times may be rounded, so that the median is not exact
    counts = np.rint(gaps / period).astype(np.int64)
    off = np.abs(gaps / period - counts)
    if film.played and given is not None:
        counts = np.maximum(counts, 1)  # a player may come early or late
    elif (counts < 1).any() or (off > _IRREGULAR).any():
        worst = int(np.argmax(np.where(counts < 1, np.inf, off)))
        comes = f"frame {worst + 1} comes {gaps[worst]:.4g} s after the one before, at a frame period of {period:.4g} s"
        raise ImportingError(f"{film.name}: {comes}: only whole frames may be missing")
    periods[1:] = np.cumsum(counts)
    timed = 1 / period
    starts = start + film.times_ns - film.times_ns[0]
    if rate is not None and abs(rate / timed - 1) > _CLOSE and (given is not None or film.played):
        what = "it plays at" if film.played else "its times say"
        notes.append(f"{what} {timed:.6g} frames/s; {rate:g} frames/s as {'given' if given else 'it says'} are taken")
        starts, timed = np.int64(start) + np.rint(periods * 1e9 / rate).astype(np.int64), rate
    elif rate is not None and abs(rate / timed - 1) > _CLOSE:
        said = f"{rate:g} frames/s contradict its times, which say {timed:.6g}"
        raise ImportingError(f"{film.name}: {said}: give --rate {timed:.6g}, or another that is right")
    if (lost := np.flatnonzero(counts > 1)).size:
        each = ", ".join(f"{counts[k] - 1} after frame {k + 1} ({gaps[k]:.6g} s)" for k in lost[:_SHOWN])
        more = f", and {len(lost) - _SHOWN} gaps more" if len(lost) > _SHOWN else ""
        notes.append(f"{int((counts - 1).sum())} frames are missing by the times of the others: {each}{more}")
    return FrameTimes(periods=periods, starts_ns=starts, rate_hz=timed, notes=tuple(notes))


def frame_times(film: Film, rig: Rig, settings: FilmSettings) -> FrameTimes:
    """The times of a film's frames for a rig, and notes on what was assumed.

    Raises `ImportingError` where rate, times or exposure time contradict each other or the rig file; the message says
    what to change.
    """
    timing, K = rig.timing, settings.frames_per_exposure
    times = film_times(film, settings)
    rate, notes = times.rate_hz, list(times.notes)
    own = K / (timing.frame_period_steps * timing.fast_step_s)
    if rate is None:
        notes.append(f"the film does not state its frame rate: that of the rig file is assumed, {own:.6g} frames/s")
        since = np.rint(times.periods * 1e9 / own).astype(np.int64)
        times = replace(times, starts_ns=times.starts_ns + since, rate_hz=own)
    elif abs(rate / own - 1) > _CLOSE:
        each = f"{K} frames" if K > 1 else "a frame"
        whole = round(rate / own)
        summed = f"give --film sum={whole} as the rig file has it, " if K == 1 < whole == timing.exposure_steps else ""
        wanted = (
            f"wants {each} every {K / own:.6g} s, {own:.6g} frames/s: {summed}change its [timing], or give the right"
        )
        raise ImportingError(f"{film.name} has {rate:.6g} frames/s, and the rig file {rig.name} {wanted} --rate")
    elif abs(rate / own - 1) > _EQUAL:
        off = f"{rate / own - 1:+.2%} from the rig file's {own:.6g}"
        notes.append(f"the frames came at {rate:.6g} a second, {off}: exposures keep their own times")
    if K > 1 and settings.exposure_s is not None:
        raise ImportingError(f"--exposure {settings.exposure_s:g} is not used with --film sum={K}: leave it out")
    if K > 1 and (timing.exposure_steps, timing.frame_period_steps) != (K, K):
        wanted = f"set timing.exposure_steps = {K} and frame_period_steps = {K} in the rig file {rig.name}"
        raise ImportingError(f"--film sum={K} makes exposures of {K} fast steps without dead time: {wanted}")
    exposure_s = film.exposure_s
    if settings.exposure_s is not None:
        if exposure_s is not None and abs(exposure_s / settings.exposure_s - 1) > _CLOSE:
            notes.append(f"the film says {exposure_s:g} s a frame; {settings.exposure_s:g} s as given are taken")
        exposure_s = settings.exposure_s
    if exposure_s is not None and K == 1:
        own_s = timing.exposure_steps * timing.fast_step_s
        if abs(exposure_s / own_s - 1) > _CLOSE:
            own_is = f"the rig file {rig.name} says {own_s:.6g} s: change timing.exposure_steps, or give --exposure"
            raise ImportingError(f"{film.name} was exposed for {exposure_s:.6g} s a frame, {own_is}")
    return replace(times, notes=tuple(notes))


def _date(time_ns: int | None) -> str:
    return f"{np.datetime64(time_ns or 0, 'ns')}"


def nonlinear_note(film: Film) -> str:
    """A note for the user on a film that is `Film.nonlinear`, where no gamma curve is undone."""
    return f"light may not be linear: {film.nonlinear}; --film gamma=2.2 undoes the usual curve"


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
    account.below += int(np.count_nonzero((whole < 0) & usable))
    return np.clip(np.nan_to_num(whole), 0, rig.sensor.full_scale).astype(np.uint16), usable & ~outside


def default_scale(film: Film, full_scale: int) -> float:
    """Counts for a pixel value of one: full scale becomes full scale, but numbers of 16 bits stay as they are."""
    if film.dtype.kind in "iu":
        return 1.0 if film.dtype.itemsize > 1 else (full_scale + 1) / (film.full_scale + 1)
    return float(full_scale)


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
    group: Group, times: FrameTimes, rig: Rig, frames: int, pixels: NDArray[np.uint16], mask: NDArray[np.bool_],
    rows_unknown: bool = False,
) -> Frame:  # fmt: skip
    """The frame of an exposure of ``frames`` frames of a film: its steps are the rig's, its times the film's."""
    timing, period = rig.timing, group.first_period // frames
    first = period * timing.frame_period_steps
    start_ns = int(times.starts_ns[group.first_frame])
    end_ns = start_ns + timing.exposure_steps * timing.fast_step_ns
    since = start_ns - int(times.starts_ns[0])
    return Frame(
        frame_id=period + 1, first_step=first, last_step=first + timing.exposure_steps - 1, pixels=pixels, mask=mask,
        chunks_lost=0, frames_lost_before=0, device_start_ns=since, device_end_ns=since + end_ns - start_ns,
        host_first_byte_ns=end_ns, host_receive_ns=end_ns, host_start_ns=start_ns, clock_sigma_ns=math.nan,
        exposure_offset_ns=timing.exposure_offset_ns, rows_unknown=rows_unknown,
    )  # fmt: skip
