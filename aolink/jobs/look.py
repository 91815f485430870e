"""The job of `aolink look`: what moves in a film, without a rig file.

Spots on a dark ground are cut out and measured as the estimators measure them; anything else is measured by its texture
(`aolink.jobs.look_texture`). Both give the mean and the covariance of the path in each exposure, and one likelihood
finds the vibrations in these (`aolink.identification.vibration`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TypedDict

import numpy as np
from scipy import signal

from aolink.errors import IdentificationError, ImportingError
from aolink.films.film import Film
from aolink.identification import FEWEST, Readings, bands, kinds_of, maxima, readings, space_of
from aolink.identification.bands import BandsFound
from aolink.identification.models import Process, ProcessSum
from aolink.identification.row_time import Pair
from aolink.identification.row_time import pairs as pairs_of
from aolink.identification.vibration import MOST_LINES, SLOWEST, Found, Line, PathMoments, find
from aolink.importing.frames import FilmLight, FilmSettings, film_times, nonlinear_note
from aolink.jobs.look_follow import REACH, travels
from aolink.jobs.look_rows import as_moments, assumed, bands_of, find_target, grade_of, of_pairs
from aolink.jobs.look_scene import LEAST_MOTION, FastSteps, Scene, first_of, region_text
from aolink.jobs.look_spots import Spots, find_spots
from aolink.jobs.look_texture import Followed, Region, beside, lively, measured
from aolink.limits import check_room
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.numerics.single_thread import by_one_thread
from aolink.optics.texture import MARGIN, turned_covariances

FRAMES = 500
"""Frames that are looked at, from the first on."""
_CERTAIN = 2.0
"""Motion that chance does not show, in standard deviations."""
_KERNEL_KNOWN = 0.25
"""Standard deviation of what is not known of a kernel's variance, as a share of it."""
_ROUND = 0.3
"""Smaller half axis of a motion, over the kernel, from which on it makes that look wider."""
_UNEXPLAINED = 0.3
"""Share of a vibration's motion that may be left of the means where its path is believed."""
_MISFIT = 4.0
"""Mean square of what is left of the blur's covariances, over their noise, from which on the path is not believed."""
_SATURATED = 0.5
"""Share of the frames with saturated pixels in a spot from which on there is no answer."""
_COMPARABLE = 0.2
"""Size of the last of the most lines that are looked for, over that of the first, from which on there are more."""
_FEW = 3
"""Frequencies in a set, of more the blur says next to nothing."""
_WIDEST = 8.0
"""Standard deviation of a spot, pixels, from which on what it shows is measured by its texture."""
_SLOW = 4
"""A vibration up to so many times slower than the slowest one is a part of a wandering where much else is left."""
_LEAST_WANDERING = 0.05
"""Smallest wandering that may be taken for a vibration, pixels rms."""
_SLOWEST_OF_WANDERING = 12
"""Frames in a cycle of the slowest vibration beside a wandering."""
_FLICKER = 0.01
"""Change of the light from frame to frame that is spoken of."""
_APART = 0.2
"""Share of a motion by which two parts that move alike may move apart."""
_REGIONS = 3
"""Parts of a picture of anything that are looked at."""
_HARMONICS = 6
_SAME = 2.0
"""Frequencies nearer than so many inverses of the film's length are the same."""
_WANDERS = ("random-walk", "ornstein-uhlenbeck")
GRADES = ("believe it", "believe the frequency, not the path", "no answer")
Tell = Callable[[str, int, int], None]


