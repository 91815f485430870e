"""The spots of a film as frames of rigs: what `aolink look` identifies and estimates with, and its rig file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from aolink.exposure import Exposure
from aolink.films.film import Film
from aolink.identification.models import ProcessSum
from aolink.identification.rig_text import as_table
from aolink.importing.exposures import film_series
from aolink.importing.frames import FilmSettings, FrameTimes, default_scale
from aolink.jobs.look_spots import Spots
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig, parse_rig
from aolink.rig.edit import with_tables

LEAST_MOTION = 0.02
"""Smallest motion that is spoken of, pixels rms."""
_STEPS, _MOST_STEPS = 16, 48
"""Fast steps in an exposure, at least where the exposure is short, and at most."""
_UNEVEN = 0.003
"""Share by which the exposure may differ from a whole number of fast steps."""
_REST = 2.0
"""Standard deviation of where a spot rests about the middle of its window, pixels."""
_FULL_SCALE, _ROOM = (1 << 16) - 1, 1.25
"""The largest count, and an intensity of one over the brightest pixel of a region."""
_COUNTS, _NOISE_SDS = 50_000, 6
"""Counts of the brightest pixel of a resting spot, and standard deviations of noise below black."""


class FastSteps(NamedTuple):
    """Fast steps in an exposure, and from one to the next, and their length, s."""

    exposure: int
    period: int
    step_s: float

    @classmethod
    def of(cls, rate_hz: float, exposure_s: float) -> FastSteps:
        """The first number of steps with which the period has nearly a whole number too."""
        share = min(exposure_s * rate_hz, 1.0)
        steps = min(range(_STEPS, _MOST_STEPS + 1), key=lambda n: (abs(n / round(n / share) / share - 1) > _UNEVEN, n))
        period = round(steps / share)
        return cls(steps, period, round(1e9 / rate_hz / period) / 1e9)


def moving(
    models: Sequence[ProcessSum | None], outputs: int, step_s: float, least: float, still_s: float
) -> list[dict[str, Any]]:
    """The tables ``disturbance.model`` of the motion along x and y, which outputs are in turn; where nothing moves, one
    of the least motion."""
    tables: list[dict[str, Any]] = []
    for d, each in enumerate(models):
        processes = [] if each is None else [as_table(one, step_s) for one in each.processes]
        still = {"kind": "ornstein-uhlenbeck", "correlation_s": still_s, "sd": least}
        for table in processes or [still]:
            size = {key: [table[key]] for key in ("sd", "step_sd") if key in table}
            tables.append(table | size | {"modes": [[float(o % 2 == d)] for o in range(outputs)]})
    return tables


def resting(name: str, source: str, axes: int, outputs: int, rest: float, steps: FastSteps) -> str:
    """The begin of a rig file: a plant that is where the target rests, which is not known to within ``rest``, and the
    timing."""
    one, nothing = json.dumps(np.eye(outputs).tolist()), json.dumps([[0.0]] * outputs)
    return f"""# Written by `aolink look {source}`.
name = {json.dumps(name)}

[plant]               # where the target rests, which is constant; the disturbance moves it about there
axes = {axes}
A = {one}
B = {nothing}
B_w = {one}
C = {one}
process_noise = {json.dumps(np.zeros((outputs, outputs)).tolist())}
initial_covariance = {json.dumps((np.eye(outputs) * rest**2).tolist())}

[timing]
fast_step_s = {steps.step_s!r}
exposure_steps = {steps.exposure}
frame_period_steps = {steps.period}
"""


def first_of(film: Film, count: int) -> Film:
    """The first frames of a film."""
    times = None if film.times_ns is None else film.times_ns[:count]
    return replace(film, count=count, pictures=lambda: islice(film.pictures(), count), times_ns=times)


def region_text(
    name: str, film: Film, steps: FastSteps, models: Sequence[ProcessSum | None], reference: FloatArray,
    noise: float, blur: FloatArray, middle: tuple[float, float],
) -> str:  # fmt: skip
    """The rig file of a region: its reference and a pixel's noise, in light of the film, the covariance of the path in
    the reference, xx, xy and yy, pixels squared."""
    scale = default_scale(film, _FULL_SCALE)
    reference, noise = scale * reference, scale * noise
    rows = "".join(f"    {json.dumps(row)},\n" for row in np.rint(reference).astype(int).tolist())
    place = ",".join(f"{each:g}" for each in middle)
    text = f"""{resting(name, film.name, 1, 2, _REST, steps)}
