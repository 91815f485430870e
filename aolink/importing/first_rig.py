"""A first rig file for a film: the kernel, noise and plant that its single frames show, each with its uncertainty."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from aolink.errors import ImportingError, RigError
from aolink.films.film import Film
from aolink.importing.frames import FilmSettings, film_times, nonlinear_note
from aolink.importing.motion import Motion, fit_motion
from aolink.importing.survey import Survey, reach, survey
from aolink.importing.tracker import find_objects
from aolink.importing.tracking import STRAY
from aolink.numerics.arrays import FloatArray
from aolink.rig import parse_rig

_COUNTS = 62_000
"""Counts of the brightest pixel of a resting spot with its noise; there are 65,535."""
_NOISE_SDS = 6
"""Standard deviations of a pixel's noise that fit below black and above the brightest pixel."""
_LONGEST_NS = 10**15
"""Longest frame period, ns: a week and a half."""
_LEAST_WINDOW = 12
_ROUNDED = 1e-7
"""Change of an eigenvalue's modulus that the file's rounding stays below."""
_ANYWHERE = 0.1
"""Variance of the place of an object in its window before it is seen, slope units squared."""


class FirstRig(NamedTuple):
    """A rig file for a film."""

    text: str
    notes: tuple[str, ...]
    """What in the film contradicts the rig file, or is left out of it; the text has these notes, too."""


def first_rig(film: Film, settings: FilmSettings, name: str, progress: Callable[[int], None] | None = None) -> FirstRig:
    """A rig file for the objects of a film, ``settings.track`` of them: for an import with these settings.

    The slope unit is half a window. The plant has a copy for each object and direction; its input is the shift of the
    window that follows the object. Raises `ImportingError` where there are fewer objects, or the frame rate is not
    known or contradicts the film's times, or an exposure is a single frame: `aolink.jobs.look` is for these.
    """
    if film.slopes:
        raise ImportingError(f"{film.name} has slopes and no pictures: a first rig file is made from pictures")
    if not settings.track:
        raise ImportingError("a first rig file is about objects in the film: say how many with --track N")
    times = film_times(film, settings)
    periods, rate, said = times.periods, times.rate_hz, list(times.notes)
    if rate is None:
        raise ImportingError(f"it is not known how many frames a second {film.name} has: give --rate")
    if not 1 <= round(1e9 / rate) <= _LONGEST_NS:
        raise ImportingError(f"{rate:g} frames/s are no rate of a film: give the right --rate")
    if film.nonlinear and settings.gamma == 1.0:
        said.append(nonlinear_note(film))
    objects = find_objects(film, settings)
    if settings.frames_per_exposure < 2:
        raise ImportingError(
            f"a first rig file is for exposures that are sums of sharp frames: say of how many, 2 or more; or let"
            f" `aolink look {film.name}` make one whose exposures are the single frames, from their blur"
        )
    known = survey(film, settings, objects, progress)
    places = np.full((int(periods[-1]) + 1, 2 * settings.track), np.nan)  # lost frames show nothing
    places[periods] = known.places.reshape(len(periods), -1)
    motion = fit_motion(places)
    K = settings.frames_per_exposure
    # The window moves before its object has strayed too far from the middle.
    side = max(_LEAST_WINDOW, 2 * math.ceil(reach(known, K) / (1 - 2 * STRAY)))
    notes = (*said, *(() if settings.invert else film.saturation_notes), *_notes(known, motion))
    text = _text(film, settings, name, known, motion, side, rate, notes)
    try:
        parse_rig(text)
    except RigError as error:
        raise ImportingError(f"{film.name}: what its frames show makes no rig file ({error})") from None
    return FirstRig(text, notes)


def _notes(known: Survey, motion: Motion) -> Iterator[str]:
    """What the user should know of the film before using the rig file."""
    yield from known.notes()
    if known.left_out:
        yield (
            f"{100 * known.left_out:.2g} % of the pixels about the objects are saturated, hot or dead, or no numbers:"
            " kernel, light and noise are fitted without them"
        )
    if motion.unexplained:
        yield (
            f"the motion is not a {motion.kind} alone: what it leaves unexplained is correlated by"
            f" {motion.unexplained:.2f} from one frame to one some frames later, as of a second vibration, and"
            " intervals will be too narrow. Import with this rig file, then try `aolink identify`"
        )