class Common(TypedDict):
    """What every answer says of its film."""

    rate_hz: float
    exposure_s: float
    frames: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Looked:
    """What a film shows."""

    rate_hz: float
    exposure_s: float
    frames: int
    seen: PathMoments
    """Of the spots, or of the region."""
    found: Found
    moved: float
    """Standard deviation of the places from frame to frame, in all directions, pixels."""
    blur: float
    """Root mean square of the path about its mean in a frame, pixels, as far as it changes or is explained."""
    grade: int
    """Index of `GRADES`."""
    because: str
    """Why it is not the first grade; empty where it is."""
    plain_hz: float
    """What a plain spectrum of the places says."""
    sd: float
    """Standard deviation of the kernel of spots, pixels; NaN for a region."""
    spots: Spots | None
    scene: Scene | None
    together: bool
    """Whether several spots have one motion in common."""
    regions: tuple[Region, ...]
    picture: FloatArray
    """Mean of the frames, (rows, columns)."""
    cut: FloatArray
    """The pixels of the spot or region in each frame, (frames, rows, columns)."""
    camera: bool
    """Whether all of the picture moves alike: the camera."""
    assumed: tuple[str, ...]
    """What was assumed, and what follows where it is wrong."""
    doubts: tuple[str, ...]
    """What else to know."""
    text: str = ""
    """The rig file; empty where there is none."""
    recorded: tuple[Film, FilmSettings] | None = None
    """What makes its recording."""
    rows: BandsFound | None = None
    """Of a target in a film that was exposed row by row."""
    pairs: tuple[Pair, ...] = ()
    """Of its first line, where the row time was to be found: frequencies with their row times, the first one shown."""

    @property
    def lines(self) -> tuple[Line, ...]:
        """The vibrations, without harmonics of the first."""
        return tuple(line for line, n in zip(self.found.lines, self.harmonics, strict=True) if n == 1)

    @property
    def harmonics(self) -> tuple[int, ...]:
        """Of each line, which harmonic of the first one it is (or an alias of that); 1 where it is none."""
        numbers = [1] * len(self.found.lines)
        for k, each in enumerate(self.found.lines[1:], 1):
            for n in range(2, _HARMONICS + 1):
                off = abs(each.hz - n * self.found.lines[0].hz)
                alias = [abs(s * each.hz - n * self.found.lines[0].hz) for s in (1, -1)]
                if self.rows is None:  # rows tell aliases apart
                    off = min(abs(a - self.rate_hz * round(a / self.rate_hz)) for a in alias)
                if off < _SAME * (n + 1) / self.seen.span_s:
                    numbers[k] = n
                    break
        return tuple(numbers)

    def path(self, times_s: FloatArray) -> FloatArray:
        """The path by the vibrations, about its drift, x and y, pixels, at times since the film's begin, (..., 2)."""
        middle = float(self.seen.times_s.mean())
        t = times_s - middle
        out = np.zeros((*times_s.shape, 2))
        for line in self.found.lines:
            a = line.at((t / (self.seen.span_s / 2)).ravel()).reshape(*times_s.shape, 2)
            out += (a * np.exp(2j * np.pi * line.hz * t)[..., None]).real
        return out

    @property
    def places(self) -> FloatArray:
        """The mean place of the first spot or region in each exposure, x and y, pixels, (K, 2); NaN where unknown."""
        known = np.isfinite(self.seen.mean_variance[:, 0])
        return np.asarray(np.where(known, self.seen.mean[:, 0], np.nan) @ self.seen.axes[0])

    @property
    def rest(self) -> float:
        """Standard deviation of what the vibrations leave of the places, in all directions, pixels."""
        return _left(self.seen, self.found)

    @property
    def sees_all(self) -> bool:
        """Whether the motion is seen in all directions."""
        known = np.isfinite(self.seen.mean_variance).any(axis=0)
        return bool((known.sum(axis=1) == known.shape[1]).any())

    @property
    def estimator(self) -> str:
        """The estimator of the path in the recording."""
        return "moments" if self.spots is None else "profile"

    @property
    def moves(self) -> bool:
        """Whether anything moves."""
        return bool(self.found.lines) or self.moved > 0


