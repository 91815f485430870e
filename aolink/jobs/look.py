"""The job of `aolink look`: what moves in a film of spots, without a rig file.

The spots are found and cut out, their kernel is taken from the frames (`aolink.jobs.look_spots`), a model of the
motion is identified along x and along y, and the path inside each exposure is estimated with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from aolink.errors import IdentificationError, ImportingError
from aolink.estimation import run
from aolink.estimation.score import Score
from aolink.estimation.verdict import ADVICE, Fit, Verdict
from aolink.films.film import Film
from aolink.identification import FEWEST, Identified, Maximum, Piece, Readings, kinds_of, maxima, readings
from aolink.identification.likelihood import Likelihood
from aolink.identification.models import ProcessSum
from aolink.importing.frames import FilmSettings, film_times, nonlinear_note
from aolink.jobs.identify import IdentifiedModel, Wanted, from_readings, space_wanted
from aolink.jobs.look_scene import LEAST_MOTION, Scene
from aolink.jobs.look_spots import Spots, find_spots
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig, parse_rig

FRAMES = 300
"""Frames that are looked at, from the first on."""
_SEARCHED = 96
"""Exposures that a model is searched with."""
_SINGLE = ("random-walk", "ornstein-uhlenbeck", "resonance")
_SUMS = ("ornstein-uhlenbeck+resonance", "random-walk+resonance", "resonance+resonance")
"""Models that are tried for the first answer, and those that are tried after it."""
_CERTAIN = 2.0
"""Motion that chance does not show, in `Direction.sure`: its square is then four standard deviations away."""
LEAST_BLUR = 1 / 3
"""Blur, in standard deviations of the kernel, from which on it shows the motion inside an exposure."""
_SHARPEST = 0.05
"""Share of the frames that are the sharpest."""
_NOTHING = 1e6
"""Variance of readings that say nothing."""
_SETTLED = 8
"""Exposures after which an estimator has found the path."""
_SLOWEST = 50
"""Frames in a cycle of the slowest vibration that is told from a drift, at most."""
_CHANCE = 1e-3
"""Chance of a line in what a model leaves of the places, below which it is taken for one."""
_MUCH_WIDER = 1.5
"""Widening of the intervals from which on the verdict that a model does not fit is a doubt."""
_REFUSED = 0.1
"""Share of gated exposures from which on a rig file is of no use."""
_ADVICE = {
    "pixels": "the kernel, the light or the noise: give the kernel's width with --kernel",
    "motion": "a vibration that is missing, or the exposure time",
    "zero": "a drift of where it rests",
    "": "the kernel, a vibration that is missing, or the exposure time",
}
"""What to do about a verdict, by the kind of its evidence."""
ESTIMATOR = "profile"
"""The estimator of the paths: `moments` refuses spots that swing fast along a slanted line."""
DIRECTIONS = ("x", "y")


@dataclass(frozen=True, kw_only=True, eq=False)
class Direction:
    """What is known of the motion along one direction."""

    name: str
    moved: float
    """Standard deviation of the spots' mean places in the frames, pixels."""
    blur: float
    """Root mean square of the path about its mean in a frame, pixels."""
    blurred: bool
    """Whether the blur is large enough against the kernel to be told from it."""
    least_blur: float
    """Blur of the sharpest frames, pixels."""
    sure: float
    """Root of the standard deviation of the square of ``moved`` by noise alone, pixels."""
    found: IdentifiedModel | None = None
    """The model of the motion; None where nothing moves."""
    known: float = math.nan
    """Standard deviation of the error of the path inside an exposure, by the pixels, pixels rms."""
    held: float = math.nan
    """The same of the centroid, taken for the whole exposure."""
    path: FloatArray | None = None
    """The path in each exposure, pixels of the window, (frames, n, steps)."""
    misfit: str = ""
    """The estimator's verdict on the model in words; empty unless it does not fit, and by much."""
    left_hz: float | None = None
    """Frequency, below half the frame rate, of a line in what the model leaves of the places; None without one."""

    @property
    def size(self) -> float:
        """Standard deviation of the path, pixels."""
        return math.hypot(self.moved, self.blur if self.blurred else 0.0)

    @property
    def unexplained(self) -> bool:
        """Whether the model leaves something of the motion."""
        return bool(self.misfit) or self.left_hz is not None

    @property
    def moves(self) -> bool:
        """Whether it moves at all."""
        return self.moved > self.least or self.blurred

    @property
    def least(self) -> float:
        """Motion of the mean places that noise alone could be, pixels rms."""
        return max(LEAST_MOTION, _CERTAIN * self.sure)


