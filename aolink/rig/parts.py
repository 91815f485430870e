"""The parts of a rig as frozen dataclasses: plant, timing, mirror driver, drive, and the parts of a simulated rig."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np

from aolink.errors import RigError
from aolink.keys import Count, NotNegative, Positive, Shape, Share, Within, as_it_is, checked
from aolink.numerics.arrays import FloatArray
from aolink.optics.mirror import VoltageLaw

Seconds = Annotated[float, Within(0.0, 60.0)]


@dataclass(frozen=True, kw_only=True)
class UnmodelledSlopes:
    """The estimators' model of slopes that the camera sees and the plant's model does not make.

    Examples are the fitting error of a deformable mirror, which its actuators cannot make, and turbulence that no state
    follows. They add to the outputs, theta(k) = C x(k) + v(k), with v Gaussian, independent of the state and from
    output to output, and

        Cov(v(i), v(j)) = sd^2 exp(-((i - j) / correlation_steps)^2)  within an exposure,  0 between exposures.

    The mean of v over an exposure is one coefficient of each output in the exposure's model. Estimators that model the
    noise inside an exposure estimate it from that exposure alone: this model has no memory of v between exposures.
    The variation of v about its mean widens the spot.
    """

    sd: float
    """Standard deviation of the slopes at any one time, slope units."""
    correlation_steps: float
    """Fast steps in which their correlation falls to 1/e."""

    def variances(self, n_steps: int) -> tuple[float, float]:
        """Variance of the mean over an exposure and mean variance about it, slope units squared; they sum to sd^2."""
        lag = np.arange(1, n_steps)
        pairs = n_steps + 2 * float(((n_steps - lag) * np.exp(-((lag / self.correlation_steps) ** 2))).sum())
        share = pairs / n_steps**2
        return self.sd**2 * share, self.sd**2 * (1 - share)


@dataclass(frozen=True, kw_only=True, eq=False)
class Plant:
    """The fast-rate plant, x(k+1) = A x(k) + B u(k) + B_w w(k), theta(k) = C x(k)  (Mishra & Wen (1)).

    ``axes`` independent copies of it make the rig; each has its own state, output and inputs.
    """

    A: Annotated[FloatArray, Shape("states", "states")]
    """State transition over one fast step, (n_states, n_states)."""
    B: Annotated[FloatArray, Shape("states", "inputs")]
    """Input matrix, (n_states, n_inputs)."""
    B_w: Annotated[FloatArray, Shape("states", "noises")]
    """Process-noise input matrix, (n_states, n_noises)."""
    C: Annotated[FloatArray, Shape("outputs", "states")]
    """Output matrix, (n_outputs, n_states); the outputs are spot positions in slope units."""
    process_noise: Annotated[FloatArray, Shape("noises", "noises")]
    """W_f, covariance of w(k) per fast step, (n_noises, n_noises)."""
    initial_mean: Annotated[FloatArray, Shape("states", default=0.0)]
    """Mean of x(0), (n_states,)."""
    initial_covariance: Annotated[FloatArray, as_it_is]
    """Covariance of x(0), (n_states, n_states)."""
    axes: Annotated[int, Within(1, 10_000)] = 1
    """Number of independent copies."""
    unmodelled: Annotated[UnmodelledSlopes | None, as_it_is] = None
    """The estimators' model of slopes beside C x(k), as a fitting error and turbulence; None for no such slopes."""
    disturbance_states: int = 0
    """Number of the last states, which are those of the disturbance's model and which no input reaches."""
    delays: tuple[int, ...] = ()
    """Fast steps by which the camera sees each output later than the first, (n_outputs,), where it exposes row by row
    and the plant moves several spots; empty where it sees all at once."""

    @property
    def n_states(self) -> int:
        return int(self.A.shape[0])

    @property
    def n_inputs(self) -> int:
        """Inputs of one copy."""
        return int(self.B.shape[1])

    @property
    def n_outputs(self) -> int:
        """Outputs of one copy."""
        return int(self.C.shape[0])

    @property
    def last_delay(self) -> int:
        """The longest of the delays, fast steps."""
        return max(self.delays, default=0)