@by_one_thread  # its many small problems take several times as long on a busy machine otherwise
def look(
    film: Film, settings: FilmSettings, name: str, *, kernel: float | None = None, frames: int = FRAMES,
    at: tuple[float, float] | None = None, size: int = 40, tell: Tell = lambda what, done, of: None,
) -> Looked:  # fmt: skip
    """Find out what moves in a film, and how.

    Parameters
    ----------
    name:
        The name of the rig.
    kernel:
        Standard deviation of a resting spot, pixels, where it is known.
    frames:
        Number of frames that are looked at, from the first on.
    at:
        Middle (x, y) of the region to look at, instead of what moves most; ``size`` is its side, pixels.
    tell:
        Called with the present task, how much of it is done, and how much there is.

    Raises
    ------
    ImportingError
        Rate or exposure time are not known, nothing can be measured, or there are too few frames.
    """
    if film.slopes:
        raise ImportingError(f"{film.name} has slopes and no pictures: there is nothing to look at")
    times = film_times(film, settings)
    rate, exposure_s = times.rate_hz, settings.exposure_s or film.exposure_s
    if missing := [f"--{what}" for what, value in (("rate HZ", rate), ("exposure S", exposure_s)) if value is None]:
        raise ImportingError(
            f"{film.name} does not say {'how many frames a second it has' if rate is None else ''}"
            f"{' and ' if len(missing) == 2 else ''}{'how long each was exposed' if exposure_s is None else ''}:"
            f" give {' and '.join(missing)}"
        )
    assert rate is not None
    assert exposure_s is not None
    if not 0 < exposure_s * rate <= 1.01:
        raise ImportingError(f"frames of {exposure_s:g} s do not fit into {1 / rate:g} s from one to the next")
    count = min(frames, film.count)
    if count < FEWEST:
        raise ImportingError(f"{film.name} has {film.count} frame(s): {FEWEST} are needed to tell what moves")
    starts = np.arange(count) / rate
    if film.times_ns is not None:
        starts = (film.times_ns[:count] - film.times_ns[0]) / 1e9
    common = Common(rate_hz=rate, exposure_s=exposure_s, frames=count)
    if settings.row_time_s:
        by_rows = _of_rows(film, settings, starts + exposure_s / 2, common, at, size, tell)
        if by_rows is not None:
            return by_rows
    if at is None and (spots := _spots(film, settings, count, tell)) is not None:
        return _of_spots(film, settings, name, spots, kernel, starts + exposure_s / 2, common, tell)
    return _of_regions(film, settings, name, starts + exposure_s / 2, common, at, size, tell)


def _spots(film: Film, settings: FilmSettings, count: int, tell: Tell) -> Spots | None:
    """The spots of a film; None where it shows something else."""
    try:
        spots = find_spots(film, settings, count, lambda done: tell("read", done, 2 * count))
    except ImportingError:
        return None
    return spots if spots.alone and spots.sd < _WIDEST else None


def _of_spots(
    film: Film, settings: FilmSettings, name: str, spots: Spots, kernel: float | None, times_s: FloatArray,
    common: Common, tell: Tell,
) -> Looked:  # fmt: skip
    rate, exposure_s = common["rate_hz"], common["exposure_s"]
    sd = spots.sd if kernel is None else kernel
    scene = Scene(film, spots, film_times(film, settings), rate, exposure_s, name)
    n = len(spots.corners)
    seen = [[readings(*scene.along(d, k, sd)) for d in (0, 1)] for k in range(n)]
    moments = _path_moments(seen, scene.unit, times_s, exposure_s, rate, 0.0 if kernel else sd)
    together = n > 1 and _one_motion(list(zip(*seen, strict=True)))
    each = moments.together() if together else moments.part([0])
    found = vibrations(each, MOST_LINES, lambda done, of: tell("frequencies", done, of))
    if kernel is None and found.lines and found.lines[0].ellipse[1] > _ROUND * sd:
        # What swings across the motion was taken for the kernel.
        sd = math.sqrt(max(sd**2 + float(found.constant[:, [0, 2]].mean()), 0.25 * sd**2))
    moved, sure = _moved(each)
    blurs = np.nan_to_num(np.median(each.spread[:, 0, [0, 2]], axis=0)) - found.constant[0, [0, 2]]
    spread = math.sqrt(max(float(blurs.sum()), 0.0))
    walks = () if found.lines else tuple(_wandering([one[d] for one in seen], scene) for d in (0, 1))
    text = scene.text(sd, _models(found, scene.unit, each) if found.lines else walks, together=together)
    doubts = [*_of_film(film), *_doubts(spots)]
    if not together and n > 1:
        doubts.append("the spots move on their own: the first, brightest one is described")
    looked = Looked(
        **common, seen=each, found=found, moved=moved if moved > max(LEAST_MOTION, _CERTAIN * sure) else 0.0,
        blur=spread, grade=0, because="", plain_hz=_plain(each, found), sd=sd, spots=spots, scene=scene,
        together=together, text=text, regions=(), picture=spots.mean, cut=spots.light[:, 0], camera=False,
        recorded=(scene.cut(sd), scene.settings),
        assumed=tuple(_assumed(film, settings, common, spots, kernel, sd)), doubts=tuple(doubts),
    )  # fmt: skip
    return _graded(looked)