@dataclass(frozen=True, kw_only=True, eq=False)
class Looked:
    """What a film shows."""

    spots: Spots
    rate_hz: float
    exposure_s: float
    sd: float
    """Standard deviation of the kernel, pixels."""
    together: bool
    """Whether several spots have one motion in common."""
    directions: tuple[Direction, ...]
    text: str
    """The rig file."""
    cut: Film
    """The spots' windows as a film for that rig file."""
    settings: FilmSettings
    """The settings to import it with."""
    assumed: tuple[str, ...]
    """What was assumed, and what follows where it is wrong."""
    unknown: str
    """Why it cannot be told what happens inside an exposure, and what would help; empty where it can."""
    doubts: tuple[str, ...]
    """Reasons to mistrust the answer, and what would help."""

    @property
    def caveats(self) -> tuple[str, ...]:
        """What cannot be told, and all doubts."""
        return ((self.unknown,) if self.unknown else ()) + self.doubts

    @property
    def blurred(self) -> bool:
        """Whether the blur shows the motion inside an exposure."""
        return any(each.blurred for each in self.directions)

    @property
    def moves(self) -> bool:
        """Whether anything moves."""
        return any(each.moves for each in self.directions)


Tell = Callable[[str, int, int], None]


def look(
    film: Film, settings: FilmSettings, name: str, *, kernel: float | None = None, frames: int = FRAMES,
    thorough: bool = False, before: Looked | None = None, tell: Tell = lambda what, done, of: None,
) -> Looked:  # fmt: skip
    """Find out what moves in a film of up to four spots, and how.

    Parameters
    ----------
    name:
        The name of the rig.
    kernel:
        Standard deviation of a resting spot, pixels, where it is known.
    frames:
        Number of frames that are looked at, from the first on.
    thorough:
        Whether sums of processes are tried for blurred frames as well, where ``before`` leaves something unexplained.
    before:
        What an earlier look at the film has found: its spots, and the motion that it explains, are taken from it.
    tell:
        Called with the present task, how much of it is done, and how much there is.

    Raises
    ------
    ImportingError
        Rate or exposure time are not known, there is no spot, or there are too few frames.
    """
    if film.slopes:
        raise ImportingError(f"{film.name} has slopes and no pictures: there is no spot to look at")
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
    if film.count < FEWEST:
        raise ImportingError(f"{film.name} has {film.count} frame(s): {FEWEST} are needed to tell what moves")
    if before is not None:
        spots = before.spots
    else:
        spots = find_spots(film, settings, frames, lambda done: tell("read", done, 2 * min(frames, film.count)))
    sd = spots.sd if kernel is None else kernel
    if not math.isfinite(sd):
        raise ImportingError(
            f"{film.name}: the frames are too dim to tell how wide a spot at rest is: give its standard deviation with"
            " --kernel PIXELS, or take brighter frames"
        )
    scene = Scene(film, spots, times, rate, exposure_s, name)
    everything = range(len(spots.corners))

    seen = [[readings(*scene.along(d, k, sd)) for k in everything] for d in (0, 1)]
    directions = [_direction(DIRECTIONS[d], each, scene.unit, sd) for d, each in enumerate(seen)]
    together = len(everything) > 1 and _one_motion(seen)
    which = [0] if together else everything
    for d, each in enumerate(directions):
        first = None if before is None else before.directions[d]
        if first is not None and not first.unexplained:
            directions[d] = first  # a sum of processes would explain what is explained
        elif each.moves:
            names = (*_SINGLE, *_SUMS) if thorough or not each.blurred else _SINGLE  # sharp frames take no time
            directions[d] = _identified(scene, d, each, which, sd, names, partial(_say, tell, each.name))
    for d, each in enumerate(directions):
        if (band := _common_band(each, directions[1 - d])) is not None:
            directions[d] = _identified(scene, d, each, which, sd, ("resonance",), partial(_say, tell, each.name), band)
    unknown = ""
    if not any(each.blurred for each in directions):
        unknown = (
            f"cannot tell what happens inside an exposure: the blur, {max(each.blur for each in directions):.2g} pixels"
            f" rms, is below a third of the kernel, {sd:.2g} pixels: expose longer"
        )
    models = [each.found.model if each.found else None for each in directions]
    doubts = tuple(_doubts(film, spots, directions, sd, given=kernel is not None, thorough=thorough))
    return Looked(
        spots=spots, rate_hz=rate, exposure_s=exposure_s, sd=sd, together=together, directions=tuple(directions),
        text=scene.text(sd, models, together=together), cut=scene.cut(sd), settings=scene.settings,
        assumed=tuple(_assumed(film, settings, scene, kernel)), unknown=unknown, doubts=doubts,
    )  # fmt: skip


