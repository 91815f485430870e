"""What interrupts a session and does not end it: a port that vanishes, a process that is held up, a mirror that its
watchdog has parked."""

from __future__ import annotations

from foxglove_schemas_protobuf.Log_pb2 import Log

from aolink.devices.interfaces import Camera, Device, Mirror, Returned, Time, Vanished
from aolink.errors import PortError
from aolink.rig import Rig
from aolink.session.commanding import Commanding
from aolink.session.journal import Journal
from aolink.session.received import Received
from aolink.session.schedule import Schedule
from aolink.timeouts import TIMEOUTS


class Interruptions:
    """Says what has interrupted a session, and goes on with it."""

    def __init__(
        self, rig: Rig, time: Time, camera: Camera, mirror: Mirror, journal: Journal, schedule: Schedule,
        commanding: Commanding, received: Received,
    ) -> None:  # fmt: skip
        self._rig, self._time, self._camera, self._mirror = rig, time, camera, mirror
        self._journal, self._schedule, self._commanding, self._received = journal, schedule, commanding, received
        received.handlers |= {Vanished: self._vanished, Returned: self._has_returned}
        self.absent: list[Device] = []
        """Devices whose port has vanished, until the session goes on with them."""
        self._returned: list[Device] = []
        """Vanished devices that have been identified again; their clocks are being queried."""
        self._turn_ns = self._held_up_until_ns = 0
        """Host times: when this turn of the loop began, and when this process went on after it last did not run."""
        self._catching_up = False
        """Whether nothing is commanded, until the mirror's clock says in which fast step it is after a hold-up."""

    def may_command(self) -> bool:
        """Go on with what is there again; gives whether the mirror can be commanded."""
        for device in [each for each in self._returned if not each.clock.suspected]:
            self._go_on_with(device)
        if self._catching_up and not (self._mirror.clock.suspected and self.was_held_up()):
            self._catching_up = False
            self._commanding.catch_up()
        if self._mirror.latched and self._mirror not in self.absent:
            self.rearm("in this session")
        return not self._catching_up and self._mirror not in self.absent

    def begin_turn(self) -> None:
        """Note that a turn of the loop begins: where the one before took so long that this process cannot have run,
        that is said."""
        now = self._time.now_ns()
        turn_ns, self._turn_ns = now - self._turn_ns, now
        if self._time.virtual or turn_ns < TIMEOUTS.held_up_s * 1e9:
            return
        self._held_up_until_ns = now
        self._received.newest_frame_ns += turn_ns
        self._journal.warn(
            f"the session was held up for {turn_ns / 1e9:.1f} s after {self._journal.report.exposures} exposure(s):"
            " its process was stopped, or the computer slept or was too busy; what came meanwhile may be lost"
        )
        if self._mirror.commanded:
            self._catching_up = True
            self._mirror.clock.suspect(self._rig.timing.fast_step_ns, now)

    def was_held_up(self) -> bool:
        """Whether that is so short a time ago that what has come meanwhile may not have been read."""
        return self._time.now_ns() - self._held_up_until_ns < TIMEOUTS.grace_s * 1e9

    def waited(self) -> None:
        """Note that until now a device was waited for."""
        self._turn_ns = self._time.now_ns()

    def rearm(self, when: str) -> None:
        """Re-arm a mirror that its watchdog has parked; one that answers nothing for too long has ended the session."""
        outage_s, step = self._mirror.outage_s, self._mirror.rearm()
        self._journal.report.rearmed += 1
        out = f", {outage_s:.2f} s after its last command" if outage_s else ""
        parked = f"the mirror was parked by its watchdog {when}"
        self._journal.log(f"{parked}: re-armed at fast step {step}{out}", Log.WARNING)
        self._commanding.go_back_to(step)  # the queued inputs are dropped
        self.waited()

    def _vanished(self, device: Device, event: Vanished, receive_ns: int) -> None:
        if device not in self.absent:
            self.absent.append(device)
        if device in self._returned:
            self._returned.remove(device)
        self._journal.report.ports_vanished += 1
        said = f"the port of the {device.name} has vanished; the session waits for it: {event.why}"
        self._journal.log(said, Log.WARNING)

    def _has_returned(self, device: Device, event: Returned, receive_ns: int) -> None:
        self._returned.append(device)
        self._journal.report.away_s += event.away_s
        said = f"the {device.name} has returned {event.away_s:.2f} s after its port had vanished"
        self._journal.log(said, Log.WARNING)

    def _go_on_with(self, device: Device) -> None:
        """Go on with a device that has returned: it takes no frames, or is parked, since it was opened again."""
        self._returned.remove(device)
        self.absent.remove(device)
        try:
            if device is self._camera:
                if (step := self._schedule.go_on(self._commanding.device_step)) is not None:
                    self._journal.log(f"the camera goes on with the exposure from fast step {step}")
                self._received.camera_restarted()
                self._received.newest_frame_ns = self._time.now_ns()
                self.waited()
            else:
                if self._mirror.latched:
                    self.rearm("while its port was gone")
                step = self._commanding.go_on()
                self._journal.log(f"commands to the mirror go on from fast step {step}")
        except PortError:
            self.absent.append(device)  # it has vanished again, and the session waits for it as before
