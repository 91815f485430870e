"""Estimators in a session: within its loop on virtual time, in processes beside it in real time.

In real time nothing may delay the recording. Each estimator runs in a process of its own and gets
exposures from a bounded queue (`aolink.session.waiting.Waiting`); those that it has no time for it skips, each
estimator by itself. It predicts over skipped exposures with the inputs that the mirror applied, so
`aolink.estimation.Driver` gives the same bits if it skips the same exposures.
"""

from __future__ import annotations

import contextlib
import pickle
import socket
import subprocess
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

from aolink.errors import EstimatorError
from aolink.estimation import Driver, Estimate, exposure_model
from aolink.estimation.driver import SkippedInputs
from aolink.exposure import Exposure
from aolink.numerics.workers import beside
from aolink.polling import wait_readable
from aolink.recording import convert
from aolink.recording import schemas_pb2 as pb
from aolink.rig import Rig
from aolink.session import estimator_process
from aolink.session.estimator_process import LENGTH, NICENESS, READY, packed
from aolink.session.waiting import Waiting, most_waiting
from aolink.timeouts import TIMEOUTS

_READ_BYTES = 1 << 20
NO_TIME = "no time: the estimator was busy with earlier exposures"
_OVER = "no time: the session was over before its estimate was there"


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """The result of one estimator for one exposure: an estimate, or the reason why the exposure was skipped."""

    estimator: str
    exposure: Exposure
    message: pb.Estimate | None
    """The estimate as it is recorded; None if the exposure was skipped."""
    reason: str = ""
    """The reason why it was skipped."""
    took_ns: int = 0
    """How long the estimate took, ns; 0 on virtual time."""

    def account(self) -> pb.Estimation:
        """The message that is recorded besides the estimate."""
        return pb.Estimation(
            estimator=self.estimator, frame_id=self.exposure.frame_id, skipped=self.message is None,
            reason=self.reason, took_ns=self.took_ns,
        )  # fmt: skip

    def estimate(self, rig: Rig) -> Estimate:
        """The estimate as plain data. Only for an outcome that has one."""
        assert self.message is not None
        model = exposure_model(rig.plant, rig.window_steps)
        return convert.estimate_from_message(self.message, model, self.exposure)


class Estimating(Protocol):
    """Takes exposures in order and gives one outcome of each for each estimator, in any order of the estimators."""

    @property
    def names(self) -> Sequence[str]:
        """The estimators."""

    @property
    def failures(self) -> Mapping[str, str]:
        """Why an estimator has failed and skips all exposures from now on, by its name."""

    @property
    def hanging(self) -> Mapping[str, str]:
        """How long an estimator has not answered, in words, by its name, where that is too long."""

    def get_ready(self, stop: Callable[[], bool]) -> None:
        """Load, compile and compute in advance all that a session must not wait for, until done or ``stop()``.

        Raises EstimatorError if an estimator does not start.
        """

    def offer(self, exposure: Exposure) -> list[Outcome]:
        """Take the next exposure, without waiting; gives the outcomes that are known at once."""

    def outcomes(self) -> list[Outcome]:
        """The outcomes that have become known since the last call."""

    def finish(self, patience_s: float) -> list[Outcome]:
        """Wait up to ``patience_s`` for estimates under way and give up the rest; gives the outcomes of both."""