def _plant(motion: Motion, unit: float, copies: int) -> str:
    """The table of the plant: the process, and an offset that the window shifts and that may walk and drift.

    A place in a frame is the mean of the motion in it, which has not the whole last step of a random motion yet: the
    last state is that step.
    """
    # The numbers of the file are rounded, and a vibration that lasts for ever must not grow by that.
    turning = np.exp(complex(0, motion.turn)) * min(motion.a, 1 - _ROUNDED if motion.turn else 1.0)
    process = np.array([[turning.real, -turning.imag], [turning.imag, turning.real]])
    n = 0 if motion.a == 1 else 2 if motion.turn else 1
    drifts = int(motion.drift > 0)
    noises = [motion.q] * n + [motion.walk] * (n == 0 or motion.walk > 0)
    mean = motion.frame_mean
    size = n + 1 + drifts + int(mean.step > 0)
    A, B, C, B_w = np.eye(size), np.zeros((size, 1)), np.zeros((1, size)), np.eye(size)[:, : len(noises)]
    A[:n, :n], B[n], C[0, n] = process[:n, :n], 1.0, 1.0
    C[0, : min(n, 1)] = mean.process
    A[n, n + 1 : n + 1 + drifts] = 1.0
    initial = np.diag([motion.variance] * n + [_ANYWHERE * unit**2] + [motion.drift] * drifts + [noises[-1]])
    initial = initial[:size, :size] / unit**2
    if mean.step:
        A[-1, -1], B_w[-1, -1], C[0, -1] = 0.0, 1.0, -mean.step
    a_frame = f"{motion.a:.5g} +- {motion.a_sd:.2g} a frame"
    if motion.turn:
        period, lasts = 2 * math.pi / motion.turn, -motion.turn / (2 * math.pi * math.log(motion.a))
        said = (
            f"# A vibration of {period:.4g} +- {motion.turn_sd / motion.turn * period:.2g} frames, which lasts"
            f" {lasts:.3g} +- {motion.a_sd / (1 - motion.a) * lasts:.2g} periods, {math.sqrt(motion.variance):.3g}"
            " pixels rms"
        )
    elif n:
        said = f"# An Ornstein-Uhlenbeck process: a = {a_frame}"
    else:
        said = "# A random walk"
    if n:
        said += f"; process_noise +- {motion.q_sd / unit**2:.2g}"
    if motion.walk:
        begin = "\n# and a random walk: process_noise" if n else ": process_noise"
        said += f"{begin} +- {motion.walk_sd / unit**2:.2g}, {math.sqrt(motion.walk):.4g} pixels rms a frame"
    if drifts:
        share = motion.drift_sd / motion.drift / 2
        said += (
            f"\n# and a constant velocity, another one for each object and direction: {math.sqrt(motion.drift):.3g} +-"
            f" {share * math.sqrt(motion.drift):.2g} pixels rms a frame"
        )
    last = "\n# The last state is the last step, which the mean over a frame has in part." if mean.step else ""
    return f"""[plant]               # a copy for each object along x and along y
{said}.
# The input shifts state {n + 1}, as the window is.{last}
axes = {copies}
A = {_matrix(A)}
B = {_matrix(B)}
B_w = {_matrix(B_w)}
C = {_matrix(C)}
process_noise = {_matrix(np.diag(noises) / unit**2)}
initial_covariance = {_matrix(initial)}
"""


def _matrix(values: FloatArray) -> str:
    """An array as TOML, as exact as it was fitted."""
    return json.dumps([[float(f"{x:.8g}") for x in row] for row in values])


def _text(
    film: Film, settings: FilmSettings, name: str, known: Survey, motion: Motion, side: int, rate: float,
    notes: tuple[str, ...],
) -> str:  # fmt: skip
    unit = side / 2  # pixels
    n, K = settings.track, settings.frames_per_exposure
    sigma, sigma_sd = known.sd * math.sqrt(2) / unit, known.sd_sd * math.sqrt(2) / unit
    width_sd = f"+- {sigma_sd:.2g}" if math.isfinite(sigma_sd) else "no +- from one object"
    area = (2 / side) ** 2
    read, read_sd, electrons = _noise(known, 2 / side)
    peak = 1 / (2 * math.pi * (sigma**2 / 2 + area / 12))
    noise = math.sqrt(read / area) if read else 0.0
    counts = _COUNTS / (peak + 2 * _NOISE_SDS * noise)
    step_ns = round(1e9 / rate)
    summary = (
        f"{n} objects of {film.name}, each in a window of {side} pixels that follows it; slope unit: {unit:g} pixels"
    )
    said = "".join(f"# Note: {note}.\n" for note in notes)
    return f"""# Written by `aolink rig --from {film.name}` from its single frames. +- is one standard deviation.
{said}name = {json.dumps(name)}
summary = {json.dumps(summary)}

{_plant(motion, unit, 2 * n)}
[timing]
fast_step_s = {step_ns / 1e9!r}  # {rate:.6g} frames/s
exposure_steps = {K}
frame_period_steps = {K}

[sensor]
kind = "spots"
grid = [1, {n}]
window = [{side}, {side}]
field = [-1.0, 1.0]
noise_density = {read:.6g}  # +- {read_sd:.2g}: what the Gaussian leaves of single frames
bit_depth = 16
black_level = {math.ceil(_NOISE_SDS * noise * counts)}
counts_per_density = {counts:.6g}
photoelectrons = {electrons:.4g}

[sensor.kernel]
shape = "gaussian"
sigma = {sigma:.6g}  # {width_sd}: {known.sd:.4g} pixels rms in one direction

[mirror]              # the shift of each window, of which the importer makes the inputs
input_min = -4.0
input_max = 4.0
dac_bits = 0
block_steps = 1
queue_steps = 16
"""


def _noise(known: Survey, width: float) -> tuple[float, float, float]:
    """V of a window two slope units wide, its standard deviation, and electrons of a spot (0: many).

    They come from a least-squares fit of the squared residuals of sums over a window's rows and columns to the light
    there.
    """
    square, light = (known.residual / width) ** 2, np.maximum(known.model / width, 0.0)
    columns = np.column_stack([np.ones(len(light)), light])
    (read, gain), *_ = np.linalg.lstsq(columns, square, rcond=None)
    errors = square - columns @ np.array([read, gain])
    read_sd, gain_sd = np.sqrt(np.diagonal(np.linalg.inv(columns.T @ columns)) * errors.var())
    density = width / 2  # the factor from such a variance to V
    if gain > 3 * gain_sd and read > 0:
        return float(read * density), float(read_sd * density), float(1 / (gain * width))
    return float(square.mean() * density), float(square.std() / math.sqrt(len(square)) * density), 0.0