def _of_regions(
    film: Film, settings: FilmSettings, name: str, times_s: FloatArray, common: Common,
    at: tuple[float, float] | None, size: int, tell: Tell,
) -> Looked:  # fmt: skip
    """What moves in up to four regions of a picture of anything."""
    count = common["frames"]
    light = FilmLight(film, settings)
    rows, columns = film.shape
    least = 2 * MARGIN + 8
    size = min(size, rows - 2 * MARGIN, columns - 2 * MARGIN)
    if size < least:
        raise ImportingError(f"{film.name} has {columns} x {rows} pixels: that is too small to look at a part of it")
    gone = travels(_shown(film, light, count, tell))
    if at is None:
        regions, still, picture = lively(_shown(film, light, count, tell, 1), size, _REGIONS, gone)
        if not regions:
            raise ImportingError(f"{film.name} shows nothing that moves: all frames are the same picture")
    else:
        x, y = (round(value - size / 2) for value in at)
        if not (MARGIN <= x <= columns - size - MARGIN and MARGIN <= y <= rows - size - MARGIN):
            raise ImportingError(
                f"--at {at[0]:g},{at[1]:g} with --size {size} goes over the picture's edge, which has {columns} x"
                f" {rows} pixels: choose a place at least {size // 2 + MARGIN} pixels from it"
            )
        regions = [Region(x, y, size, size)]
        _, still, picture = lively(_shown(film, light, count, tell, 1), size, 1, gone)
    whole = np.rint(gone).astype(np.int64)
    all_regions, around = [*regions, *([still] if still else [])], MARGIN + REACH
    side = size + 2 * around
    check_room(8 * len(all_regions) * count * side**2, f"parts of {size} pixels of {count} frames", ImportingError)
    cuts = np.empty((len(all_regions), count, side, side))
    for k, shown in enumerate(_shown(film, light, count, tell, 2)):
        for number, region in enumerate(all_regions):
            cuts[number, k] = region.cut(shown, around, whole[k])
    every: list[Followed] = []
    for number, (region, cut) in enumerate(zip(all_regions, cuts, strict=True)):
        tell("regions", number, len(cuts))
        one = measured(region, cut, whole, times_s, common["exposure_s"], common["rate_hz"])
        every += [one] if one else []
    if not every or (at is not None and every[0].region is not regions[0]):
        raise ImportingError(f"{film.name}: what is there does not stay in view: choose a place with --at X,Y")
    rest = every[-1] if every[-1].region is still and len(every) > 1 else None
    travelling = bool(gone.any()) and len(every) > 1
    if travelling:  # what moves as another region does is the rest of the picture, wherever the search has put that
        rest = min(every[at is not None :], key=lambda one: _apart(one, every) * (0.5 if one.region is still else 1.0))
    results = [(each, each.moments, vibrations(each.moments, 2)) for each in every if each is not rest]
    doubts = list(_of_film(film))
    if travelling and rest:
        beside_rest = [(each, beside(each.moments, rest.moments)) for each, _, _ in results]
        relative = [(each, seen, vibrations(seen, 2)) for each, seen in beside_rest if seen is not None]
        # What is left of a travel by interpolation is no motion.
        lines = [line for _, _, found in relative for line in found.lines[:1]]
        if travelling := any(_shown_by(line, common["exposure_s"]) > LEAST_MOTION for line in lines):
            results = relative
            doubts.append("the motion of the whole picture, as of a camera in the hand, is taken out")
    best, seen, found = strongest = max(results, key=lambda one: _strength(*one[1:]))
    if found.lines and (quarter := best.livelier_quarter(found.lines[0].hz)):
        doubts.append("parts of this region move in different ways: the quarter that moves most is described")
        best, seen = quarter, quarter.moments
        if travelling and rest:
            seen = beside(seen, rest.moments) or seen
        found = vibrations(seen, 2)
    camera = rest is not None and _moves_alike(seen, rest.moments)
    if camera:
        doubts.append("all of the picture moves alike: it is the camera that moves")
    elif rest is None:
        doubts.append("nothing else in the picture has edges, so a camera that moves would not show")
    flicker = signal.detrend(best.windows.mean(axis=(1, 2))).std() / abs(best.windows.mean())
    if flicker > _FLICKER:
        doubts.append(f"the light flickers by {flicker:.1%} rms, as lamps on mains do: that is taken out")
    # Another alias is the same motion, less well seen.
    rate, own = common["rate_hz"], [_alias(line.hz, common["rate_hz"]) for line in found.lines]
    tops = [each.lines[0].hz for _, _, each in results if each.lines]
    others = sorted({f"{hz:.3g}" for hz in tops if all(abs(_alias(hz, rate) - a) > _SAME / seen.span_s for a in own)})
    if others and not camera:
        doubts.append(f"other parts of the picture vibrate at {' and '.join(others)} Hz: choose one with --at X,Y")
    moved, sure = _moved(seen)
    looked = Looked(
        **common, seen=seen, found=found, moved=moved if moved > max(LEAST_MOTION, _CERTAIN * sure) else 0.0,
        blur=0.0, grade=0, because="", plain_hz=_plain(seen, found), sd=math.nan, spots=None, scene=None,
        together=False, picture=picture,
        regions=(best.region, *(one[0].region for one in results if one is not strongest)), cut=best.windows,
        camera=camera, assumed=tuple(_assumed(film, settings, common, None, None, math.nan)), doubts=tuple(doubts),
    )  # fmt: skip
    if found.lines and not travelling and best.reach < MARGIN - 1:
        looked = _with_rig(looked, best, film, settings, name)
    return _graded(looked)


