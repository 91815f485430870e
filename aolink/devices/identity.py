"""The identity that devices of the packet protocol report, and its comparison with the rig file."""

from __future__ import annotations

import secrets

from aolink.devices.gate import MOST_STEP, check_times, require, within
from aolink.errors import DeviceError, PortError
from aolink.rig import Rig
from aolink.wire import messages_pb2 as pb
from aolink.wire.hub import Hub
from aolink.wire.link import Link
from aolink.wire.packet import PROTOCOL_VERSION, schema_hash

_LONGEST_NAME = 200


def new_nonce() -> int:
    """A number that distinguishes the answer to one `identify` from the answers to others.

    It always has 48 bits: a shorter one makes shorter packets, and two sessions on virtual time would differ.
    """
    return secrets.randbits(47) | 1 << 47


def identify(hub: Hub, link: Link, nonce: int) -> pb.Identity:
    """Ask the device on a serial line for its identity.

    Raises
    ------
    DeviceError
        The device does not answer, or speaks another version of the protocol.
    """
    identity = None
    try:
        identity = hub.request(link, pb.Identify(nonce=nonce), pb.Identity, lambda answer, _: answer.nonce == nonce)
    except PortError:
        if link.foreign_version is None:  # the device closes the connection to a host that it refuses
            raise
    found = link.foreign_version if identity is None else identity.protocol_version
    if found is None:
        heard = link.counts.bytes_received
        what = f"{heard} bytes came that are not aolink packets" if heard else "nothing came"
        raise DeviceError(
            f"no device answers on the {link.name} port ({what}): is it the right port, is the device switched on,"
            " does another host have it?"
        )
    if identity is None or found != PROTOCOL_VERSION:
        raise DeviceError(
            f"the device on the {link.name} port speaks protocol version {found}, this aolink speaks"
            f" {PROTOCOL_VERSION}: update the {'device' if found < PROTOCOL_VERSION else 'host'}"
        )
    if identity.schema_hash != schema_hash():
        raise DeviceError(
            f"the device on the {link.name} port was built with another messages.proto"
            f" ({identity.schema_hash[:8].hex()}, here {schema_hash().hex()}): update the older of the two"
        )
    check_identity(link, identity)
    return identity


def check_kind(link: Link, identity: pb.Identity, kind: pb.Identity.Kind) -> None:
    """Refuse a device of another kind. Raises DeviceError."""
    if identity.kind != kind:
        found, wanted = (pb.Identity.Kind.Name(each).lower() for each in (identity.kind, kind))
        raise DeviceError(
            f"the device on the {link.name} port is a {found} ({identity.model}), expected a {wanted}:"
            " are the two ports swapped?"
        )


def check_identity(link: Link, identity: pb.Identity) -> None:
    """Refuse an Identity with impossible numbers or names. Raises DeviceError naming the field."""
    name, found = link.name, identity.kind
    require(found in (pb.Identity.CAMERA, pb.Identity.MIRROR), name, "Identity.kind", found, "1 (camera) or 2 (mirror)")
    for field in ("model", "serial_number", "firmware", "rig_digest"):
        text = getattr(identity, field)
        fine, what = len(text) <= _LONGEST_NAME and text.isprintable(), "characters that can be printed"
        require(fine, name, f"Identity.{field}", repr(text[:40]), f"at most {_LONGEST_NAME} {what}")
    within(name, identity, "fast_step_ns", 1, 10**10)
    within(name, identity, "next_step", 0, MOST_STEP)
    check_times(name, identity, ("step_zero_ns",))


def check_against_rig(rig: Rig, identities: dict[str, pb.Identity]) -> list[str]:
    """Refuse devices that are not those of the rig file; gives warnings about what else is doubtful.

    ``identities`` are those of the camera, of the mirror or of both, by these names. Raises DeviceError naming the
    first difference.
    """
    times = {identity.virtual_time for identity in identities.values()}
    if times == {False, True} or (times == {True} and len({each.serial_number for each in identities.values()}) > 1):
        raise DeviceError(
            f"camera {identities['camera'].serial_number} and mirror {identities['mirror'].serial_number} do not belong"
            " to the same rig: a rig on virtual time needs both of its ports"
        )
    pairs: list[tuple[str, object, object]] = [
        (f"timing.fast_step_s ({line}, ns)", identity.fast_step_ns, rig.timing.fast_step_ns)
        for line, identity in identities.items()
    ]
    if "camera" in identities:
        camera, scene = identities["camera"].camera, rig.scene
        shape = scene.shape if scene else (0, 0)
        pairs += [
            ("sensor shape (rows, columns)", (camera.height, camera.width), rig.sensor.shape),
            ("sensor.bit_depth", camera.bit_depth, rig.sensor.bit_depth),
            ("scene.pixels (rows, columns)", (camera.scene_height, camera.scene_width), shape),
            ("scene.bit_depth", camera.scene_bit_depth, scene.bit_depth if scene else 0),
            ("timing.exposure_steps", camera.exposure_steps, rig.timing.exposure_steps),
            ("timing.frame_period_steps", camera.frame_period_steps, rig.timing.frame_period_steps),
        ]
    if "mirror" in identities:
        limits = identities["mirror"].mirror
        pairs.append(("number of inputs", limits.n_inputs, rig.n_inputs))
        for name in ("input_min", "input_max", "park"):
            pairs.append((f"mirror.{name}", [*getattr(limits, name)], getattr(rig.mirror, name).tolist()))
        for name in ("dac_bits", "queue_steps", "watchdog_s"):
            pairs.append((f"mirror.{name}", getattr(limits, name), getattr(rig.mirror, name)))
    for name, found, expected in pairs:
        if found != expected:
            raise DeviceError(
                f"the rig file {rig.name} does not match the device: {name} is {expected} in the file,"
                f" {found} on the device; give the rig file of this device (--rig)"
            )
    return [
        f"the {line} was made from another rig file than {rig.name}: sizes agree, other numbers (noise, kernel, plant)"
        " may not, and estimates may be wrong by it"
        for line, identity in identities.items()
        if identity.rig_digest and identity.rig_digest != rig.digest
    ][:1]
