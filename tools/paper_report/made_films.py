"""Films of spots whose motion is known, imported like the film of spheres: they show which of its figures are chance.

Six spots walk at random, or shake with a resonance that has about a period in an exposure. The rig file is that of
`aolink rig --from`; for a resonance, its fitted [plant] is replaced by the one that the film was made with, so that
the figures are the estimators' and not the fit's. A second table has films, also of Ornstein-Uhlenbeck processes, with
the fitted [plant]. Errors are against the path that the film was made with, not the tracker's.
"""

import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from judging.sampled import estimator as estimator_named

from aolink.estimation import smooth
from aolink.exposure import Exposure
from aolink.films.film import array_film
from aolink.importing.first_rig import first_rig
from aolink.importing.frames import FilmSettings
from aolink.importing.recording import import_film
from aolink.numerics.arrays import FloatArray
from aolink.recording.reader import Recording
from aolink.rig import Rig, parse_rig
from paper_report.blocks import Block, Heading, Table, Text
from paper_report.ensemble import IntervalEstimate, mean, ratio
from paper_report.numbers import Effort
from paper_report.spheres import centroids
from paper_report.spot_films import ornstein_uhlenbeck, random_walk, resonance, spot_film

_SPOTS, _PITCH = 6, 48
_WALK, _SHAKE = 0.45, 1.5
"""Rms motion of a random walk in a frame, and of a vibration, pixels."""
_LIGHT = {"walk": 20_000.0, "shake": 60_000.0}
"""Counts of a spot; the noise of a pixel is 20."""
_SKIP_WALK, _SKIP_SHAKE = 2, 4
"""Exposures that are not scored, because the motion before is not known."""
_FIRST_SEED = 11
"""First seed used; earlier ones were used while the importer was changed."""
_FIRST_FITTED_SEED = 51
"""First seed of the films with a fitted [plant]."""
NAMES = ("o1", "profile", "sampled")


@dataclass(frozen=True)
class Kind:
    """One kind of film."""

    frames: int
    """Frames in an exposure."""
    periods: float = 0.0
    """Periods of the vibration in an exposure; 0: a random walk."""
    lasts: float = 0.0
    """Periods until the vibration's amplitude is forgotten."""
    forgets: float = 0.0
    """Frames until an Ornstein-Uhlenbeck process has forgotten its place; 0: another motion."""
    fitted: bool = False
    """The [plant] is the fitted one, also for a vibration."""

    def __str__(self) -> str:
        if self.forgets:
            return f"Ornstein-Uhlenbeck process, forgets in {self.forgets:g} frames, {self.frames} frames"
        if not self.periods:
            return f"walk, {self.frames} frames"
        if self.fitted:
            return f"vibration of {self.frames / self.periods:.2g} frames, {self.frames} frames"
        return f"resonance, {self.periods:g} periods in {self.frames} frames, lasts {self.lasts:g}"


WALKS = (Kind(8), Kind(12), Kind(24))
SHAKES = tuple(Kind(12, periods, lasts) for lasts in (50.0, 10.0) for periods in (0.6, 1.0, 1.6, 2.5))
_VIBRATIONS = ((3.7, 12), (5.3, 8), (5.3, 10), (7, 12), (12, 12), (30, 12))
"""Period of a vibration and length of an exposure, frames."""
_FORGETS = ((10, 8), (10, 12), (20, 8), (20, 12), (35, 8), (35, 12), (50, 12))
"""Memory of an Ornstein-Uhlenbeck process and length of an exposure, frames."""
FITTED = (
    *(Kind(frames, frames / period, 50.0, fitted=True) for period, frames in _VIBRATIONS),
    *(Kind(frames, fitted=True) for frames in (8, 24)),
    *(Kind(frames, forgets=forgets, fitted=True) for forgets, frames in _FORGETS),
)


