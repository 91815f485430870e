"""The simulated camera and mirror driver: they take messages from the host and give messages to the host.

They are state only, with no ports and no time of their own. `aolink.simulation.server` puts it behind ports. It is the
device's side of protocol version 1; the host's code never imports it and meets it on the wire only.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from aolink.rig import Rig
from aolink.simulation.model import CameraFrame, RigPhysics
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import MAX_CHUNK, PROTOCOL_VERSION, schema_hash
from aolink.wire.truth import truth_message

LineName = Literal["camera", "mirror"]
FIRMWARE = "aolink simulated rig 1"
_REMEMBERED_BLOCKS = 256
_PACKET_INPUTS = 512  # numbers in an `Applied` of one packet
_HISTORY_WATCHDOGS = 4  # an outage of two is survived; the inputs held during it are requested when it is over
_HISTORY_INPUTS = 1 << 20  # the most numbers that are remembered, beside one queue


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A message for the host, and the fast step at whose end it leaves (None: at once)."""

    line: LineName
    message: Message
    after_step: int | None = None


class _Held(NamedTuple):
    """The input that the mirror held in one fast step."""

    block_id: int
    source: pb.Applied.Source
    u: NDArray[np.float64]
    """(n_inputs,)"""


class SimulatedDevices:
    """Camera and mirror driver that share one plant and one count of fast steps."""

    def __init__(self, rig: Rig, seed: int | None = None, *, virtual_time: bool, step_zero_ns: int) -> None:
        self.rig = rig
        self.outbox: list[Outgoing] = []
        self._model = RigPhysics(rig, seed)
        self._virtual_time = virtual_time
        self._step_zero_ns = step_zero_ns
        self._serial_number = f"{rig.digest[:8]}-{rig.simulation.seed if seed is None else seed}"
        self._queue: dict[int, tuple[int, NDArray[np.float64]]] = {}
        self._acks: OrderedDict[int, pb.CommandAck] = OrderedDict()
        self._history: deque[_Held] = deque(maxlen=history_steps(rig))
        self._reporting = False
        self._camera_start: int | None = None
        self.parked = True
        """Whether the mirror holds its safe input."""
        self.armed = False
        """Whether the watchdog runs: a block was taken, and nothing has parked the mirror for good since."""
        self.latched = False
        """Whether the watchdog has parked the mirror and no Rearm has come since."""
        self.clock_set_ns = 0
        """How far the clock of the device's stamps has been set forward, ns."""

    @property
    def step(self) -> int:
        """The next fast step."""
        return self._model.step

    @property
    def queue_end(self) -> int:
        """The first fast step for which nothing is queued."""
        return max(self._queue, default=self.step - 1) + 1

    @property
    def ready_end(self) -> int:
        """The first fast step without a command: how far virtual time may run."""
        end = self.step
        while end in self._queue:
            end += 1
        return end

    def device_ns(self, step: int) -> int:
        """Device time at which a fast step begins, on the clock as it was at the start."""
        return self._step_zero_ns + step * self.rig.timing.fast_step_ns

    def _stamp_ns(self, step: int) -> int:
        """Device time at which a fast step begins, on the clock as it is now, which the device reports."""
        return self.device_ns(step) + self.clock_set_ns

    def next_report_step(self) -> int:
        """The step before which the next report is due: the end of a block or of an exposure.

        Without either, one report length ahead.
        """
        block_id = self._queue.get(self.step, (0, None))[0]
        end = self.step + 1
        while end < self.step + self.rig.mirror.block_steps and self._queue.get(end, (0, None))[0] == block_id:
            end += 1
        if self._camera_start is not None:
            timing, long = self.rig.timing, self.rig.timing.exposure_steps + self.rig.readout_steps
            # First exposure that ends after this step.
            number = max(0, (self.step - self._camera_start - long) // timing.frame_period_steps + 1)
            frame_end = self._camera_start + number * timing.frame_period_steps + long
            end = min(end, frame_end) if frame_end > self.step else end
        return end

    def handle(self, line: LineName, message: Message, sequence: int) -> None:
        """Act on a message from the host; the answers are in the outbox."""
        if isinstance(message, pb.Identify):
            self._begin_session(line, message.nonce)
        elif isinstance(message, pb.CommandBlock) and line == "mirror":
            ack = pb.CommandAck()
            ack.CopyFrom(self._take_block(message))
            ack.sequence = sequence
            self._say(line, ack)
        elif isinstance(message, pb.AppliedQuery) and line == "mirror":
            self._answer_query(message)
        elif isinstance(message, pb.Park) and line == "mirror":
            self._park()
            self._say(line, pb.Ack(sequence=sequence, step=self.step))
        elif isinstance(message, pb.Rearm) and line == "mirror":
            self.latched = False
            self._say(line, pb.Ack(sequence=sequence, step=self.step))
        elif isinstance(message, pb.CameraControl) and line == "camera":
            self._say(line, self._control_camera(message, sequence))
        else:
            name = type(message).__name__
            self._say(line, pb.Ack(sequence=sequence, code=pb.NOT_SUPPORTED, text=f"a {line} does not take {name}"))

    def _begin_session(self, line: LineName, nonce: int) -> None:
        """Drop the state that an earlier host left behind."""
        self.outbox = [o for o in self.outbox if o.line != line]
        identity = self._identity(line, nonce)
        if line == "mirror":
            self._park()
            self._acks.clear()
            identity.next_step = self.queue_end
        else:
            self._model.stop_camera()
            self._camera_start = None
        self._say(line, identity)

    def _park(self) -> None:
        """Park on request: put the mirror into its safe state, empty the queue, report no more."""
        self._queue.clear()
        self.parked, self.armed, self._reporting = True, False, False

    def watchdog_expires(self) -> None:
        """Park the mirror until a Rearm comes, because no valid packet has come on its line for the watchdog's time."""
        if not self.armed:
            return
        self._queue.clear()
        self.parked, self.armed, self.latched = True, False, True
        self._warn(f"mirror parked by its watchdog: no valid packet for {self.rig.mirror.watchdog_s:g} s")

    def _warn(self, text: str) -> None:
        self._say("mirror", pb.Event(level=pb.Event.WARNING, device_ns=self._stamp_ns(self.step), text=text))

    def advance_to(self, step: int) -> None:
        """Let the plant run until ``step`` is the next one; reports and frames are in the outbox."""
        first = self.step
        if step <= first:
            return
        park = self.rig.mirror.park
        nothing = pb.Applied.WATCHDOG if self.latched else pb.Applied.PARKED
        held, rows = [], np.empty((step - first, self.rig.n_inputs))
        for k in range(first, step):
            block_id, rows[k - first] = self._queue.pop(k, (0, park))
            held.append(_Held(block_id, pb.Applied.COMMAND if block_id else nothing, rows[k - first]))
            if not block_id and not self.parked:
                self._warn("mirror parked: its queue ran empty")
            self.parked = not block_id
        self._history.extend(held)
        frames = self._model.advance(rows)
        if self._reporting:
            for run in self._runs(first, held, self.rig.mirror.block_steps):
                self._say("mirror", run, run.first_step + run.n_steps - 1)
        for frame in frames:
            self._send_frame(frame)
        self.outbox.sort(key=lambda o: -1 if o.after_step is None else o.after_step)

    def _say(self, line: LineName, message: Message, after_step: int | None = None) -> None:
        self.outbox.append(Outgoing(line, message, after_step))

    def _identity(self, line: LineName, nonce: int) -> pb.Identity:
        rig = self.rig
        identity = pb.Identity(
            nonce=nonce, model=rig.name, serial_number=self._serial_number, firmware=FIRMWARE,
            protocol_version=PROTOCOL_VERSION, schema_hash=schema_hash(), fast_step_ns=rig.timing.fast_step_ns,
            next_step=self.queue_end, step_zero_ns=self._stamp_ns(0), virtual_time=self._virtual_time,
            rig_digest=rig.digest,
        )  # fmt: skip
        if line == "camera":
            identity.kind = pb.Identity.CAMERA
            height, width = rig.sensor.shape
            camera = pb.CameraGeometry(
                width=width, height=height, bit_depth=rig.sensor.bit_depth,
                exposure_steps=rig.timing.exposure_steps, frame_period_steps=rig.timing.frame_period_steps,
            )  # fmt: skip
            identity.camera.CopyFrom(camera)
            if rig.scene is not None:
                identity.camera.scene_height, identity.camera.scene_width = rig.scene.shape
                identity.camera.scene_bit_depth = rig.scene.bit_depth
        else:
            identity.kind = pb.Identity.MIRROR
            mirror = rig.mirror
            limits = pb.MirrorLimits(
                n_inputs=rig.n_inputs, input_min=mirror.input_min, input_max=mirror.input_max, park=mirror.park,
                dac_bits=mirror.dac_bits, queue_steps=mirror.queue_steps, watchdog_s=mirror.watchdog_s,
                parked=self.parked, latched=self.latched, history_steps=history_steps(rig),
            )  # fmt: skip
            identity.mirror.CopyFrom(limits)
        return identity

    def _take_block(self, block: pb.CommandBlock) -> pb.CommandAck:
        if block.block_id in self._acks:  # a retransmission: the first answer was lost
            return self._acks[block.block_id]
        ack = self._check_block(block)
        if ack.code == pb.QUEUE_FULL:  # may be sent again, so it is not remembered
            return ack
        self._acks[block.block_id] = ack
        if len(self._acks) > _REMEMBERED_BLOCKS:
            self._acks.popitem(last=False)
        return ack

    def _check_block(self, block: pb.CommandBlock) -> pb.CommandAck:
        ack = pb.CommandAck(block_id=block.block_id, queue_end_step=self.queue_end)
        mirror, n_inputs = self.rig.mirror, self.rig.n_inputs
        end = block.first_step + block.n_steps
        if not block.block_id or not block.n_steps or len(block.u) != block.n_steps * n_inputs:
            ack.code = pb.WRONG_SHAPE
            ack.text = f"{len(block.u)} numbers for {block.n_steps} steps of {n_inputs} inputs"
            return ack
        u = np.array(block.u).reshape(block.n_steps, n_inputs)
        if not ((u >= mirror.input_min) & (u <= mirror.input_max)).all():  # NaN fails as well
            ack.code = pb.OUT_OF_RANGE
            ack.text = "an input is beyond the limits"
        elif self.latched:
            ack.code = pb.LATCHED
            ack.text = "the watchdog has parked the mirror"
        elif end > self.step + mirror.queue_steps:
            ack.code = pb.QUEUE_FULL
            ack.text = f"the queue holds {mirror.queue_steps} steps"
        elif end <= self.step:
            ack.code = pb.TOO_LATE
            ack.late_steps = block.n_steps
        if ack.code != pb.OK:
            return ack
        applied = mirror.quantise(u)
        for k in range(block.first_step, end):
            if k < self.step:
                ack.late_steps += 1
            else:
                ack.superseded_steps += k in self._queue
                self._queue[k] = (block.block_id, applied[k - block.first_step])
        ack.queue_end_step = self.queue_end
        self._reporting = self.armed = True
        return ack

    def _control_camera(self, control: pb.CameraControl, sequence: int) -> pb.Ack:
        if not control.run:
            self._model.stop_camera()
            self._camera_start = None
        elif control.first_step == self._camera_start:
            pass  # the request came again: the answer was lost
        elif control.first_step < self.step:
            text = f"fast step {control.first_step} has gone by, the next is {self.step}"
            return pb.Ack(sequence=sequence, code=pb.TOO_LATE, text=text)
        else:
            self._model.start_camera(control.first_step, control.exposures)
            self._camera_start = control.first_step
        return pb.Ack(sequence=sequence)

    def _answer_query(self, query: pb.AppliedQuery) -> None:
        """Report the inputs that the mirror held from a step on, as many as one report holds."""
        first, oldest = query.first_step, self.step - len(self._history)
        end = min(first + query.n_steps, self.step)
        if first < min(oldest, end):
            n_steps = min(end, oldest) - first
            self._say("mirror", pb.Applied(first_step=first, n_steps=n_steps, source=pb.Applied.NOT_REPORTED))
            first += n_steps
        if first < end:
            most = max(1, _PACKET_INPUTS // self.rig.n_inputs)
            held = [self._history[k - oldest] for k in range(first, min(end, first + most))]
            self._say("mirror", self._runs(first, held, most)[0])

    def _runs(self, first: int, held: Sequence[_Held], most: int) -> list[pb.Applied]:
        """Reports of the steps from ``first`` on, one for each run of one block and source, ``most`` steps or fewer."""
        runs = []
        start = 0
        for k in range(1, len(held) + 1):
            if k < len(held) and held[k][:2] == held[start][:2] and k - start < most:
                continue
            run = pb.Applied(
                block_id=held[start].block_id, first_step=first + start, n_steps=k - start,
                u=np.concatenate([each.u for each in held[start:k]]), source=held[start].source,
                device_ns=self._stamp_ns(first + k),
            )  # fmt: skip
            runs.append(run)
            start = k
        return runs

    def _send_frame(self, frame: CameraFrame) -> None:
        """Send the spots' picture, the truth, and last the scene's picture, because the estimators do not wait for
        that."""
        read_out = frame.first_step + frame.n_steps - 1 + self.rig.readout_steps
        self._send_picture(frame, frame.pixels, plane=0)
        data = truth_message(frame.frame_id, frame.truth).SerializeToString()
        for offset, piece in _chunks(data):
            truth = pb.TruthChunk(frame_id=frame.frame_id, offset=offset, total=len(data), data=piece)
            self._say("camera", truth, read_out)
        if frame.scene is not None:
            self._send_picture(frame, frame.scene, plane=1)

    def _send_picture(self, frame: CameraFrame, pixels: NDArray[np.uint16], plane: int) -> None:
        height, width = pixels.shape
        last_step = frame.first_step + frame.n_steps - 1
        late_ns = self.rig.timing.exposure_offset_ns
        data = pixels.astype("<u2").tobytes()
        for offset, piece in _chunks(data):
            picture = pb.FrameChunk(
                frame_id=frame.frame_id, offset=offset, total=len(data), width=width, height=height,
                first_step=frame.first_step, last_step=last_step,
                exposure_start_ns=self._stamp_ns(frame.first_step) + late_ns,
                exposure_end_ns=self._stamp_ns(last_step + 1) + late_ns,
                exposure_offset_ns=late_ns, data=piece, plane=plane,
            )  # fmt: skip
            self._say("camera", picture, last_step + self.rig.readout_steps)


def _chunks(data: bytes) -> list[tuple[int, bytes]]:
    return [(offset, data[offset : offset + MAX_CHUNK]) for offset in range(0, len(data), MAX_CHUNK)]


def history_steps(rig: Rig) -> int:
    """Number of fast steps for which a simulated mirror remembers its inputs."""
    watchdogs = math.ceil(_HISTORY_WATCHDOGS * rig.mirror.watchdog_s / rig.timing.fast_step_s)
    return max(rig.mirror.queue_steps, min(watchdogs, _HISTORY_INPUTS // rig.n_inputs))
