"""Inputs that a session plays in place of the rig file's drive: made by a rule, or taken from a file."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import max_len_seq

from aolink.devices.limits import CommandLimits
from aolink.errors import DeviceError, RigError
from aolink.limits import load_table
from aolink.numerics.arrays import FloatArray
from aolink.recording.reader import Recording
from aolink.rig import Rig
from aolink.session.replay import RecordedCommands

_BITS = 16
"""Bits of the shift register whose sequence ``prbs`` plays: it repeats after 65,535 values."""
_MOST_CHECKED = 1 << 20
"""Fast steps that are compared with the limits before the session; each is compared again when it is sent."""
_CHECKED = 4096
"""Fast steps that are compared at once."""
_NUMBERS = {
    "sine": {"frequency": math.nan},
    "chirp": {"from": math.nan, "to": math.nan, "period": 10.0},
    "prbs": {"to": math.nan, "seed": 1.0},
    "step": {"at": 0.5},
}
"""The parameters of each kind beside ``amplitude`` and ``column``, with their defaults; NaN where the parameter must be
given."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Excitation:
    """Inputs for `aolink.session.record`, and their description for the recording.

    Called with a fast step since the session's start and a number of steps, it gives the inputs, (n_steps, n_inputs).
    Steps must be requested in order.
    """

    text: str
    exposures: int
    """Number of exposures that the inputs last for; 0 for ever."""
    play: Callable[[int, int], FloatArray]
    repeat_steps: int
    """Number of fast steps after which the inputs repeat."""

    def __call__(self, first_step: int, n_steps: int) -> FloatArray:
        return self.play(first_step, n_steps)


def excitation(texts: Sequence[str], rig: Rig) -> Excitation:
    """Inputs as ``aolink record --input`` names them.

    Parameters
    ----------
    texts:
        Either one file: a recording, whose commands are sent again, or a .csv, .npy or .npz file with a row of inputs
        for each fast step, (n_steps, n_inputs), after which the safe input follows. Or any number of
        ``KIND:NAME=VALUE,...``, which are added to the offset of the rig's drive (``drive.offset``). The kinds, and
        their parameters beside ``amplitude`` (in units of the inputs) and ``column`` (which input, counted from 0; all
        of them without it):

        ``sine``: ``frequency``, Hz.
        ``chirp``: ``from`` and ``to``, Hz, and ``period`` (10 s), in which the frequency goes from one to the other;
        in the next it goes back.
        ``prbs``: ``to``, Hz, and ``seed`` (1): a pseudo-random binary sequence, plus and minus the amplitude. Each
        value lasts for half a period of ``to``, in whole fast steps; each input has another part of the sequence.
        ``step``: ``at`` (0.5), s after the session's start.

    Raises
    ------
    RigError
        The text, the file or a number in it is not valid.
    DeviceError
        An input would be beyond the mirror's limits, or change faster than ``mirror.slew_max_per_s``.
    RecordingError
        The file is a recording that cannot be read.
    """
    tried = _made(texts, rig)
    check_inputs(rig, tried, tried.repeat_steps)
    return _made(texts, rig)  # a recording's commands can be read once


def check_inputs(rig: Rig, inputs: Callable[[int, int], FloatArray], n_steps: int) -> None:
    """Compare the first ``n_steps`` steps of a session with the mirror's limits, a million of them at most.

    Raises
    ------
    DeviceError
        An input is beyond the mirror's limits, or changes faster than ``mirror.slew_max_per_s``.
    """
    limits = CommandLimits(rig)
    for first in range(0, min(n_steps, _MOST_CHECKED), _CHECKED):
        limits.check(first, inputs(first, min(_CHECKED, n_steps - first)))


def _made(texts: Sequence[str], rig: Rig) -> Excitation:
    if all(text.partition(":")[0] in _NUMBERS for text in texts):
        parts = [_part(text, rig) for text in texts]
        _check_range(rig, rig.drive.offset + sum(each.least for each in parts))
        _check_range(rig, rig.drive.offset + sum(each.most for each in parts))
        return Excitation(
            text=" ".join(texts),
            exposures=0,
            play=lambda first, n_steps: rig.drive.offset + sum(each.play(first, n_steps) for each in parts),
            repeat_steps=max(each.repeat_steps for each in parts),
        )
    if len(texts) > 1 or not Path(texts[0]).is_file():
        raise RigError(
            f"--input {' '.join(texts)}: expected one file, or KIND:NAME=VALUE,... with a kind of {', '.join(_NUMBERS)}"
        )
    return _of_file(Path(texts[0]), rig)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    play: Callable[[int, int], FloatArray]
    """First step and number of steps -> changes of the inputs, (n_steps, n_inputs)."""
    least: FloatArray
    most: FloatArray
    """(n_inputs,)"""
    repeat_steps: int


