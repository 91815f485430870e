"""Films of spots whose motion is known, beside the film of spheres: they show which of its figures are chance.

Six spots walk at random, or shake with a resonance that has about a period in an exposure. The rig file has the plant
that the film was made with, so that the figures are the estimators'. Errors are against the path that the film was made
with.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from judging.sampled import estimator as estimator_named

from aolink.estimation import smooth
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig
from paper_report.blocks import Block, Heading, Table, Text
from paper_report.ensemble import IntervalEstimate, mean, ratio
from paper_report.numbers import Effort
from paper_report.spheres import WALK, centroids, followed, spot_rig
from paper_report.spot_films import random_walk, resonance, spot_film

_SPOTS, _PITCH, _SD = 6, 48, 1.8
_WALK, _SHAKE = 0.45, 1.5
"""Rms motion of a random walk in a frame, and of a vibration, pixels."""
_LIGHT = {"walk": 20_000.0, "shake": 60_000.0}
"""Counts of a spot; the noise of a pixel is 20."""
_SKIP_WALK, _SKIP_SHAKE = 2, 4
"""Exposures that are not scored, because the motion before is not known."""
_FIRST_SEED = 11
"""First seed used; earlier ones were used while the importer was changed."""
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

    def __str__(self) -> str:
        if not self.periods:
            return f"walk, {self.frames} frames"
        return f"resonance, {self.periods:g} periods in {self.frames} frames, lasts {self.lasts:g}"


WALKS = (Kind(8), Kind(12), Kind(24))
SHAKES = tuple(Kind(12, periods, lasts) for lasts in (50.0, 10.0) for periods in (0.6, 1.0, 1.6, 2.5))


def made(kind: Kind, seed: int, exposures: int) -> tuple[Rig, list[Exposure], FloatArray]:
    """Rig, exposures and true paths, (exposures, outputs, frames), slope units, of one film."""
    rng = np.random.default_rng([seed, kind.frames, round(10 * kind.periods), round(kind.lasts)])
    K, count = kind.frames, exposures * kind.frames
    middles = np.array([[(k + 0.5) * _PITCH, _PITCH / 2] for k in range(_SPOTS)])
    if kind.periods:
        period = K / kind.periods
        motion, light = resonance(rng, count, _SPOTS, _SHAKE, period, kind.lasts), _LIGHT["shake"]
        plant, far, step = _resonance(period, kind.lasts), 2 * _SHAKE, 2 * np.pi * _SHAKE / period
    else:
        motion, light = random_walk(rng, count, _SPOTS, _WALK), _LIGHT["walk"]
        motion -= motion.mean(axis=(0, 1))
        plant, far, step = WALK.format(_WALK**2), _WALK * np.sqrt(K), _WALK
    middles = middles + rng.uniform(-0.5, 0.5, middles.shape)
    film = spot_film(rng, motion, middles, (_PITCH, _PITCH * _SPOTS), light=light)
    # The motion in a single frame widens the spot.
    rig = spot_rig(plant, _SPOTS, K, np.hypot(_SD, step / np.sqrt(12)), 20.0 / light)
    found = followed(rig, film.frames.astype(np.float64) - 1000, film.places, 3.5 * np.hypot(_SD, far))
    return rig, found, np.array([each.truth.path for each in found if each.truth is not None])


def _resonance(period: float, lasts: float) -> str:
    """The plant of a vibration, (frames); the window's shifts add up in a state of their own."""
    decay, turn = np.exp(-1 / (lasts * period)), 2 * np.pi / period
    c, s = decay * np.cos(turn), decay * np.sin(turn)
    noise = _SHAKE**2 * (1 - decay**2)
    return f"""
A = [[{c}, {-s}, 0.0], [{s}, {c}, 0.0], [0.0, 0.0, 1.0]]
B = [[0.0], [0.0], [1.0]]
B_w = [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]
C = [[1.0, 0.0, 1.0]]
process_noise = [[{noise}, 0.0], [0.0, {noise}]]
initial_covariance = [[{_SHAKE**2}, 0.0, 0.0], [0.0, {_SHAKE**2}, 0.0], [0.0, 0.0, 4.0]]
"""


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


def _made_row(film: MadeFilm, name: str, *more: str) -> list[str]:
    found = (film.over_held, film.over_interpolated, film.coverage)
    return [str(film.kind), *more, *(each[name].interval for each in found)]


def made_section(found: Sequence[MadeFilm], effort: Effort) -> list[Block]:
    """A row for each kind of film and estimator."""
    return [
        Heading("Films whose motion we know"),
        Text(
            "Not the paper's: films of six spots (tools/paper_report/spot_films.py), read like that of"
            f" spheres, {effort.made_seeds} seeds of {effort.made_exposures} exposures for each kind. The rig file has"
            " the plant that the film was made with, and errors are against its motion. RMSE of the path over that of"
            " the held centroid, of the smoothed path over that of the centroid interpolated to the next picture, with"
            " the 95 % interval of a bootstrap over films and axes, and share of the path inside the estimate's 95 %"
            " intervals; `sampled` is what bounds the others:"
        ),
        Table(
            ["film", "estimator", "over held", "smoothed, over interpolated", "inside"],
            [_made_row(each, name, name) for each in found for name in each.over_held],
        ),
    ]
