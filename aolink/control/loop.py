"""The closed loop, without time, files or ports: it takes exposures and estimates, and gives the mirror's input for
each fast step."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np

from aolink.control.checked import CheckedController
from aolink.control.controller import ControllerRow, Seen
from aolink.control.fall_back import FallBack
from aolink.control.registry import find_controller
from aolink.errors import ControlError
from aolink.estimation import Estimate, Needs, Status
from aolink.estimation.frames.measure import measure
from aolink.estimation.verdict import Fit
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.numerics.rms import rms
from aolink.rig import Rig

BLIND_EXPOSURES = 5
"""Exposures in a row without a measurement over which the prediction is trusted."""
TRUSTED_EXPOSURES = 3
"""Exposures in a row with a measurement after which a loop that was lost is closed again."""
_CENTROIDS = Needs(what="moments", orders=(1,))


class State(enum.IntEnum):
    """The state of the loop. The numbers are those of the recording's schema."""

    CLOSED = 0
    HELD = 1
    """The mirror holds the input that it had when the loop was lost."""
    PARKED = 2
    """The mirror is commanded to its safe input."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Act:
    """The result of the loop for one exposure."""

    frame_id: int
    first_step: int
    """The first fast step whose input it changed."""
    delay_steps: int
    """Fast steps from the exposure's end to that step."""
    late: bool
    """Whether that is later than ``control.delay_s`` asks for."""
    state: State
    reason: str
    """The reason why the loop is open; empty while it is closed."""
    slope_rms: float
    """Root mean square of the centroids, slope units; NaN where none was measured."""
    path_rms: float
    """Root mean square of the estimated path inside the exposure, slope units; NaN without an estimate."""
    clipped_steps: int
    """Fast steps from the exposure before to this one whose wanted input the limits or the slew limit have changed."""
    acting: str
    """The controller that acts: another one while the loop's own is worse (`FallBack`)."""
    gained: float
    """Where another controller acts from this exposure on because it is better, the reduction of the slopes with it, as
    a share of their root mean square; NaN otherwise."""


def centroids(rig: Rig, exposure: Exposure) -> FloatArray:
    """Mean of each slope over an exposure, by the centroids of its frame, slope units, (n_outputs,); NaN for none."""
    measured, _ = measure(rig, exposure, _CENTROIDS)
    if measured is None:
        return np.full(rig.n_outputs, np.nan)
    value = np.asarray(measured.value, dtype=np.float64)  # type: ignore[union-attr] # moments were asked for
    if measured.usable is not None:
        value = np.where(measured.usable[:, None], value, np.nan)
    return value.reshape(rig.n_outputs)


