"""Inputs that a session plays in place of the rig file's drive: made by a rule, or taken from a file."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import chirp, max_len_seq

from aolink.devices.limits import CommandLimits
from aolink.errors import RigError
from aolink.limits import load_array
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
        Either one file: a recording, whose commands are sent again, or a .npy file with a row of inputs for each fast
        step, (n_steps, n_inputs), after which the safe input follows. Or any number of ``KIND:NAME=VALUE,...``, which
        are added to the offset of the rig's drive (``drive.offset``). The kinds, and their parameters beside
        ``amplitude`` (in units of the inputs) and ``column`` (which input, counted from 0; all of them without it):

        ``sine``: ``frequency``, Hz.
        ``chirp``: ``from`` and ``to``, Hz, and ``period`` (10 s), in which the frequency goes from one to the other;
        the next period is the same backwards.
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
        parts = [_signal(text, rig) for text in texts]
        return Excitation(
            text=" ".join(texts),
            exposures=0,
            play=lambda first, n_steps: (
                rig.drive.offset + sum(play(np.arange(first, first + n_steps)) for play, _ in parts)
            ),
            repeat_steps=max(repeat_steps for _, repeat_steps in parts),
        )
    path = Path(texts[0])
    if len(texts) > 1 or path.suffix not in (".mcap", ".npy") or not path.is_file():
        raise RigError(
            f"--input {' '.join(texts)}: expected one file, a recording (.mcap) or .npy, or KIND:NAME=VALUE,... with a"
            f" kind of {', '.join(_NUMBERS)}"
        )
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


def _signal(text: str, rig: Rig) -> tuple[Callable[[NDArray[np.int64]], FloatArray], int]:
    """A function that gives the changes of the inputs in some fast steps, (n_steps, n_inputs); and the number of steps
    after which they repeat."""
    kind, step_s, columns = text.partition(":")[0], rig.timing.fast_step_s, np.arange(rig.n_inputs)
    numbers = _numbers(text, rig)
    amplitude = np.where(np.isnan(numbers["column"]) | (columns == numbers["column"]), numbers["amplitude"], 0.0)
    if kind == "prbs":
        signs, hold_steps = 2.0 * max_len_seq(_BITS)[0] - 1, max(1, round(0.5 / numbers["to"] / step_s))
        start = np.random.default_rng(abs(int(numbers["seed"]))).integers(len(signs))
        starts = start + columns * (len(signs) // len(columns))
        return (
            lambda steps: np.asarray(signs[((steps // hold_steps)[:, None] + starts) % len(signs)] * amplitude),
            len(signs) * hold_steps,
        )
    shape: Callable[[FloatArray], FloatArray]
    if kind == "step":
        at = numbers["at"]
        shape, repeat_s = (lambda t: np.asarray(t >= at, np.float64)), at + step_s
    elif kind == "sine":
        frequency = numbers["frequency"]
        shape, repeat_s = (lambda t: np.sin(2 * np.pi * frequency * t)), 1 / frequency
    else:
        low, high, period = numbers["from"], numbers["to"], numbers["period"]

        def shape(t: FloatArray) -> FloatArray:
            there_and_back = period - np.abs(t % (2 * period) - period)
            return np.asarray(chirp(there_and_back, low, period, high, phi=-90))

        repeat_s = 2 * period
    return lambda steps: np.asarray(shape(steps * step_s)[:, None] * amplitude), math.ceil(repeat_s / step_s) + 1


def _numbers(text: str, rig: Rig) -> dict[str, float]:
    kind, _, rest = text.partition(":")
    given = dict(part.partition("=")[::2] for part in rest.split(",") if part)
    numbers = {"amplitude": math.nan, "column": math.nan, **_NUMBERS[kind]}
    if unknown := given.keys() - numbers.keys():
        raise RigError(f"--input {text}: {kind} has no {', '.join(sorted(unknown))}, but {', '.join(numbers)}")
    try:
        numbers |= {name: float(value) for name, value in given.items()}
    except ValueError as error:
        raise RigError(f"--input {text}: {error}") from None
    if lacking := [name for name, value in numbers.items() if not math.isfinite(value) and name != "column"]:
        raise RigError(f"--input {text}: give {', '.join(f'{name}=NUMBER' for name in lacking)}")
    nyquist_hz = 0.5 / rig.timing.fast_step_s
    for name, most in (("frequency", nyquist_hz), ("from", nyquist_hz), ("to", nyquist_hz), ("period", math.inf)):
        if not 0 < numbers.get(name, most) <= most:
            raise RigError(f"--input {text}: {name}={numbers[name]:g} is not above 0 and up to {most:g}")
    if not (math.isnan(column := numbers["column"]) or column in range(rig.n_inputs)):
        raise RigError(f"--input {text}: column={column:g} is not one of the inputs 0 to {rig.n_inputs - 1}")
    return numbers


def _table(path: Path, n_inputs: int) -> FloatArray:
    """The inputs of a file, (n_steps, n_inputs). Raises RigError."""
    try:
        u = load_array(path).astype(np.float64)
    except (OSError, ValueError, EOFError, TypeError) as error:
        raise RigError(f"{path} is not a table of inputs: {error}") from None
    u = u[:, None] if u.ndim == 1 else u
    if u.ndim != 2 or u.shape[1] != n_inputs or not len(u):
        raise RigError(f"{path} has inputs of shape {u.shape}, expected a row of {n_inputs} for each fast step")
    return u