def _say(tell: Tell, direction: str, what: str, done: int, of: int) -> None:
    tell(f"{what.split(',')[0]} along {direction}", done, of)


def _direction(name: str, seen: Sequence[Readings], unit: float, sd: float) -> Direction:
    """How far the spots move from frame to frame and within one."""
    usable = [each for each in seen if each.usable.any()]
    if not usable:
        return Direction(name=name, moved=0.0, blur=0.0, blurred=False, least_blur=0.0, sure=0.0)

    def mean(of: Callable[[Readings], FloatArray]) -> float:
        return float(np.mean([of(each)[each.usable].mean() for each in usable]))

    noise = mean(lambda each: each.mean_noise)
    moved = float(np.mean([(each.mean + each.centre)[each.usable].var() for each in usable])) - noise
    # The square about c of the mean has the noise of the mean in it.
    blur = unit * math.sqrt(max(mean(lambda each: each.square - each.mean**2 + each.mean_noise), 0.0))
    count = sum(int(each.usable.sum()) for each in usable)
    within = np.concatenate([(each.square - each.mean**2 + each.mean_noise)[each.usable] for each in usable])
    return Direction(
        name=name, moved=unit * math.sqrt(max(moved, 0.0)), blur=blur, blurred=blur >= LEAST_BLUR * sd,
        least_blur=unit * math.sqrt(max(float(np.quantile(within, _SHARPEST)), 0.0)),
        sure=unit * math.sqrt(noise * math.sqrt(2 / count)),
    )  # fmt: skip


def _one_motion(seen: Sequence[Sequence[Readings]]) -> bool:
    """Whether the mean places of several spots are one motion and noise, or motions of their own: by the likelihood,
    with the Bayesian information criterion."""
    gain = 0.0
    for spots in seen:
        usable = np.all([each.usable[0] for each in spots], axis=0)
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


def _identified(
    scene: Scene, d: int, direction: Direction, which: Sequence[int], sd: float, names: Sequence[str],
    tell: Tell, band: tuple[float, float] | None = None,
) -> Direction:  # fmt: skip
    """The direction with the model of its motion and the errors of its path; with a band, it is one vibration in it."""
    films = [scene.along(d, k, sd)[1] for k in which]
    rig, some = parse_rig(scene.line_text(sd)), films[0][:_SEARCHED]
    wanted, seen = Wanted(lowest_hz=scene.rate_hz / _SLOWEST), [readings(rig, each[:_SEARCHED]) for each in films]
    if not direction.blurred:
        # Sharp frames show places, and of the width only how well the kernel is known.
        wanted = replace(wanted, highest_hz=scene.rate_hz / 2, pixels=False)
        seen = [replace(each, square_noise=np.full_like(each.square_noise, _NOTHING)) for each in seen]
    if band is not None:
        wanted = replace(wanted, lowest_hz=band[0], highest_hz=band[1])
    name, tops = _best_model(rig, seen, names, wanted, tell)
    found = from_readings(rig, seen, some, replace(wanted, models=(name,)), tell, tops).found[0]
    if not direction.blurred and band is None:
        found = _with_aliases(found, scene, LEAST_BLUR * sd)
    rig = parse_rig(scene.line_text(sd, found.model))
    each_film = [run(rig, each, [ESTIMATOR])[ESTIMATOR] for each in films]
    path = np.array([[one.path[0] for one in each] for each in each_film]).swapaxes(0, 1)
    settled = [one for each in each_film for one in each[_SETTLED:]]
    error = float(np.mean(np.square([each.path_sd for each in settled])))
    within = float(np.mean((path[_SETTLED:] - path[_SETTLED:].mean(axis=2, keepdims=True)) ** 2))
    verdicts = [each[-1].verdict for each in each_film]
    misfits = [
        _for_films(each)
        for each in verdicts
        if each is not None and each.fit is Fit.DOES_NOT_FIT and each.widening > _MUCH_WIDER
        if direction.blurred or each.kind != "pixels"  # what sharp frames tell needs no kernel
    ]
    return replace(
        direction,
        found=found,
        known=scene.unit * math.sqrt(error),
        held=scene.unit * math.sqrt(within + error),
        path=scene.unit * (path + 1) - 0.5,
        misfit=misfits[0] if misfits else "",
        left_hz=line_left([readings(rig, each) for each in films], found.model, scene.rate_hz),
    )