[sensor]              # slope unit: a pixel; in the film --at {place}
kind = "region"
read_noise_counts = {max(noise, 0.3):.4g}
bit_depth = 16
counts_per_density = {math.ceil(_ROOM * reference.max())}
blur = {json.dumps([round(float(each), 6) for each in blur])}
reference = [
{rows}]
"""
    tables = moving(models, 2, steps.step_s, LEAST_MOTION, steps.period * steps.step_s)
    return with_tables(text, "disturbance.model", tables, "by `aolink look`")


class Scene:
    """The spots of a film as frames of rigs: one for their sums along one direction, and one for the windows."""

    def __init__(self, film: Film, spots: Spots, times: FrameTimes, rate: float, exposure_s: float, name: str) -> None:
        self.spots, self.name, self.film = spots, name, film
        self.side = spots.light.shape[-1]
        self.unit = self.side / 2
        """Pixels of a slope unit."""
        self.rate_hz, self.exposure_s = rate, exposure_s
        self.settings = FilmSettings(rate_hz=rate, exposure_s=exposure_s, scale=1.0)
        self.steps = FastSteps.of(rate, exposure_s)
        self._times = None if film.times_ns is None else film.times_ns[: len(spots.light)]

    def _film(self, values: FloatArray) -> Film:
        return Film(
            name=self.film.name, shape=(values.shape[1], values.shape[2]), dtype=values.dtype, count=len(values),
            pictures=lambda: iter(values), rate_hz=self.film.rate_hz, exposure_s=self.exposure_s,
            start_ns=self.film.start_ns, times_ns=self._times,
        )  # fmt: skip

    def along(self, d: int, spot: int, sd: float) -> tuple[Rig, list[Exposure]]:
        """A rig of a line sensor that sees a spot's sums along a direction, and its exposures."""
        rig = parse_rig(self.line_text(sd))
        sums = self.spots.light[:, spot, None].sum(axis=2 + d) * self.unit
        counts = rig.sensor.black_level + rig.sensor.counts_per_density * sums
        return rig, list(film_series(self._film(counts), rig, self.settings))

    def cut(self, sd: float) -> Film:
        """The windows side by side."""
        rig = parse_rig(self.text(sd, (), together=False))
        density = self.spots.light * self.unit**2
        frames = np.moveaxis(density, 1, 2).reshape(len(density), self.side, -1)
        return self._film(rig.sensor.black_level + rig.sensor.counts_per_density * frames)

    def line_text(self, sd: float, model: ProcessSum | None = None) -> str:
        """A rig file for a spot's sums along a direction."""
        tables = [] if model is None else [as_table(each, self.steps.step_s) for each in model.processes]
        return self._rig(
            sd, f'kind = "line"\npixels = {self.side}', 2 * self.spots.noise**2 * self.unit**2, 1, 1, tables
        )

    def text(self, sd: float, models: Sequence[ProcessSum | None], *, together: bool) -> str:
        """The rig file for the windows."""
        n = len(self.spots.corners)
        outputs = 2 * n if together else 2
        tables = moving(models, outputs, self.steps.step_s, LEAST_MOTION / self.unit, 1 / self.rate_hz)
        kind = f'kind = "spots"\ngrid = [1, {n}]\nwindow = [{self.side}, {self.side}]'
        return self._rig(sd, kind, self.spots.noise**2 * self.unit**2, 1 if together else n, outputs, tables)

    def _rig(
        self, sd: float, kind: str, noise_density: float, axes: int, outputs: int, tables: list[dict[str, Any]]
    ) -> str:
        """The text of a rig file. The plant is where each spot rests, which is not known: the disturbance moves it."""
        sigma, pixel = sd * math.sqrt(2) / self.unit, 1 / self.unit
        plane = kind.startswith('kind = "spots"')
        wide = math.sqrt(2 * math.pi * (sigma**2 / 2 + pixel**2 / 12))
        area = pixel ** (1 + plane)
        noise = math.sqrt(noise_density / area)
        counts = _COUNTS / (1 / wide ** (1 + plane) + 2 * _NOISE_SDS * noise)
        text = f"""{resting(self.name, self.film.name, axes, outputs, _REST / self.unit, self.steps)}
[sensor]              # slope unit: {self.unit:g} pixels
{kind}
field = [-1.0, 1.0]
noise_density = {noise_density:.6g}
bit_depth = 16
black_level = {math.ceil(_NOISE_SDS * noise * counts)}
counts_per_density = {counts:.6g}
photoelectrons = {self.spots.electrons:.4g}

[sensor.kernel]
shape = "gaussian"
sigma = {sigma:.6g}  # {sd:.4g} pixels rms in one direction
"""
        return with_tables(text, "disturbance.model", tables, "by `aolink look`") if tables else text
