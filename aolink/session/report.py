"""The report of a session: its counts, and the latency of each frame."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from aolink.control import Act, State
from aolink.recording import schemas_pb2 as pb
from aolink.recording.account import STEPS, Commands
from aolink.recording.topics import CONNECTION_FAULTS
from aolink.session.estimating import Outcome
from aolink.wire import messages_pb2 as wire

_KEPT_LATENCIES = 10_000
_MOST_OPEN = 1000
"""Most frames whose latency has not ended: a command that an older one waits for is not coming any more."""


@dataclass(kw_only=True)
class EstimatorReport:
    """Counts of one estimator in a session in real time."""

    estimated: int = 0
    skipped: int = 0
    """Exposures that the estimator had no time for, or that came after it had failed."""
    failed: str = ""
    """The reason of its failure; empty where it did not fail."""
    unmeasured: int = 0
    """Exposures in which it could measure nothing."""
    took_ms: list[float] = field(default_factory=list)
    """Durations of its estimates, one after the other; the newest ones, `_KEPT_LATENCIES` at most."""

    def add(self, outcome: Outcome) -> None:
        """Count the outcome of the next exposure."""
        if outcome.message is None:
            self.skipped += 1
            return
        self.estimated += 1
        self.unmeasured += outcome.message.status == pb.Estimate.INPUT_INVALID
        self.took_ms.append(outcome.took_ns / 1e6)
        del self.took_ms[:-_KEPT_LATENCIES]


@dataclass(kw_only=True)
class ControlReport:
    """Counts of the closed loop of a session."""

    controller: str
    estimator: str
    """The estimator that serves the controller; empty for none."""
    exposures: int = 0
    """Exposures that it has taken."""
    open_exposures: int = 0
    """Exposures with which the loop was open: the mirror held its input, or went to the safe one."""
    late_exposures: int = 0
    """Exposures that changed the inputs later than the rig file's ``control.delay_s``."""
    fall_back_exposures: int = 0
    """Exposures after which another controller acted, because this one left larger slopes."""
    clipped_steps: int = 0
    """Fast steps whose wanted input the limits have changed."""
    slope_rms: float = float("nan")
    """Root mean square of the centroids over all exposures, slope units."""
    delay_ms: list[float] = field(default_factory=list)
    """From the end of each exposure to the first step that it changed; the newest ones, `_KEPT_LATENCIES` at most."""
    note: str = ""
    """The loop's state at the newest exposure, in a few words, for a screen."""
    _squares: tuple[float, int] = (0.0, 0)

    def add(self, act: Act, fast_step_s: float) -> None:
        """Count an exposure."""
        self.exposures += 1
        self.open_exposures += act.state is not State.CLOSED
        self.late_exposures += act.late
        self.fall_back_exposures += act.acting != self.controller
        self.clipped_steps += act.clipped_steps
        if not math.isnan(act.slope_rms):
            total, count = self._squares
            self._squares = total + act.slope_rms**2, count + 1
            self.slope_rms = math.sqrt(self._squares[0] / self._squares[1])
        self.delay_ms.append(1e3 * act.delay_steps * fast_step_s)
        del self.delay_ms[:-_KEPT_LATENCIES]
        state = "" if act.state is State.CLOSED else f", loop {act.state.name.lower()}"
        self.note = f"slopes {act.slope_rms:.3g} rms, delay {self.delay_ms[-1]:.3g} ms{state}"
        if act.acting != self.controller:
            self.note += f", fallen back to {act.acting}"

    def counts(self) -> dict[str, Any]:
        """All counts, with the median and the longest of the delays."""
        names = (
            "exposures", "open_exposures", "late_exposures", "fall_back_exposures", "clipped_steps",
            "slope_rms",
        )  # fmt: skip
        delays = sorted(self.delay_ms)
        delay = {"delay_ms": delays[len(delays) // 2], "longest_delay_ms": delays[-1]} if delays else {}
        return {name: getattr(self, name) for name in names} | delay


@dataclass(kw_only=True)
class Report:
    """Counts of a session, and its latencies if it ran in real time."""

    ended: str = "running"
    """``complete``, ``interrupted``, or ``error:`` and its message."""
    virtual_time: bool = False
    exposures: int = 0
    frames_received: int = 0
    frames_incomplete: int = 0
    """Frames received with chunks missing; their pixels are masked."""
    frames_lost: int = 0
    """Frames never received at all."""
    scenes_received: int = 0
    """The counts of complete, incomplete and lost frames for the picture sensor."""
    scenes_incomplete: int = 0
    scenes_lost: int = 0
    connection_faults: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CONNECTION_FAULTS, 0))
    """What went wrong on the connections to the devices, by the names of `CONNECTION_FAULTS`; both devices together."""
    chunks_refused: int = 0
    """Invalid chunks of frames."""
    commands: Commands = field(default_factory=Commands)
    """How the commands ended; complete once the session has ended."""
    steps_parked: int = 0
    """Fast steps of the session in which the mirror held its safe input, however the commands for them ended."""
    blocks_retransmitted: int = 0
    reports_asked: int = 0
    """How often missing reports of the mirror were requested again."""
    rearmed: int = 0
    """How often the mirror was parked by its watchdog and re-armed."""
    ports_vanished: int = 0
    """How often the port of a device vanished and the session waited for it."""
    away_s: float = 0.0
    """How long ports were gone until their devices had returned, all together, s."""
    clock_offset_ns: float = float("nan")
    clock_frequency_ppm: float = float("nan")
    clock_sigma_ns: float = float("nan")
    estimation: dict[str, EstimatorReport] = field(default_factory=dict)
    """Counts of each estimator, by its name. Empty on virtual time, which waits for every estimate."""
    control: ControlReport | None = None
    """Counts of the closed loop; None where the session played its inputs."""
    warnings: list[str] = field(default_factory=list)
    files: list[str] = field(default_factory=list)
    """Files that were written."""
    latencies: list[pb.Latency] = field(default_factory=list)
    """The newest latencies, `_KEPT_LATENCIES` at most; all of them are in the recording."""

    @property
    def exposures_skipped(self) -> dict[str, int]:
        """How many exposures were skipped, by the names of the estimators that skipped any."""
        return {name: each.skipped for name, each in self.estimation.items() if each.skipped}

    def state(self) -> dict[str, Any]:
        """How the session stands, for a screen or a program that looks while it runs: counts of exposures and of what
        was lost, came late or was skipped, the newest latency, the acting controller. What there is none of is left
        out."""
        newest = self.latencies[-1] if self.latencies else None
        known = {
            "frames_lost": self.frames_lost,
            "frames_incomplete": self.frames_incomplete, "steps_late": self.commands.late,
            "skipped": self.exposures_skipped,
            "latency_ms": newest and {
                name.removesuffix("_ns"): (at - newest.exposure_end_ns) / 1e6
                for name in ("complete_ns", "estimated_ns", "command_sent_ns") if (at := getattr(newest, name))
            },
            "loop": self.control and self.control.note, "warnings": len(self.warnings),
        }  # fmt: skip
        return {"exposures": self.exposures} | {name: value for name, value in known.items() if value}

    def note(self) -> str:
        """The same in a few words, for a progress bar."""
        state = self.state()
        words = {"frames_lost": "lost", "frames_incomplete": "incomplete", "steps_late": "steps late"}
        notes = [f"{state[name]} {word}" for name, word in words.items() if name in state]
        if skipped := ", ".join(f"{name} {count}" for name, count in self.exposures_skipped.items()):
            notes.append(f"skipped: {skipped}")
        if "estimated" in (after_ms := state.get("latency_ms", {})):
            notes.append(f"estimated after {after_ms['estimated']:.0f} ms")
        return "; ".join([*notes, *([state["loop"]] if "loop" in state else [])])

    def counts(self) -> dict[str, str]:
        """All counts without the latencies, as text, for the recording's metadata."""
        facts: dict[str, Any] = {}
        for name, value in asdict(replace(self, control=None)).items():
            if name == "commands":
                facts |= {f"steps_{end}": value[end] for end in STEPS}
            elif name not in ("latencies", "warnings", "files", "estimation", "control"):
                facts[name] = value
        facts |= {f"connection_{name}": count for name, count in facts.pop("connection_faults").items()}
        for name, each in self.estimation.items():
            facts[f"skipped_{name}"] = each.skipped
            if each.took_ms:
                facts[f"estimate_ms_{name}"] = round(statistics.median(each.took_ms), 3)
        if self.control is not None:
            facts |= {f"control_{name}": value for name, value in self.control.counts().items()}
        return {name: str(value) for name, value in facts.items()} | {"warnings": "; ".join(self.warnings)}