def made(kind: Kind, seed: int, exposures: int) -> tuple[Rig, list[Exposure], FloatArray]:
    """Rig, exposures and true paths, (exposures, outputs, frames), slope units, of one film."""
    of_kind = [kind.frames, round(10 * kind.periods), round(kind.lasts), round(kind.forgets)]
    rng = np.random.default_rng([seed, *(of_kind if kind.forgets else of_kind[:3])])
    K, count = kind.frames, exposures * kind.frames
    middles = np.array([[(k + 0.5) * _PITCH, _PITCH / 2] for k in range(_SPOTS)])
    if kind.periods:
        period = K / kind.periods
        motion, light = resonance(rng, count, _SPOTS, _SHAKE, period, kind.lasts), _LIGHT["shake"]
    elif kind.forgets:
        motion, light = ornstein_uhlenbeck(rng, count, _SPOTS, _WALK, kind.forgets), _LIGHT["walk"]
    else:
        motion, light = random_walk(rng, count, _SPOTS, _WALK), _LIGHT["walk"]
        motion -= motion.mean(axis=(0, 1))
    middles = middles + rng.uniform(-0.5, 0.5, middles.shape)
    shape = (_PITCH, _PITCH * _SPOTS)
    film = spot_film(rng, motion, middles, shape, light=light)
    places = tuple((float(x), float(y)) for x, y in film.places[0])
    settings = FilmSettings(rate_hz=100.0, subtract_median=True, track=_SPOTS, frames_per_exposure=K, places=places)
    source = array_film(film.frames, "film")
    text = first_rig(source, settings, "film").text
    if kind.periods and not kind.fitted:
        text = _with_resonance(text, K / kind.periods, kind.lasts)
    rig = parse_rig(text)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mcap"
        import_film(source, rig, settings, path)
        found = list(Recording(path).exposures())
    true = film.places[: len(found) * K].reshape(len(found), K, 2 * _SPOTS).swapaxes(1, 2)
    seen = np.array([each.truth.path for each in found if each.truth is not None]) / rig.sensor.pixel_width
    # Windows are moved by whole pixels; the middle of one is the border of two.
    corner = np.floor((true - seen).mean(axis=2, keepdims=True)) + 0.5
    return rig, found, (true - corner) * rig.sensor.pixel_width