def _common_band(one: Direction, other: Direction) -> tuple[float, float] | None:
    """The band of the frequency of the vibration along the other direction, which is certain, where one of the aliases
    along this one is in it: then a single vibration aslant explains both. None where there is no such thing."""
    if one.found is None or other.found is None or {one.found.model.name, other.found.model.name} != {"resonance"}:
        return None
    (hz,), (certain,) = (
        [each for each in found.parameters if each.name == "frequency_hz"] for found in (one.found, other.found)
    )
    if len(hz.pieces) < 2 or len(certain.pieces) != 1:
        return None
    (piece,) = certain.pieces
    own = [each for each in hz.pieces if each.low <= piece.high and each.high >= piece.low]
    return (min(own[0].low, piece.low), max(own[0].high, piece.high)) if own else None


def _for_films(verdict: Verdict) -> str:
    """A verdict with advice that somebody with a film can follow."""
    return verdict.text.replace(ADVICE[verdict.kind], _ADVICE[verdict.kind])


def heeding(looked: Looked, score: Score) -> Looked:
    """What a film shows, with the doubts of the score of all its windows by the rig file that was written."""
    doubts = []
    if score.gated > _REFUSED * score.estimated:
        doubts.append(
            f"{score.gated} of {score.estimated} frames do not fit the rig file that is written, and its estimates are"
            " not to be used: try --kernel, with the width of a spot at rest"
        )
    elif score.verdict is not None and score.verdict.fit is Fit.DOES_NOT_FIT and score.verdict.widening > _MUCH_WIDER:
        doubts.append(f"in the recording {_for_films(score.verdict)}")
    return replace(looked, doubts=(*looked.doubts, *doubts))