def _with_rig(looked: Looked, region: Followed, film: Film, settings: FilmSettings, name: str) -> Looked:
    """With the rig file of a region that stays in its place, and what is to be recorded."""
    seen, found = looked.seen, looked.found
    reference, noise = region.reference()
    known = np.isfinite(seen.spread_variance[:, 0]).any(axis=0)
    blur = turned_covariances(seen.axes[0].T) @ np.where(known, -found.constant[0], 0.0)
    film, steps = first_of(film, looked.frames), FastSteps.of(looked.rate_hz, looked.exposure_s)
    side, first = len(reference), region.region
    middle = (first.x - MARGIN + (side - 1) / 2, first.y - MARGIN + (side - 1) / 2)
    text = region_text(name, film, steps, _models(found, 1.0, seen), reference, noise, blur, middle)
    return replace(looked, text=text, recorded=(film, replace(settings, places=(middle,))))


def _of_rows(
    film: Film, settings: FilmSettings, times_s: FloatArray, common: Common, at: tuple[float, float] | None, size: int,
    tell: Tell,
) -> Looked | None:  # fmt: skip
    """What moves a line or an edge that goes through many rows, each of which is exposed at its own time; None where
    there is none."""
    assert settings.row_time_s is not None
    count, light = common["frames"], FilmLight(film, settings)
    target = find_target(_shown(film, light, count, tell), at, size)
    if target is None:
        return None
    rate, exposure_s, row_time_s = common["rate_hz"], common["exposure_s"], settings.row_time_s
    pairs = list[Pair]()
    if math.isnan(row_time_s):
        height = film.shape[0]
        longest = 1 / (rate * height)
        cut, _ = bands_of(_shown(film, light, count, tell, 1), target, times_s, longest, exposure_s, rate)
        pairs = pairs_of(bands.BandFit(cut), cut.delays_s.mean(axis=1) / longest, height)
        if not pairs:
            return None
        row_time_s = pairs[0].row_time_s
    cut, region = bands_of(_shown(film, light, count, tell, 1), target, times_s, row_time_s, exposure_s, rate)
    rows = bands.find(cut, tell=lambda done, of: tell("frequencies", done, of))
    seen, found = as_moments(rows, exposure_s, rate)
    moved, sure = _moved(seen)
    blurs = [abs(a) ** 2 / 2 * (1 - float(np.sinc(hz * exposure_s)) ** 2) for a, hz in rows.tones]
    grade, because = grade_of(rows, exposure_s, rate)
    if pairs and rows.tones:
        found, grade, because = of_pairs(found, pairs, grade, because)
    of_film, *others = _assumed(film, settings, common, None, None, math.nan)
    return Looked(
        **common, seen=seen, found=found, moved=moved if moved > max(LEAST_MOTION, _CERTAIN * sure) else 0.0,
        blur=math.sqrt(sum(blurs)), grade=grade, because=because, plain_hz=_plain(seen, found), sd=math.nan, spots=None,
        scene=None, together=False, regions=(region,), picture=target.mean, cut=cut.images, camera=False,
        assumed=(of_film, *assumed(rows, row_time_s, exposure_s), *others[1:]), doubts=tuple(_of_film(film)),
        rows=rows, pairs=tuple(pairs),
    )  # fmt: skip


