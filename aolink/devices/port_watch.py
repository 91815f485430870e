"""The port of a native device, which may vanish and return: it is opened again, and the device is asked for its
identity."""

from __future__ import annotations

from collections.abc import Callable

from aolink.devices.gate import MOST_RATE_ERROR
from aolink.devices.identity import check_identity, new_nonce
from aolink.devices.interfaces import Returned, Vanished
from aolink.errors import DeviceError, PortError
from aolink.timeouts import TIMEOUTS
from aolink.wire import messages_pb2 as pb
from aolink.wire.link import Link
from aolink.wire.port import Reopening, Transport

_STEPS_OFF_S = 0.25
"""The most by which a device's count of fast steps may differ from the prediction by its clock, s; a restart makes the
count begin anew."""


class PortWatch:
    """Notices that a port has vanished, opens it again, and asks the device for its identity, without ever waiting.

    Without `allow` a port that vanishes is an error, as `aolink.wire.link.Link.lose` raises it.
    """

    def __init__(self, link: Link, identity: pb.Identity) -> None:
        self.away = False
        """Whether the port has vanished and the device has not been identified again."""
        self._link, self._identity = link, identity
        self._within_s = 0.0
        self._since_ns = 0
        self._why = ""
        self._reopening: Reopening | None = None
        self._nonce = 0
        self._asked_ns: int | None = None
        self._unanswered_ns: int | None = None
        """Host time of the first query that the device has left unanswered."""

    def allow(self, reopen: Callable[[], Transport], within_s: float) -> None:
        """Wait from now on for a port that vanishes, for up to ``within_s`` seconds."""
        self._link.reopen, self._within_s = reopen, within_s

    def poll(self, now_ns: int) -> list[Vanished]:
        """Do what is due; reports once that the port has vanished. Raises PortError where it has not returned in
        time."""
        link = self._link
        if link.reopen is None:
            return []
        if self.away or link.last_heard_ns > link.last_sent_ns:
            self._unanswered_ns = None
        elif self._unanswered_ns is None:
            self._unanswered_ns = now_ns
        elif (silent_s := (now_ns - self._unanswered_ns) / 1e9) > TIMEOUTS.silent_s:
            link.lose(PortError(f"the {link.name} has said nothing for {silent_s:.1f} s, though it was asked"))
        events = []
        if link.lost is not None and self._reopening is None:
            if not self.away:
                self.away, self._since_ns, self._why = True, now_ns, str(link.lost)
                events.append(Vanished(self._why))
            self._reopening = Reopening(link.reopen)
        if self.away:
            self._look_for_it(now_ns)
        return events

    def _look_for_it(self, now_ns: int) -> None:
        link, reopening = self._link, self._reopening
        if reopening is not None and reopening.opened is not None:
            link.found(reopening.opened)
            self._reopening, self._asked_ns = None, None
        if (now_ns - self._since_ns) / 1e9 > self._within_s:
            silent = f"nothing answers on the {link.name}'s port"
            last = silent if reopening is None else reopening.failed or "it cannot be opened yet"
            raise PortError(f"{self._why}; it did not return within {self._within_s:g} s: {last}")
        if link.lost is None and (self._asked_ns is None or now_ns - self._asked_ns > TIMEOUTS.answer_s * 1e9):
            self._asked_ns, self._nonce = now_ns, new_nonce()
            link.send(pb.Identify(nonce=self._nonce))

    def take(self, identity: pb.Identity, now_step: int, now_ns: int) -> Returned | None:
        """Compare the device that answers with the one that was there; None for an answer that was not asked for.

        ``now_step`` is the fast step that the device must be in by its clock. Raises DeviceError for another device,
        and for one that was restarted: its fast steps are not those of the session any more.
        """
        if self._asked_ns is None or identity.nonce != self._nonce:
            return None
        check_identity(self._link, identity)
        before, found = _lasting(self._identity), _lasting(identity)
        for field in before.DESCRIPTOR.fields:
            if (was := getattr(before, field.name)) != (now := getattr(found, field.name)):
                raise DeviceError(
                    f"another device has returned on the {self._link.name}'s port: its {field.name} is"
                    f" {_shown(now)}, and was {_shown(was)}; connect the device of this session again, or begin another"
                )
        away_s = (now_ns - self._since_ns) / 1e9
        slack = round((_STEPS_OFF_S + MOST_RATE_ERROR * away_s) * 1e9) // identity.fast_step_ns
        if identity.next_step < now_step - slack:
            raise DeviceError(
                f"the {self._link.name} has returned at fast step {identity.next_step}, expected {now_step} or so:"
                " it was restarted, and counts its steps anew; begin a new session"
            )
        self.away = False
        return Returned(away_s)

    def give_up(self) -> None:
        """Stop trying to open the port."""
        if self._reopening is not None:
            self._reopening.give_up()


def _lasting(identity: pb.Identity) -> pb.Identity:
    """The fields of an identity that stay the same for as long as a device runs."""
    lasting = pb.Identity()
    lasting.CopyFrom(identity)
    for name in ("nonce", "next_step", "step_zero_ns"):
        lasting.ClearField(name)
    for name in ("parked", "latched"):
        lasting.mirror.ClearField(name)
    return lasting


def _shown(value: object) -> str:
    return " ".join(str(value).split()) or "empty"