class LatencyBook:
    """The latency of each frame, from the end of its exposure to the first command that could depend on it, or to its
    first estimate where nothing is ``commanded``. It is for real time only.

    A command can depend on a frame when it is sent after the first estimate of the frame was there, or all estimators
    had skipped it. (`EstimatorReport` has the time of each estimator.)
    """

    def __init__(self, report: Report, record: Callable[[int, pb.Latency], None], *, commanded: bool) -> None:
        self._report, self._record, self._commanded = report, record, commanded
        self._open: dict[int, pb.Latency] = {}
        self._blocks: dict[int, int] = {}
        """First command block that could depend on a frame, by frame."""
        self._known: set[int] = set()
        """Frames that the next command can depend on."""

    def frame(self, latency: pb.Latency) -> None:
        """Note that a frame is complete."""
        self._open[latency.frame_id] = latency
        if len(self._open) > _MOST_OPEN:
            self._close(next(iter(self._open)), latency.complete_ns)

    def estimated(self, frame_id: int, estimated_ns: int, now_ns: int) -> None:
        """Note that the first estimate of a frame is there; ``estimated_ns`` is 0 if all estimators have skipped it."""
        if latency := self._open.get(frame_id):
            latency.estimated_ns = estimated_ns
            if self._commanded:
                self._known.add(frame_id)
            else:
                self._close(frame_id, now_ns)

    def sent(self, block: wire.CommandBlock, now_ns: int) -> None:
        for frame_id in self._known:
            self._open[frame_id].command_sent_ns = now_ns
            self._blocks[frame_id] = block.block_id
        self._known.clear()

    def acknowledged(self, block_id: int, receive_ns: int) -> None:
        for frame_id, block in self._blocks.items():
            if block == block_id:
                self._open[frame_id].command_acknowledged_ns = receive_ns

    def applied(self, block_id: int, applied_ns: int, receive_ns: int) -> None:
        """Note that the device reports the first steps of a block, which ends the latency of its frames."""
        for frame_id in [frame_id for frame_id, block in self._blocks.items() if block == block_id]:
            self._open[frame_id].command_applied_ns = applied_ns
            self._close(frame_id, receive_ns)

    def close(self, now_ns: int) -> None:
        """Record the frames that no command followed."""
        for frame_id in list(self._open):
            self._close(frame_id, now_ns)

    def _close(self, frame_id: int, now_ns: int) -> None:
        latency = self._open.pop(frame_id)
        self._blocks.pop(frame_id, None)
        self._known.discard(frame_id)
        self._record(now_ns, latency)
        self._report.latencies.append(latency)
        del self._report.latencies[:-_KEPT_LATENCIES]