def _shown(film: Film, light: FilmLight, count: int, tell: Tell, turn: int = 0) -> Iterator[FloatArray]:
    for k, frame in enumerate(islice(film.frames(), count)):
        tell("read", turn * count + k, 3 * count)
        yield light.of(frame)[0]


def vibrations(seen: PathMoments, most: int, tell: Callable[[int, int], None] = lambda done, of: None) -> Found:
    """The vibrations; where the slow part of a wandering hides or is taken for one, those that are faster."""
    found = find(seen, most, tell)
    if found.lines and not _wanders(seen, found):
        return found
    moved, sure = _moved(seen)
    if moved < max(LEAST_MOTION, _CERTAIN * sure):
        return found
    faster = find(seen, most, tell, slowest=_SLOWEST_OF_WANDERING)
    return faster if faster.lines and not _wanders(seen, faster) else found


def _wanders(seen: PathMoments, found: Found) -> bool:
    """Whether the strongest vibration is slow and leaves much of the motion: a part of a wandering."""
    line = found.lines[0]
    slow = _alias(line.hz, seen.rate_hz) < _SLOW * seen.rate_hz / SLOWEST
    return slow and _left(seen, found) > max(_UNEXPLAINED * _shown_by(line, seen.exposure_s), _LEAST_WANDERING)


def _alias(hz: float, rate_hz: float) -> float:
    """Where a frequency is in a plain spectrum, Hz."""
    return abs(hz - rate_hz * round(hz / rate_hz))


def _left(seen: PathMoments, found: Found) -> float:
    """Standard deviation of what the vibrations leave of the places, in all directions, pixels."""
    return math.sqrt(max(float((found.residual**2).sum(axis=2).mean()) - _noise(seen), 0.0))


def _shown_by(line: Line, exposure_s: float) -> float:
    """Standard deviation of the mean places of a vibration, pixels."""
    return line.ellipse[0] / math.sqrt(2) * abs(float(np.sinc(line.hz * exposure_s)))


def _strength(seen: PathMoments, found: Found) -> float:
    """How much of a vibration a region shows, in its noise."""
    if not found.lines:
        return 0.0
    noise = float(np.sqrt(np.nanmedian(np.where(np.isfinite(seen.mean_variance), seen.mean_variance, np.nan))))
    return found.lines[0].ellipse[0] / max(noise, 1e-12)


def _apart(one: Followed, every: Sequence[Followed]) -> float:
    """How much a region moves beside the one that moves most like it, pixels."""
    relative = [beside(other.moments, one.moments) for other in every if other is not one]
    return min((_moved(each)[0] for each in relative if each is not None), default=math.inf)


def _moves_alike(one: PathMoments, other: PathMoments) -> bool:
    """Whether two regions have one motion: what they move apart is little of what they move."""
    apart = beside(one, other)
    if apart is None:
        return False
    moved, sure = _moved(one)
    return moved > _CERTAIN * sure and _moved(apart)[0] < _APART * moved


def _path_moments(
    seen: Sequence[Sequence[Readings]], unit: float, times_s: FloatArray, exposure_s: float, rate: float, sd: float
) -> PathMoments:
    """Moments of the paths of spots from their readings along x and along y, pixels."""
    K, R = len(times_s), len(seen)
    mean, mean_variance = np.zeros((K, R, 2)), np.full((K, R, 2), np.inf)
    spread, spread_variance = np.zeros((K, R, 3)), np.full((K, R, 3), np.inf)
    for r, both in enumerate(seen):
        for d, one in enumerate(both):
            slots = np.rint((times_s - times_s[0]) * rate).astype(int)
            slots = np.minimum(slots, one.slots - 1)
            good = one.usable[0, slots]
            noise = one.mean_noise[0, slots]
            mean[:, r, d] = unit * (one.mean + one.centre)[0, slots]
            mean_variance[good, r, d] = unit**2 * noise[good]
            # The square about c of the mean has the noise of the mean in it.
            spread[:, r, 2 * d] = unit**2 * (one.square[0, slots] - one.mean[0, slots] ** 2 + noise)
            variance = one.square_noise[0, slots] + 4 * one.mean[0, slots] ** 2 * noise
            spread_variance[good, r, 2 * d] = unit**4 * variance[good]
    constant = np.full((R, 3), _KERNEL_KNOWN * sd**2 if sd else LEAST_MOTION)
    return PathMoments(
        times_s=times_s, exposure_s=exposure_s, rate_hz=rate, mean=mean, mean_variance=mean_variance, spread=spread,
        spread_variance=spread_variance, constant_sd=constant, axes=np.tile(np.eye(2), (R, 1, 1)),
    )  # fmt: skip