def _part(text: str, rig: Rig) -> _Part:
    kind, _, rest = text.partition(":")
    numbers = _numbers(text, kind, rest)
    step_s, columns = rig.timing.fast_step_s, np.arange(rig.n_inputs)
    if not (math.isnan(column := numbers["column"]) or column in columns):
        raise RigError(f"--input {text}: column={column:g} is not one of the inputs 0 to {rig.n_inputs - 1}")
    amplitude = np.where(np.isnan(column) | (columns == column), numbers["amplitude"], 0.0)
    nyquist_hz = 0.5 / step_s
    shape: Callable[[FloatArray], FloatArray]
    for name in ("frequency", "from", "to"):
        if not 0 < numbers.get(name, nyquist_hz) <= nyquist_hz:
            raise RigError(f"--input {text}: {name}={numbers[name]:g} Hz is not above 0 and up to {nyquist_hz:g}")
    if kind == "sine":
        frequency = numbers["frequency"]
        shape, repeat = (lambda t: np.sin(2 * np.pi * frequency * t)), 1 / frequency
    elif kind == "chirp":
        if numbers["period"] <= 0:
            raise RigError(f"--input {text}: period={numbers['period']:g} s is not above 0")
        low, high, period = numbers["from"], numbers["to"], numbers["period"]
        shape, repeat = (lambda t: np.sin(2 * np.pi * _chirp_cycles(t, low, high, period))), 2 * period
    elif kind == "prbs":
        return _prbs(amplitude, max(1, round(0.5 / numbers["to"] / step_s)), numbers["seed"])
    else:
        at = numbers["at"]
        shape, repeat = (lambda t: (t >= at).astype(np.float64)), at + step_s

    def play(first_step: int, n_steps: int) -> FloatArray:
        times = np.asarray(np.arange(first_step, first_step + n_steps) * step_s, np.float64)
        return np.asarray(shape(times)[:, None] * amplitude)

    low_end = np.zeros_like(amplitude) if kind == "step" else -amplitude
    ends = np.stack([low_end, amplitude])
    return _Part(play=play, least=ends.min(0), most=ends.max(0), repeat_steps=math.ceil(repeat / step_s) + 1)


def _numbers(text: str, kind: str, rest: str) -> dict[str, float]:
    numbers = {"amplitude": math.nan, "column": math.nan, **_NUMBERS[kind]}
    for part in filter(None, rest.split(",")):
        name, _, value = part.partition("=")
        if name not in numbers:
            raise RigError(f"--input {text}: {kind} has no {name}, but {', '.join(numbers)}")
        try:
            numbers[name] = float(value)
        except ValueError:
            numbers[name] = math.inf
        if not math.isfinite(numbers[name]):
            raise RigError(f"--input {text}: expected a number after {name}=")
    if lacking := [name for name, value in numbers.items() if math.isnan(value) and name != "column"]:
        raise RigError(f"--input {text}: give {', '.join(f'{name}=NUMBER' for name in lacking)}")
    return numbers


def _chirp_cycles(t: FloatArray, low: float, high: float, period_s: float) -> FloatArray:
    """Cycles since the beginning, for a frequency that goes from ``low`` to ``high`` and back, ``period_s`` each
    way."""
    whole, since = np.divmod(t, 2 * period_s)
    up, down = np.minimum(since, period_s), np.maximum(since - period_s, 0.0)
    bend = (high - low) / (2 * period_s)
    return np.asarray(whole * (low + high) * period_s + low * up + bend * up**2 + high * down - bend * down**2)


def _prbs(amplitude: FloatArray, hold_steps: int, seed: float) -> _Part:
    signs = 2.0 * max_len_seq(_BITS)[0] - 1
    start = np.random.default_rng(abs(int(seed))).integers(len(signs))
    starts = start + np.arange(len(amplitude)) * (len(signs) // len(amplitude))

    def play(first_step: int, n_steps: int) -> FloatArray:
        bits = np.arange(first_step, first_step + n_steps) // hold_steps
        return np.asarray(signs[(bits[:, None] + starts) % len(signs)] * amplitude)

    size = np.abs(amplitude)
    return _Part(play=play, least=-size, most=size, repeat_steps=len(signs) * hold_steps)


def _check_range(rig: Rig, u: FloatArray) -> None:
    low, high = rig.mirror.input_min, rig.mirror.input_max
    for channel in np.flatnonzero(~((u >= low) & (u <= high))):
        raise DeviceError(
            f"--input would drive input {channel} to {u[channel]:g}, beyond the mirror's limits {low[channel]:g} .."
            f" {high[channel]:g}: give a smaller amplitude, or another drive.offset"
        )


def _of_file(path: Path, rig: Rig) -> Excitation:
    timing, text = rig.timing, f"file {path.name}"
    if path.suffix == ".mcap":
        commands = RecordedCommands(Recording(path))
        steps = commands.exposures * timing.frame_period_steps
        return Excitation(text=text, exposures=commands.exposures, play=commands.inputs, repeat_steps=steps)
    u = _table(path, rig.n_inputs)

    def play(first_step: int, n_steps: int) -> FloatArray:
        rows = np.tile(rig.mirror.park, (n_steps, 1))
        known = u[first_step : first_step + n_steps]
        rows[: len(known)] = known
        return rows

    exposures = max(1, (len(u) - timing.exposure_steps) // timing.frame_period_steps + 1)
    return Excitation(text=text, exposures=exposures, play=play, repeat_steps=len(u))


def _table(path: Path, n_inputs: int) -> FloatArray:
    """The inputs of a file, (n_steps, n_inputs). Raises RigError."""
    try:
        u = load_table(path)
    except (OSError, ValueError, EOFError) as error:
        raise RigError(
            f"{path} is not a table of inputs: {error}; expected a recording (.mcap), or a .csv, .npy or .npz file with"
            " one array"
        ) from None
    u = u[:, None] if u.ndim == 1 else u
    if u.ndim != 2 or u.shape[1] != n_inputs or not len(u):
        raise RigError(f"{path} has inputs of shape {u.shape}, expected a row of {n_inputs} for each fast step")
    return u