@dataclass(frozen=True, kw_only=True)
class Timing:
    """The timing of fast steps and exposures. Exposure j covers ``exposure_steps`` steps from j *
    ``frame_period_steps`` on."""

    fast_step_s: Annotated[float, Within(1e-6, 1e4)]
    """T_f, s."""
    exposure_steps: Annotated[int, Within(1, 1_000_000)]
    """N, fast steps in one exposure."""
    frame_period_steps: Annotated[int, Within(1, 10_000_000)]
    """Fast steps from the start of one exposure to the start of the next; at least N, which it is if left out."""
    exposure_offset: Annotated[float, Within(0.0, below=1.0)] = 0.0
    """Part of its first fast step that passes before an exposure starts, below one; it ends equally far into a step."""

    @cached_property
    def fast_step_ns(self) -> int:
        return round(self.fast_step_s * 1e9)

    @property
    def exposure_ns(self) -> int:
        return self.exposure_steps * self.fast_step_ns

    @property
    def frame_period_ns(self) -> int:
        return self.frame_period_steps * self.fast_step_ns

    @property
    def exposure_offset_ns(self) -> int:
        return round(self.exposure_offset * self.fast_step_ns)


@dataclass(frozen=True, kw_only=True, eq=False)
class MirrorDriver:
    """The mirror driver: limits, resolution, queue."""

    input_min: Annotated[FloatArray, Shape("inputs")]
    """Least inputs, (axes * n_inputs,)."""
    input_max: Annotated[FloatArray, Shape("inputs")]
    """Largest inputs, (axes * n_inputs,)."""
    park: Annotated[FloatArray, Shape("inputs", default=0.0)]
    """Declared safe input, (axes * n_inputs,)."""
    dac_bits: Annotated[int, Within(0, 32)] = 16
    """Commands are rounded to 2^dac_bits levels between the limits; 0 means not rounded."""
    block_steps: Annotated[int, Within(1)]
    """Fast steps in one command block; if left out 50, or as many as fit into a packet."""
    queue_steps: Annotated[int, Within(1)]
    """Fast steps that the device can hold; if left out eight blocks."""
    watchdog_s: Annotated[float, Within(above=0.0, high=60.0)] = 1.0
    """The mirror parks itself when no valid packet has come for this time, s."""
    slew_max_per_s: NotNegative = 0.0
    """Most that an input may change in a second; the host refuses commands that change faster. 0 for no limit."""
    voltage: VoltageLaw | None = None
    """The law of electrostatic actuators: the converter's equal steps are then those of the voltage, not the input."""

    def quantise(self, u: FloatArray) -> FloatArray:
        """The input that the converter puts out for ``u``, (..., axes * n_inputs)."""
        if not self.dac_bits:
            return u.copy()
        if self.voltage is not None:
            volt = self.voltage.max_v / ((1 << self.dac_bits) - 1)
            return self.voltage.force(np.round(self.voltage.volts(u) / volt) * volt)
        step = (self.input_max - self.input_min) / ((1 << self.dac_bits) - 1)
        return self.input_min + np.round((u - self.input_min) / step) * step


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """The known input that a session plays when nothing closes the loop."""

    kind: Literal["none", "sine"] = "none"
    amplitude: Annotated[FloatArray, Shape("inputs")]
    """(axes * n_inputs,)"""
    period_s: Positive
    """Period of the sine, s."""
    offset: Annotated[FloatArray, Shape("inputs", default=0.0)]
    """(axes * n_inputs,)"""

    def inputs(self, first_step: int, n_steps: int, fast_step_s: float) -> FloatArray:
        """Inputs for ``n_steps`` fast steps from ``first_step``, (n_steps, axes * n_inputs)."""
        u = np.tile(self.offset, (n_steps, 1))
        if self.kind == "sine":
            t = np.arange(first_step, first_step + n_steps) * fast_step_s
            u += np.sin(2 * np.pi * t / self.period_s)[:, None] * self.amplitude
        return u