def _moved(seen: PathMoments) -> tuple[float, float]:
    """Standard deviation of the places beyond that of noise, in all directions, and that which noise alone may show."""
    known = np.isfinite(seen.mean_variance[:, 0])
    variance = square = 0.0
    for d in range(2):
        good = known[:, d]
        if good.sum() > 2:
            noise = seen.mean_variance[good, 0, d]
            variance += float(seen.mean[good, 0, d].var() - noise.mean())
            square += float(noise.mean()) * math.sqrt(2 / good.sum())
    return math.sqrt(max(variance, 0.0)), math.sqrt(square)


def _plain(seen: PathMoments, found: Found) -> float:
    """The frequency of the largest value of a plain spectrum of the places, Hz."""
    if not found.lines:
        return math.nan
    return _alias(found.lines[0].hz, seen.rate_hz)


def _models(found: Found, unit: float, seen: PathMoments) -> list[ProcessSum | None]:
    """The processes along x and y that estimate the path: a vibration that keeps its phase for a part of the film, with
    a damping of its own, and a drift."""
    models: list[ProcessSum | None] = []
    rest = np.nanmedian(np.where(np.isfinite(seen.mean_variance), seen.mean_variance, np.nan))
    left = float(found.residual.var() - rest)
    drift = (found.drift[:, 0] - found.drift[:, 0].mean(axis=0)) @ seen.axes[0]
    for d in range(2):
        parts = []
        for line in found.lines:
            sd = abs(line.amplitude[d]) / math.sqrt(2)
            if sd > LEAST_MOTION:
                cycles = max(2 * math.pi * line.hz * seen.span_s / 4, 4.0)
                parts.append(Process("resonance", (line.hz, 1 / cycles, sd / unit)))
        slow = math.sqrt(max(float(drift[:, d].var()) - rest, left, 0.0))
        if slow > LEAST_MOTION:
            parts.append(Process("ornstein-uhlenbeck", (seen.span_s / 10, slow / unit)))
        models.append(ProcessSum(tuple(parts)) if parts else None)
    return models


def _wandering(seen: Sequence[Readings], scene: Scene) -> ProcessSum | None:
    """The walk or the wandering that explains readings along a direction best."""
    best: tuple[float, ProcessSum | None] = (-math.inf, None)
    places = [((one.mean + one.centre)[one.usable], one.mean_noise[one.usable]) for one in seen]
    moved = float(np.mean([place.var() - noise.mean() for place, noise in places]))
    if scene.unit * math.sqrt(max(moved, 0.0)) <= LEAST_MOTION:
        return None
    for name in _WANDERS:
        space = space_of(kinds_of(name), seen, lowest_hz=scene.rate_hz / SLOWEST, highest_hz=None, plant=None)
        try:
            top = maxima(space, seen)[0]
        except IdentificationError:
            continue
        value = top.log_likelihood - len(space.names) * math.log(len(seen[0].mean[0])) / 2
        best = max(best, (value, space.model(top.x)), key=lambda each: each[0])
    return best[1]


def _one_motion(seen: Sequence[Sequence[Readings]]) -> bool:
    """Whether the mean places of several spots are one motion and noise, or motions of their own: by the likelihood,
    with the Bayesian information criterion."""
    gain = 0.0
    for spots in seen:
        usable: BoolArray = np.all([each.usable[0] for each in spots], axis=0)
        shown = np.array([(each.mean + each.centre)[0, usable] for each in spots])
        n, count = shown.shape
        if count < FEWEST:
            return False
        S = np.cov(shown, bias=True)
        common = max(float((S.sum() - np.trace(S)) / (n * (n - 1))), 0.0)
        noise = np.array([each.mean_noise[0, usable].mean() for each in spots])
        C = common + np.diag(np.maximum(np.diag(S) - common, noise))
        fit = np.log(np.diag(S)).sum() + n - np.linalg.slogdet(C)[1] - np.trace(np.linalg.solve(C, S))
        gain += count / 2 * float(fit) - math.log(count) / 2
    return gain > 0