class ControlLoop:
    """A controller on a rig: it gives the input for the mirror in each fast step, and keeps it within limits.

    Parameters
    ----------
    controller:
        Its name, or its row.

    Raises
    ------
    ControlError
        As `find_controller` and `CheckedController`.
    """

    def __init__(self, rig: Rig, controller: str | ControllerRow) -> None:
        row = find_controller(controller, rig) if isinstance(controller, str) else controller
        check_exposed_at_once(rig)
        self.name, self.needs_state = row.name, row.needs_state
        self.delay_steps = delay_steps(rig)
        self.state, self.reason = State.CLOSED, ""
        self._rig, self._controller = rig, CheckedController(row, rig)
        self._fall_back: FallBack | None = None
        if row.believes_a_model and rig.control.fall_back:
            self._fall_back = FallBack(rig, row, self.delay_steps)
        mirror = rig.mirror
        self._low, self._high, self._park = mirror.input_min, mirror.input_max, mirror.park
        self._most_change = mirror.slew_max_per_s * rig.timing.fast_step_s or math.inf
        self._oldest = 0
        """Fast step of the first row in the lists below; older rows are dropped."""
        self._sent: list[FloatArray] = []
        """The commanded inputs, step by step."""
        self._held: list[FloatArray] = []
        """The inputs that the mirror holds, step by step."""
        self._limited: list[bool] = []
        """Whether limits or the slew limit have changed the wanted input."""
        self._before = (self._park, self._park)
        """The commanded and the held input of the step before the oldest row."""
        self._last_end = 0
        """End of the newest exposure with a measurement; before there is one, the session's beginning."""
        self._seen_any = False
        self._blind = self._trusted = 0
        self._clipped = 0
        timing = rig.timing
        self._patience = (BLIND_EXPOSURES + 1) * timing.frame_period_steps + self.delay_steps
        self._most_rows = 4 * self._patience + 2 * mirror.queue_steps
        """Rows that are kept where no exposure comes: those of queued steps, and for exposures that come late."""

    @property
    def next_step(self) -> int:
        """The first fast step whose input is not fixed."""
        return self._oldest + len(self._sent)

    def begin(self, first_step: int) -> None:
        """Set the session's first fast step, before any other call; it is 0 otherwise. Until the first exposure is seen
        the mirror holds its safe input."""
        self._oldest = self._last_end = first_step

    def inputs(self, first_step: int, n_steps: int) -> FloatArray:
        """Inputs to command for ``n_steps`` fast steps from ``first_step``, (n_steps, n_inputs); the same when called
        again, until an exposure changes them. Raises ControlError if the controller fails."""
        while self.next_step < first_step + n_steps:
            self._go_on()
        start = first_step - self._oldest
        if start < 0:
            raise ValueError(f"fast step {first_step} is before {self._oldest}: its input is forgotten")
        return np.array(self._sent[start : start + n_steps]).reshape(n_steps, len(self._park))

    def commanded(self, first_step: int, u: FloatArray) -> None:
        """Take the inputs that the mirror was sent from ``first_step`` on, (k, n_inputs), where they may differ from
        `inputs`: the loop goes on from them. Raises ControlError as `inputs` does."""
        for step, row in enumerate(u, first_step):
            if step < self._oldest:
                continue
            while self.next_step <= step:
                self._go_on()
            if not np.array_equal(self._sent[step - self._oldest], row):
                self._sent[step - self._oldest], self._held[step - self._oldest] = row, self._rig.mirror.quantise(row)

    def applied(self, first_step: int, u: FloatArray) -> None:
        """Take the inputs that the mirror reports from ``first_step`` on, (k, n_inputs)."""
        for step, row in enumerate(u, first_step):
            if 0 <= step - self._oldest < len(self._held):
                self._held[step - self._oldest] = row

    def see(self, exposure: Exposure, estimate: Estimate | None, earliest_step: int) -> Act:
        """Take the next exposure, with its estimate where the controller needs one.

        ``earliest_step`` is the first fast step whose input can still be changed. Steps before it stay as they are;
        those from the returned ``first_step`` on must be sent anew, also where they were sent before.
        """
        end = exposure.first_step + exposure.n_steps
        first = max(end + self.delay_steps, earliest_step, self._oldest)
        while self.next_step < first:
            self._go_on()
        slopes = centroids(self._rig, exposure)
        self._judge(slopes, estimate, end)
        if first - end > self._patience:
            self._trusted = 0
            self.lose(f"frame {exposure.frame_id} came {first - end} fast steps late")
        self._forget_from(first)
        pending = np.array(self._held[max(end - self._oldest, 0) : first - self._oldest]).reshape(-1, len(self._park))
        verdict = None if estimate is None else estimate.verdict
        gained = self._compare(exposure, slopes, verdict is not None and verdict.fit is Fit.DOES_NOT_FIT)
        if self.state is State.CLOSED and len(pending):
            state = None if estimate is None else estimate.end_state
            self._controller.see(Seen(slopes=slopes, state=state, pending=pending))
            self._seen_any = True
        self._drop_before(exposure.first_step)
        clipped, self._clipped = self._clipped, 0
        return Act(
            frame_id=exposure.frame_id, first_step=first, delay_steps=first - end,
            late=first > end + self.delay_steps, state=self.state, reason=self.reason,
            slope_rms=rms(slopes[np.isfinite(slopes)]),
            path_rms=math.nan if estimate is None else rms(estimate.path[np.isfinite(estimate.path)]),
            clipped_steps=clipped, acting=self.acting, gained=gained,
        )  # fmt: skip

    @property
    def acting(self) -> str:
        """The controller that acts."""
        return self.name if self._fall_back is None else self._fall_back.acting

    def lose(self, reason: str) -> None:
        """Open the loop: hold or park the mirror, as the rig file says, until exposures can be trusted again."""
        if self.state is State.CLOSED:
            self.state = State.PARKED if self._rig.control.when_lost == "park" else State.HELD
            self._trusted = 0
        self.reason = reason

    def _compare(self, exposure: Exposure, slopes: FloatArray, misfits: bool) -> float:
        """Let another controller act where this one is worse, or this one again; what is gained, NaN where unknown."""
        if self._fall_back is None:
            return math.nan
        if self.state is not State.CLOSED or not self._seen_any:
            self._fall_back.interrupt()
            return math.nan
        gained = self._fall_back.see(exposure, slopes, misfits)
        if gained is None:
            return math.nan
        self._controller = self._fall_back.controller()
        return gained

    def _judge(self, slopes: FloatArray, estimate: Estimate | None, end: int) -> None:
        """Decide whether the loop is closed, from the quality of this exposure's measurement."""
        status = Status.OK if estimate is None else estimate.status
        if status in (Status.DIVERGED, Status.REINITIALISED):
            self._trusted = 0
            self.lose(f"the estimator is {status.name.lower()} at frame {estimate.frame_id}" if estimate else "")
            return
        if not np.isfinite(slopes).any() or status is Status.GATED:
            self._blind, self._trusted = self._blind + 1, 0
            if self._blind > BLIND_EXPOSURES:
                self.lose(f"{self._blind} exposures in a row gave no measurement")
            return
        if self._seen_any and end - self._last_end > self._patience:
            self.lose(f"no measurement had come for {end - self._last_end} fast steps")
        self._blind, self._trusted, self._last_end = 0, self._trusted + 1, end
        if self.state is not State.CLOSED and self._trusted >= TRUSTED_EXPOSURES:
            self.state, self.reason = State.CLOSED, ""

    def _go_on(self) -> None:
        """Fix the input of the next step."""
        step = self.next_step
        sent, held = (self._sent[-1], self._held[-1]) if self._sent else self._before
        lost = self.state is not State.CLOSED or step - self._last_end > self._patience
        if not self._seen_any or (lost and self._rig.control.when_lost == "park"):
            wanted = self._park
        else:
            wanted = sent if lost else self._controller.step(held)
        u = np.minimum(np.maximum(wanted, self._low), self._high)
        if self._most_change < math.inf:
            u = np.minimum(np.maximum(u, sent - self._most_change), sent + self._most_change)
        self._limited.append(bool((u != wanted).any()))
        self._sent.append(u)
        self._held.append(self._rig.mirror.quantise(u))
        if len(self._sent) > self._most_rows:
            self._drop_before(self._oldest + self._most_rows // 2)

    def _forget_from(self, step: int) -> None:
        for rows in (self._sent, self._held, self._limited):
            del rows[step - self._oldest :]

    def _drop_before(self, step: int) -> None:
        n = min(step - self._oldest, len(self._sent) - 1)
        if n > 0:
            self._before = self._sent[n - 1], self._held[n - 1]
            self._clipped += sum(self._limited[:n])
            for rows in (self._sent, self._held, self._limited):
                del rows[:n]
            self._oldest += n


def delay_steps(rig: Rig) -> int:
    """``control.delay_s`` in whole fast steps, at least one: the step after an exposure's last has begun at the
    exposure's end."""
    return max(1, math.ceil(rig.control.delay_s / rig.timing.fast_step_s - 1e-9))


def check_exposed_at_once(rig: Rig) -> None:
    """Raise `ControlError` where the rig's camera exposes its rows one after the other."""
    if rig.readout_steps:
        raise ControlError(
            "a controller takes the whole frame to be exposed at once, and sensor.row_time_s (or scene.row_time_s)"
            " says that its rows are not: close the loop with a global shutter"
        )