@dataclass(frozen=True, kw_only=True)
class Control:
    """How the loop is closed, where a session closes it."""

    delay_s: NotNegative = 0.01
    """Least time from the end of an exposure to the beginning of the first fast step that its estimate can change, s:
    read-out, link and estimator. On virtual time it is exactly this, rounded up to whole fast steps."""
    when_lost: Literal["hold", "park"] = "hold"
    """The mirror's action while the spot's position is not known reliably: it holds its input, or goes to the safe
    one."""
    gain: Positive = 0.5
    """Gain of the integrator."""
    leak: Share = 0.01
    """Share of itself that the integrator loses with each exposure."""
    least_singular_value: Share = 0.03
    """Mirror modes that move the slopes by less than this share of the strongest one are left out by the integrator."""
    effort: Positive = 1e-3
    """Weight of the inputs in the cost of ``lqg``, relative to the slopes that they make at rest."""
    fall_back: bool = True
    """Whether the integrator, or a mirror that holds still, acts in place of ``lqg`` while ``lqg`` is worse."""


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Faults that the simulated rig injects, by rate and by seed; all zero means a perfect link.

    Rates are probabilities. Those of bits and bytes hold in both directions, from the byte after Identify on,
    delimiters included. The host sees a fault as on a real line: nothing is marked.
    """

    bit_error_rate: Share = 0.0
    """A bit is flipped."""
    byte_loss_rate: Share = 0.0
    """A byte is lost."""
    byte_repeat_rate: Share = 0.0
    """A byte comes twice."""
    byte_insert_rate: Share = 0.0
    """A random byte comes before a byte."""
    burst_rate: Share = 0.0
    """A burst of noise begins at a byte: 1 to 64 bytes are replaced by random ones, as far as the packet goes."""
    bit_flip_rate: Share = 0.0
    """A packet from the device has one bit flipped."""
    packet_loss_rate: Share = 0.0
    """A packet from the device is lost."""
    command_loss_rate: Share = 0.0
    """A packet to the device is lost."""
    duplicate_rate: Share = 0.0
    """A packet from the device is sent twice."""
    stall_rate: Share = 0.0
    """The line stands still for ``stall_s`` before a packet; those behind it wait as well."""
    stall_s: Seconds = 0.1
    """How long it stands still, s."""
    jitter_s: Seconds = 0.0
    """Mean of a random, exponentially distributed delay of each packet, s; packets keep their order."""
    delay_to_device_s: Seconds = 0.0
    """Constant delay of the host's packets, s."""
    delay_to_host_s: Seconds = 0.0
    """Constant delay of the device's packets, s."""
    clock_step_s: Annotated[float, Within(-60.0, 60.0)] = 0.0
    """Step by which the device's clock is set forward, s; negative: back. Its fast steps go on."""
    clock_step_at_s: Seconds = 1.0
    """Time of that step, s after the rig has begun."""
    vanish_rate: Share = 0.0
    """The port vanishes with a packet, one way or the other, and returns after ``vanish_s``; in real time only."""
    vanish_s: Seconds = 1.0
    """How long it is gone, s."""
    late_rate: Share = 0.0
    """A command block is taken only when half of its steps have gone by."""
    chunk_loss_rate: Share = 0.0
    """The camera does not send a chunk of a frame."""
    saturation_rate: Share = 0.0
    """A pixel is at full scale."""
    dark_rate: Share = 0.0
    """A frame has no light: it has black level and read-out noise alone."""


FAULT_NAMES = {
    "bitflip": "bit_error_rate", "lost": "byte_loss_rate", "repeated": "byte_repeat_rate",
    "inserted": "byte_insert_rate", "burst": "burst_rate", "stall": "stall_rate", "vanish": "vanish_rate",
    "late": "late_rate", "missing": "chunk_loss_rate", "saturated": "saturation_rate", "dark": "dark_rate",
}  # fmt: skip
"""Short names of faults, as ``aolink sim --fault`` takes them beside the keys themselves."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """The light that the simulated camera sees, from one start of it to the next."""

    kind: Literal["dark", "flat", "still", "moving"]
    """The kind of light: none; the same density everywhere; the spot held where it is when the camera starts; the
    moving spot."""
    level: float | None = None
    """Density of a flat, one over slope units; None: halfway from the black level to the full scale."""


def parse_light(text: Any, name: str) -> tuple[Light, ...]:
    """A sequence of lights from a text such as ``dark,flat:4,still``; errors call it ``name``. Raises RigError."""
    lights = []
    for word in checked(str, text, name).split(","):
        kind, colon, level = word.strip().partition(":")
        if kind not in ("dark", "flat", "still", "moving") or (colon and kind != "flat"):
            raise RigError(f"{name}: {word.strip()!r} is not known: use dark, flat, flat:DENSITY, still, moving")
        try:
            density = float(level) if colon else None
        except ValueError:
            density = math.nan
        if density is not None and not 0 < density < math.inf:
            raise RigError(f"{name}: the density of {word.strip()!r} must be a number above 0")
        lights.append(Light(kind=kind, level=density))
    return tuple(lights)


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """The parameters of the simulated rig alone."""

    seed: Count = 1
    light: Annotated[tuple[Light, ...], parse_light] = (Light(kind="moving"),)
    """The lights: each start of the camera takes the next one; the last one stays."""
    clock_offset_s: Annotated[float, Within(-1e9, 1e9)] = 0.0
    """Device clock minus host clock at the start, s."""
    clock_drift_ppm: Annotated[float, Within(-1000.0, 1000.0)] = 0.0
    """How much faster the device clock runs than the host's, parts per million."""
    latency_s: Annotated[float, Within(0.0, 0.1)] = 100e-6
    """Median one-way latency of the link on virtual time, s."""
    faults: Faults = Faults()