def line_left(seen: Sequence[Readings], model: ProcessSum, rate_hz: float) -> float | None:
    """The frequency of a line in the innovations of the places, where chance does not explain it: Fisher's test (1929)
    of the largest value of a periodogram against their mean."""
    left = [one for each in seen for one in Likelihood(each, 1).whitened_means(model)]
    count = max(map(len, left))
    power = np.mean([np.abs(np.fft.rfft(each - each.mean())) ** 2 for each in left if len(each) == count], axis=0)
    first = max(1, -(-count // _SLOWEST))  # what is slower is a drift
    power = power[first : (count + 1) // 2]
    top = int(power.argmax())
    chance = len(power) * (1 - power[top] / power.sum()) ** (len(power) - 1)
    return (top + first) / count * rate_hz if chance < _CHANCE else None


def _with_aliases(found: IdentifiedModel, scene: Scene, most_blur: float) -> IdentifiedModel:
    """The model with all aliases of a frequency in its set that would blur the spot by no more than ``most_blur``,
    pixels rms: sharp frames cannot tell them apart."""
    rate, exposure_s, highest = scene.rate_hz, scene.exposure_s, 0.5 / scene.step_s
    sds = {each.name: each.best * scene.unit for each in found.parameters if each.name.endswith("sd")}

    def aliases(each: Identified) -> Identified:
        if not each.name.endswith("frequency_hz"):
            return each
        shown = sds.get(each.name.replace("frequency_hz", "sd"), 0.0) * abs(float(np.sinc(each.best * exposure_s)))

        def possible(hz: float) -> bool:
            left = abs(float(np.sinc(hz * exposure_s)))
            return hz < highest and shown * math.sqrt(max(1 - left**2, 0.0)) <= most_blur * left

        pieces = list(each.pieces)
        for multiple in np.arange(rate, highest + rate, rate).tolist():
            for piece in each.pieces:
                low, best, high = multiple - piece.high, multiple - piece.best, multiple - piece.low
                pieces.append(Piece(low, high, best, open_low=piece.open_high, open_high=piece.open_low))
                above = (multiple + piece.low, multiple + piece.high, multiple + piece.best)
                pieces.append(Piece(*above, open_low=piece.open_low, open_high=piece.open_high))
        return replace(each, pieces=tuple(one for one in pieces if one in each.pieces or possible(one.best)))

    return replace(found, parameters=tuple(map(aliases, found.parameters)))


def _best_model(
    rig: Rig, seen: Sequence[Readings], names: Sequence[str], wanted: Wanted, tell: Tell
) -> tuple[str, list[Maximum]]:
    """The sum of kinds that explains readings best by the Bayesian information criterion, and its local maxima."""
    best: tuple[float, str, list[Maximum]] = (-math.inf, "", [])
    count = 2 * sum(int(each.usable.sum()) for each in seen)
    for number, name in enumerate(names):
        tell("models", number, len(names))
        space = space_wanted(kinds_of(name), seen, wanted)
        try:
            found = maxima(space, seen)
        except IdentificationError:
            continue
        hz = [math.exp(x) for each, x in zip(space.names, found[0].x, strict=True) if each.endswith("frequency_hz")]
        if len(names) > 1 and hz and wanted.lowest_hz and min(hz) < 1.05 * wanted.lowest_hz:
            continue  # a drift, which the limit keeps from being as slow as it is
        value = found[0].log_likelihood - len(space.names) * math.log(count) / 2
        best = max(best, (value, name, found), key=lambda each: each[0])
    if not best[1]:
        raise ImportingError("no model of the motion can be fitted to these frames: they show too little")
    return best[1:]


def _assumed(film: Film, settings: FilmSettings, scene: Scene, kernel: float | None) -> Iterator[str]:
    """What was taken for granted, each with what follows where it is wrong."""
    spots = scene.spots
    yield (
        f"each frame is exposed for {scene.exposure_s:g} s of {1 / scene.rate_hz:.4g} s: if it is"
        " not, frequencies that the blur tells from their aliases are wrong"
    )
    yield "all rows are exposed at the same time: with a rolling shutter the lower rows are later, and the blur is bent"
    if kernel is None:
        yield (
            f"a spot at rest is round, {spots.sd:.3g} pixels wide (sd), the widest that explains the frames: if it is"
            " wider or narrower, so is the motion that is left; --kernel gives another"
        )
    if film.nonlinear and settings.gamma == 1.0:
        yield f"{nonlinear_note(film)}: if it is not linear, spots look wider than they are"
    if spots.left_out:
        yield f"{spots.left_out} fainter spot(s) are left out: they may move in another way"
    if len(spots.light) < film.count:
        yield f"the first {len(spots.light)} of {film.count} frames are looked at: later motion may be another"


def _doubts(
    film: Film, spots: Spots, directions: Sequence[Direction], sd: float, *, given: bool, thorough: bool
) -> Iterator[str]:
    """Reasons to mistrust what was found, and what would help."""
    if film.account:
        yield f"{film.left_out} of {film.count + film.left_out} frames are none: {film.account}"
    if not given and min(each.least_blur for each in directions) >= LEAST_BLUR * sd:
        yield (
            f"no frame shows the spot as narrow as its kernel, {sd:.2g} pixels, along x or along y: this width is known"
            " from the steep sides of the blur alone, and holds for a Gaussian spot only; if a spot at rest is wider,"
            " frequencies may be wrong: give its width with --kernel"
        )
    for each in directions:
        if each.misfit:
            yield f"along {each.name} {each.misfit}"
        if each.left_hz is not None:
            more = "without --quick sums are tried" if each.blurred and not thorough else "frequencies may be wrong"
            yield (
                f"along {each.name} a vibration at {each.left_hz:.3g} Hz or an alias of it is left over, which the"
                f" model does not have: {more}"
            )
    if spots.saturated > 0.001:
        yield f"{spots.saturated:.1%} of the pixels about the spots are saturated or hot and are left out: expose less"
    if spots.at_edge:
        yield "a spot is at the edge of the picture: what it does beyond is not seen"
