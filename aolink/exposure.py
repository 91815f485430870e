"""The class `Exposure`: all data of one camera integration.

All other parts of aolink meet here. The live session and the reader of recordings both make exposures (through
`aolink.assembly`), the in-memory simulator makes them directly, and the code that uses them cannot distinguish their
origin.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from aolink.plain import plain_data, shapes_shown


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Truth:
    """The true states and path of one exposure, from a simulated rig.

    No estimator reads it. What is not known is NaN: states, and the whole path of an output.
    """

    start_state: NDArray[np.float64]
    """State at the exposure's first fast step, (axes, n_states)."""
    end_state: NDArray[np.float64]
    """State one fast step after the exposure's last one, (axes, n_states)."""
    path: NDArray[np.float64]
    """Output at each fast step of the exposure, slope units, (n_outputs, n_steps); of its own interval, see
    `Exposure`."""

    __repr__ = shapes_shown

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which outputs have a known path, (n_outputs,)."""
        return np.asarray(np.isfinite(self.path).all(axis=1))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Picture:
    """The picture of the picture sensor in one exposure."""

    pixels: NDArray[np.uint16]
    """Counts, (rows, columns)."""
    mask: NDArray[np.bool_]
    """True where the pixel arrived, (rows, columns)."""

    __repr__ = shapes_shown


@plain_data
class Exposure:
    """One camera integration. Its arrays must not be changed; those of a recording cannot be.

    Where the camera exposes its rows one after the other (``sensor.row_time_s``), each spot has an interval of its own,
    that of the middle row of its window. The steps of an axis, its inputs, states and path are those of its own
    interval, which starts ``Rig.axis_delays`` steps after the exposure; where one plant moves several spots, they go
    from the first spot's interval to the end of the last one's.
    """

    frame_id: int
    """The camera's own count of its frames; a gap is a lost frame."""
    first_step: int
    """Fast step at which the exposure starts."""
    n_steps: int
    """N, the exposure's length in fast steps; longer where one plant moves spots that are exposed one after the
    other."""
    pixels: NDArray[np.uint16]
    """Counts, (rows, columns)."""
    mask: NDArray[np.bool_]
    """True where the pixel arrived, (rows, columns)."""
    inputs: NDArray[np.float64]
    """Input that the mirror applied at each fast step of the exposure, (n_steps, n_inputs)."""
    lead_inputs: NDArray[np.float64]
    """Inputs from the end of the exposure before this one to its start, (k, n_inputs).

    Empty where exposures follow each other without a gap; a lost frame or dead time makes it longer. Those of the first
    exposure go back to the mirror's first command, before which it was at rest.
    """
    start_offset: float = 0.0
    """The part f of its first fast step that passes before the exposure starts, 0 <= f < 1.

    It ends equally far into the step after its last: it covers 1 - f of its first step and f of the one after its last.
    States and path are still those of whole fast steps: the start state at ``first_step``, the end state ``n_steps``
    later.
    """
    inputs_assumed: int = 0
    """Number of steps of ``inputs`` and ``lead_inputs`` for which the mirror's report is missing.

    They hold the commanded inputs, rounded as the mirror's converter does.
    """
    chunks_lost: int = 0
    """Chunks of the frame that never arrived; their pixels are masked."""
    device_start_ns: int = 0
    """Start of the exposure on the camera's clock, ns."""
    device_end_ns: int = 0
    """End of the exposure on the camera's clock, ns."""
    host_start_ns: int = 0
    """The same start on the host's clock, as estimated when the frame came, ns."""
    host_receive_ns: int = 0
    """Time at which the host had the last chunk, on the host's clock, ns."""
    clock_sigma_ns: float = float("nan")
    """Standard deviation of ``host_start_ns`` by the clock regression, ns; NaN where there is none."""
    alignment_sigma_ns: float = 0.0
    """Standard deviation of the exposure's start relative to the mirror's fast steps, ns.

    Zero where the camera counts the steps together with its mirror. With two clocks it is the error of their
    comparison, which neighbouring exposures have in common: it does not average out.
    """
    row_sigma_ns: NDArray[np.float64] | None = None
    """Standard deviation of the start of each axis's own interval relative to the exposure's, ns, (axes,), where the
    camera or the film may expose row by row and nobody has said how fast; None where it is known."""
    slopes: NDArray[np.float64] | None = None
    """Slopes that other software measured, slope units, (all outputs of all axes,), NaN where it measured none.

    No pixel is known then: ``mask`` is False throughout. None where there are pixels.
    """
    scene: Picture | None = None
    """The picture of the same exposure, where the rig has a picture sensor. It comes after the spot's frame, so
    that an exposure that is estimated live does not have it yet."""
    truth: Truth | None = None
    """The true states and path, where they are known."""

    if not TYPE_CHECKING:  # the type checker would accept any name

        def __getattr__(self, name: str) -> Any:
            of = "it is an estimate's, and aolink.estimate gives a series: its estimates() have it"
            more = f": {of}" if name in ("path", "path_sd", "status", "start_state", "end_state", "nis") else ""
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}{more}")

    @property
    def complete(self) -> bool:
        """Whether every pixel arrived."""
        return bool(self.mask.all())


def step_shares(n_steps: int, offset: float) -> NDArray[np.float64]:
    """Share of an exposure in each of its fast steps, (n_steps,), and in the one after them, (n_steps + 1,), if f > 0.

    ``offset`` is `Exposure.start_offset`, f: the first step loses the share f / n_steps, and the one after the last
    gains it.
    """
    shares = np.full(n_steps, 1 / n_steps)
    if not offset:
        return shares
    shares[0] *= 1 - offset
    return np.append(shares, offset / n_steps)


def residual_rms(series: Iterable[Exposure]) -> float:
    """Root mean square of the true slopes at each fast step, slope units; NaN without truth."""
    squares = [float(np.mean(each.truth.path[each.truth.known] ** 2)) for each in series if each.truth is not None]
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")