def _graded(looked: Looked) -> Looked:
    """What was found with its grade, and why it is no better."""
    found, spots = looked.found, looked.spots
    if spots is not None and spots.saturated_frames > _SATURATED:
        return replace(looked, grade=2, because="the spot is saturated in most frames: expose less")
    if not found.lines:
        multiple = f"it is still, or vibrates at a multiple of {looked.rate_hz:.4g} Hz"
        whole = 1 / looked.exposure_s
        if abs(whole / looked.rate_hz - 1) > 0.02:
            multiple += f" or of {whole:.4g} Hz, whole swings in an exposure"
        wanders = f"it wanders by {looked.moved:.2g} pixels rms, and no frequency stands out of that"
        return replace(looked, grade=2, because=wanders if looked.moved else f"all frames look alike: {multiple}")
    line, parts = found.lines[0], found.sets[0]
    if len(looked.lines) == MOST_LINES and looked.lines[-1].ellipse[0] > _COMPARABLE * line.ellipse[0]:
        return replace(looked, grade=2, because="the motion is more than three vibrations")
    left = looked.rest
    shown = _shown_by(line, looked.exposure_s)
    if _wanders(looked.seen, found):
        wanders = f"it wanders by {looked.moved:.2g} pixels rms, and no frequency stands out of that"
        return replace(looked, grade=2, because=wanders)
    why = []
    if len(parts) > 1:
        small = "the blur is too small" if len(parts) > _FEW else "these frames are not enough"
        why.append(f"{small} to tell it from its aliases")
    if left > _UNEXPLAINED * max(shown, LEAST_MOTION) and left > LEAST_MOTION:
        why.append(f"the places move by {left:.2g} pixels rms that no vibration explains")
    if found.spread_misfit > _MISFIT:
        why.append("a part of the blur is not explained")
    if any(abs(each.growth) > 0.9 for each in found.lines):
        why.append("it grows or dies within the film")
    return replace(looked, grade=1 if why else 0, because="; ".join(why))


def _noise(seen: PathMoments) -> float:
    """Mean variance of a place by the pixels' noise, in all known directions, pixels squared."""
    variance = np.where(np.isfinite(seen.mean_variance), seen.mean_variance, 0.0)
    return float(variance.sum(axis=2).mean())


def _assumed(
    film: Film, settings: FilmSettings, common: Common, spots: Spots | None, kernel: float | None, sd: float
) -> Iterator[str]:
    """What was taken for granted, each with what follows where it is wrong."""
    rate, exposure_s = common["rate_hz"], common["exposure_s"]
    yield (
        f"frames come at {rate:.6g} a second, each exposed for {exposure_s:.4g} s: if it was taken at another rate, say"
        " --rate; with another exposure, aliases are told apart wrongly"
    )
    yield "all rows are exposed at the same time: with a rolling shutter lower rows are later, and the blur is bent"
    if spots is not None and kernel is None:
        yield f"a spot at rest is {sd:.3g} pixels wide (standard deviation), as across its motion; or give --kernel"
    if film.nonlinear and settings.gamma == 1.0:
        yield f"{nonlinear_note(film)}: if it is not linear, amplitudes are wrong"
    if spots is not None and spots.left_out:
        yield f"{spots.left_out} fainter spot(s) are left out: they may move in another way"
    if common["frames"] < film.count:
        yield f"the first {common['frames']:g} of {film.count} frames are used: later motion may differ"


def _of_film(film: Film) -> Iterator[str]:
    if film.account:
        yield f"{film.left_out} of {film.count + film.left_out} frames are missing: {film.account}"


def _doubts(spots: Spots) -> Iterator[str]:
    if spots.saturated > 0.001:
        yield f"{spots.saturated:.1%} of the pixels about the spots are saturated or hot and are left out: expose less"
    if spots.at_edge:
        yield "a spot is at the edge of the picture: what it does beyond is not seen"