def _with_resonance(text: str, period: float, lasts: float) -> str:
    """A first rig file with the plant of a vibration, (frames); the window's shifts add up in a state of their own."""
    decay, turn = np.exp(-1 / (lasts * period)), 2 * np.pi / period
    c, s = decay * np.cos(turn), decay * np.sin(turn)
    variance = (_SHAKE / (parse_rig(text).sensor.shape[0] / 2)) ** 2
    noise = variance * (1 - decay**2)
    plant = f"""[plant]
axes = {2 * _SPOTS}
A = [[{c}, {-s}, 0.0], [{s}, {c}, 0.0], [0.0, 0.0, 1.0]]
B = [[0.0], [0.0], [1.0]]
B_w = [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]
C = [[1.0, 0.0, 1.0]]
process_noise = [[{noise}, 0.0], [0.0, {noise}]]
initial_covariance = [[{variance}, 0.0, 0.0], [0.0, {variance}, 0.0], [0.0, 0.0, 0.1]]

"""
    return re.sub(r"^\[plant\].*?(?=^\[timing\])", plant, text, flags=re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class MadeFilm:
    """Results for one kind of film."""

    kind: Kind
    over_held: dict[str, IntervalEstimate]
    """RMSE of the path over that of the centroid, held, by estimator."""
    over_interpolated: dict[str, IntervalEstimate]
    """RMSE of the smoothed path over that of the centroid interpolated between the pictures."""
    coverage: dict[str, IntervalEstimate]
    """Share of the true path inside the estimate's 95 % intervals."""


def made_film(
    kind: Kind, names: Sequence[str], seeds: Sequence[int], exposures: int, particles: int | None = None,
) -> MadeFilm:  # fmt: skip
    """Estimators and centroids on a film of each seed; ``particles`` are those of `sampled`."""
    skip = _SKIP_SHAKE if kind.periods else _SKIP_WALK
    held, interpolated = list[FloatArray](), list[FloatArray]()
    path, smoothed, inside = ({name: list[FloatArray]() for name in names} for _ in range(3))
    for seed in seeds:
        rig, series, true = made(kind, seed, exposures)

        def squares(paths: FloatArray, true: FloatArray = true) -> FloatArray:
            """Mean squared errors, (axes, exposures)."""
            return np.asarray(((paths - true) ** 2).mean(axis=2)[skip:].T)

        for found, one in zip((held, interpolated), centroids(rig, series), strict=True):
            found.append(squares(one))
        for name in names:
            estimator = estimator_named(rig, name, particles=particles)
            estimates = [estimator.step(each) for each in series]
            after = smooth(rig.plant, series, estimates)
            paths = np.array([each.path for each in estimates])
            path[name].append(squares(paths))
            smoothed[name].append(squares(np.array([each.path for each in after])))
            sd = np.array([each.path_sd for each in estimates])
            inside[name].append((np.abs(paths - true) <= 1.96 * sd).mean(axis=2)[skip:].T)
    return MadeFilm(
        kind,
        {name: ratio(np.concatenate(each), np.concatenate(held)) for name, each in path.items()},
        {name: ratio(np.concatenate(each), np.concatenate(interpolated)) for name, each in smoothed.items()},
        {name: mean(np.concatenate(each)) for name, each in inside.items()},
    )


def made_films(effort: Effort) -> list[MadeFilm]:
    """All kinds of films, with seeds on which nothing was tuned."""
    seeds = range(_FIRST_SEED, _FIRST_SEED + effort.made_seeds)
    kinds = (WALKS + SHAKES)[slice(*effort.made_kinds)]
    return [made_film(kind, NAMES, seeds, effort.made_exposures, effort.particles) for kind in kinds]


def fitted_films(effort: Effort) -> list[MadeFilm]:
    """Films with the rig file that is fitted to them, of other seeds."""
    seeds = range(_FIRST_FITTED_SEED, _FIRST_FITTED_SEED + effort.fitted_seeds)
    kinds = FITTED[: effort.fitted_kinds]
    return [made_film(kind, ("profile",), seeds, effort.fitted_exposures) for kind in kinds]


def fitted_section(found: Sequence[MadeFilm], effort: Effort) -> list[Block]:
    """A row for each kind of film."""
    return [
        Text(
            f"The same for `profile` with the rig file of `aolink rig --from` as it is, {effort.fitted_seeds} other"
            f" seeds of {effort.fitted_exposures} exposures; vibrations last 50 periods:"
        ),
        Table(
            ["film", "over held", "smoothed, over interpolated", "inside"],
            [_made_row(each, "profile") for each in found],
        ),
    ]


def _made_row(film: MadeFilm, name: str, *more: str) -> list[str]:
    found = (film.over_held, film.over_interpolated, film.coverage)
    return [str(film.kind), *more, *(each[name].interval for each in found)]


def made_section(found: Sequence[MadeFilm], effort: Effort) -> list[Block]:
    """A row for each kind of film and estimator."""
    return [
        Heading("Films whose motion we know"),
        Text(
            "Not the paper's: films of six spots (tools/paper_report/spot_films.py) through the door of the film of"
            f" spheres, {effort.made_seeds} seeds of {effort.made_exposures} exposures for each kind. The rig file is"
            " that of `aolink rig --from`; for a resonance its [plant] is replaced by the right one. Errors are against"
            " the motion that the film was made with. RMSE of the path over that of the held centroid, of the smoothed"
            " path over that of the centroid interpolated to the next picture, with the 95 % interval of a bootstrap"
            " over films and axes, and share of the path inside the estimate's 95 % intervals; `sampled` is what"
            " bounds the others:"
        ),
        Table(
            ["film", "estimator", "over held", "smoothed, over interpolated", "inside"],
            [_made_row(each, name, name) for each in found for name in each.over_held],
        ),
    ]