class InTheLoop:
    """Estimates each exposure when it is offered. It is for virtual time, which stands still meanwhile."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self.names = [estimator.name for estimator in driver.estimators]
        self.failures: dict[str, str] = {}
        self.hanging: dict[str, str] = {}

    def get_ready(self, stop: Callable[[], bool]) -> None:
        pass

    def offer(self, exposure: Exposure) -> list[Outcome]:
        made = self._driver.step(exposure) if self.names else ()
        return [Outcome(estimator=e.estimator, exposure=exposure, message=convert.estimate_message(e)) for e in made]

    def outcomes(self) -> list[Outcome]:
        return []

    def finish(self, patience_s: float) -> list[Outcome]:
        return []


class BesideTheLoop:
    """One process for each estimator. Processes start and get ready while the session is prepared.

    The estimator that ``controls`` has the loop's priority, because its estimates should be early.
    """

    def __init__(self, rig: Rig, names: Sequence[str], controls: str = "") -> None:
        self.names = names
        self.processes: list[EstimatorProcess] = []
        try:
            for name in names:
                self.processes.append(EstimatorProcess(rig, name, 0 if name == controls else NICENESS))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    @property
    def failures(self) -> dict[str, str]:
        return {each.name: each.failed for each in self.processes if each.failed}

    @property
    def hanging(self) -> dict[str, str]:
        return {each.name: each.hangs for each in self.processes if each.hangs}

    def get_ready(self, stop: Callable[[], bool]) -> None:
        while not stop() and not all(each.ready for each in self.processes):
            self.serve(TIMEOUTS.slice_s)
            for name, why in self.failures.items():
                raise EstimatorError(f"the estimator {name} does not start: {why}")

    def offer(self, exposure: Exposure) -> list[Outcome]:
        for each in self.processes:
            each.offer(exposure)
        return self.outcomes()

    def outcomes(self) -> list[Outcome]:
        return [outcome for each in self.processes for outcome in each.take_outcomes()]

    def finish(self, patience_s: float) -> list[Outcome]:
        deadline = time.monotonic() + patience_s
        while any(each.busy for each in self.processes) and (left_s := deadline - time.monotonic()) > 0:
            self.serve(min(left_s, TIMEOUTS.slice_s))
        for each in self.processes:
            each.give_up(_OVER)
        return self.outcomes()

    def close(self) -> None:
        """End the processes."""
        for each in self.processes:
            each.end()
        for each in self.processes:
            each.wait()

    def serve(self, timeout_s: float) -> None:
        """Wait up to ``timeout_s`` until data can be sent or received, and do so."""
        alive = [each for each in self.processes if each.alive]
        wait_readable(alive, timeout_s, [each for each in alive if each.has_to_send])
        for each in alive:
            each.serve()


class EstimatorProcess:
    """The process of one estimator, seen from the loop: nothing here waits for it."""

    def __init__(self, rig: Rig, name: str, niceness: int) -> None:
        self.name = name
        self.ready = False
        """Whether it has computed and loaded all that it needs."""
        self.failed = ""
        """The reason why it will estimate no more; empty while it works."""
        self._exposure: Exposure | None = None
        """The exposure that the process has."""
        self._served_s = self._busy_s = self._longest_s = 0.0
        """Time at which it was served last; how long it has had the exposure, without the time for which this process
        itself was held up; and the longest time that it took for one."""
        self._waiting = Waiting[Exposure](most_waiting(rig.timing))
        self._skipped = SkippedInputs()
        self._outcomes: list[Outcome] = []
        self._to_send: deque[memoryview] = deque()
        self._received = bytearray()
        self._connection, theirs = socket.socketpair()
        with theirs:
            self._process = beside(
                estimator_process.__name__, theirs.fileno(), niceness=niceness, pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            )  # fmt: skip
        self._connection.setblocking(False)
        self._send((rig, name))

    @property
    def alive(self) -> bool:
        return not self.failed

    @property
    def busy(self) -> bool:
        """Whether it has an exposure whose outcome is not known."""
        return self._exposure is not None

    @property
    def hangs(self) -> str:
        """How long it has not answered, in words; empty where that is not too long."""
        if self._exposure is None or self._busy_s < max(TIMEOUTS.hangs_s, TIMEOUTS.hangs_factor * self._longest_s):
            return ""
        return f"it has not answered for {self._busy_s:.0f} s, since it got frame {self._exposure.frame_id}"

    @property
    def has_to_send(self) -> bool:
        return bool(self._to_send)

    def fileno(self) -> int:
        return self._connection.fileno()

    def offer(self, exposure: Exposure) -> None:
        """Take the next exposure, for the process or as one to skip."""
        if self.failed:
            self._skip([exposure], self._why_failed())
            return
        self._skip(self._waiting.put(exposure), NO_TIME)
        self._go_on()

    def take_outcomes(self) -> list[Outcome]:
        """The outcomes that have become known; each is given once."""
        outcomes, self._outcomes = self._outcomes, []
        return outcomes

    def serve(self) -> None:
        """Send and receive as much as goes without waiting."""
        before_s, self._served_s = self._served_s, time.monotonic()
        self._busy_s += min(self._served_s - before_s, 2 * TIMEOUTS.slice_s)
        self._flush()
        ended = False
        try:
            while not ended:
                data = self._connection.recv(_READ_BYTES)
                self._received += data
                ended = not data
        except BlockingIOError:
            pass
        except OSError:
            ended = True
        while len(self._received) >= LENGTH.size and self.alive:
            (size,) = LENGTH.unpack_from(self._received)
            if len(self._received) < LENGTH.size + size:
                break
            message = pickle.loads(memoryview(self._received)[LENGTH.size : LENGTH.size + size])
            del self._received[: LENGTH.size + size]
            self._take(message)
        if ended and self.alive:
            self._fail(f"its process ended{_how(self._process)}")

    def give_up(self, reason: str) -> None:
        """Skip the exposure that the process has and those that wait; an estimator that hangs has failed."""
        if not self.failed and self.hangs:
            self.failed = self.hangs
            reason = self._why_failed()
        had = [] if self._exposure is None else [self._exposure]
        self._exposure = None
        self._skip([*had, *self._waiting.clear()], reason)

    def end(self) -> None:
        """End the process, whatever it is doing."""
        self._connection.close()
        self._process.kill()

    def wait(self) -> None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(TIMEOUTS.process_end_s)

    def _take(self, message: Any) -> None:
        if message is READY:
            self.ready = True
        elif isinstance(message, str):
            self._fail(message)
        elif self._exposure is not None:
            data, took_ns = message
            estimate, exposure = pb.Estimate.FromString(data), self._exposure
            self._longest_s = max(self._longest_s, took_ns / 1e9)
            self._outcomes.append(Outcome(estimator=self.name, exposure=exposure, message=estimate, took_ns=took_ns))
            self._exposure = None
        self._go_on()

    def _go_on(self) -> None:
        """Hand over the next exposure if the process has none."""
        if self.ready and not self.busy and (exposure := self._waiting.take()) is not None:
            self._exposure, self._busy_s = exposure, 0.0
            self._send(self._skipped.leading(exposure))

    def _send(self, message: object) -> None:
        self._to_send.append(memoryview(packed(message)))
        self._flush()

    def _flush(self) -> None:
        try:
            while self._to_send:
                sent = self._connection.send(self._to_send[0])
                self._to_send[0] = self._to_send[0][sent:]
                if not self._to_send[0]:
                    self._to_send.popleft()
        except BlockingIOError:
            pass
        except OSError:  # the process is gone; `serve` reads what it has sent until then, and the end
            self._to_send.clear()

    def _fail(self, why: str) -> None:
        self.failed = why
        self.give_up(self._why_failed())

    def _why_failed(self) -> str:
        return f"the estimator failed: {self.failed}"

    def _skip(self, exposures: Sequence[Exposure], reason: str) -> None:
        for exposure in exposures:
            self._skipped.skip(exposure)
            self._outcomes.append(Outcome(estimator=self.name, exposure=exposure, message=None, reason=reason))


def _how(process: subprocess.Popen[bytes]) -> str:
    with contextlib.suppress(subprocess.TimeoutExpired):
        code = process.wait(TIMEOUTS.reap_s)
        return f" by signal {-code}" if code < 0 else f" with exit code {code}"
    return ""
