"""The topics of a recording in one table, and the names of a recording's attachments and metadata."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message

from aolink.recording import schemas_pb2 as pb
from aolink.wire import messages_pb2 as wire

EXPOSURE = "/camera/exposure"
IMAGE = "/camera/image"
COMMAND = "/mirror/command"
APPLIED = "/mirror/applied"
ANSWER = "/mirror/ack"
SCENE_EXPOSURE = "/scene/exposure"
SCENE = "/scene/image"
TRUTH = "/truth"
ESTIMATE = "/estimate/"
ESTIMATION = "/estimation/"
RESTORED = "/restored/"
"""Prefix of the topics of restored pictures."""
RESTORATION = RESTORED + "exposure"
RESTORED_SCENE = RESTORED + "image"
RESTORED_SPOTS = RESTORED + "spot"
CONTROL = "/control"
LATENCY = "/latency"
CONNECTION = "/connection"
CLOCK = "/clock"
LOG = "/log"


CONNECTION_FAULTS = ("bad_crc", "bad_framing", "bad_payload", "sequence_gaps", "duplicates")
"""Fields of ``ConnectionStatistics`` that count what goes wrong on the connection to a device. The metadata at
the end of a recording have the sums over the devices, with ``connection_`` before the names."""


@dataclass(frozen=True)
class Curve:
    """A field of a topic's messages as a curve over time."""

    field: str
    label: str
    """What the legend says of it, behind the name of the device or the estimator."""
    view: str
    """Title of the view that shows it, with the view's unit; curves of several topics may share one."""
    unit: float = 1.0
    """Length of the field's unit in that of the view."""
    since: str = ""
    """Field from which it is counted."""
    shows: Literal["value", "sum", "change", "rate"] = "value"
    """Whether the view shows the values, their sum so far, their change since the first one, or their change in a
    second."""
    zero: bool = True
    """Whether zero is a value; where it is not, it says that there is nothing to show."""

    def is_in(self, message: Any) -> bool:
        """Whether a message has something to show."""
        return self.zero or bool(getattr(message, self.field))

    def value(self, message: Any) -> float:
        """The field of a message in the unit of the view."""
        since = getattr(message, self.since) if self.since else 0
        return self.unit * float(getattr(message, self.field) - since)


@dataclass(frozen=True)
class Topic:
    """One row of the table."""

    name: str
    """The topic's name; one that ends with "/" is a prefix, which an estimator's name follows."""
    message: type[Message]
    belongs_to: Literal["exposure", "steps", "time"] = "time"
    """The kind of thing that a message belongs to: an exposure (by its ``frame_id``), fast steps (from its
    ``first_step`` on), or only its time. `cut` selects messages by it, and `compare` finds their counterparts by it."""
    after: str = ""
    """Topic of the message that comes before a picture and names its exposure, which the picture itself does not."""
    curves: tuple[Curve, ...] = ()
    """What is drawn of its messages over time, by every view."""
    shown_by: str = ""
    """The module of `aolink.viewing` and its function that shows what is more than curves. Functions of `devices` get
    the messages themselves, other ones the exposures, estimates and pictures that are made of them."""


_LOST, _RESIDUAL = "Lost, faulty (count)", "Loop: residual (slope units)"
_LATENCY = "Latency (ms)"
_FAULTS = (*CONNECTION_FAULTS, "retransmits", "reports_asked")

TOPICS = (
    Topic(
        EXPOSURE, pb.ExposureInfo, "exposure",
        curves=(
            Curve("frames_lost_before", "frames lost", _LOST, shows="sum"),
            Curve("chunks_lost", "chunks lost", _LOST, shows="sum"),
        ),
        shown_by="incidents.log_exposures",
    ),
    Topic(IMAGE, RawImage, "exposure", after=EXPOSURE, shown_by="camera.log_frames"),
    Topic(COMMAND, wire.CommandBlock, "steps", shown_by="devices.log_commands"),
    Topic(APPLIED, wire.Applied, "steps", shown_by="devices.log_applied"),
    Topic(ANSWER, pb.CommandAnswer, "steps", shown_by="devices.log_answers"),
    Topic(SCENE_EXPOSURE, pb.ExposureInfo, "exposure", shown_by="scene.log_scenes"),
    Topic(SCENE, RawImage, "exposure", after=SCENE_EXPOSURE, shown_by="scene.log_scenes"),
    Topic(TRUTH, wire.Truth, "exposure", shown_by="motion.log_truth"),
    Topic(ESTIMATE, pb.Estimate, "exposure", shown_by="motion.log_estimates"),
    Topic(RESTORATION, pb.Restoration, "exposure", shown_by="scene.log_restored"),
    Topic(RESTORED_SCENE, RawImage, "exposure", after=RESTORATION, shown_by="scene.log_restored"),
    Topic(RESTORED_SPOTS, RawImage, "exposure", after=RESTORATION, shown_by="scene.log_restored"),
    Topic(
        CONTROL, pb.Control, "exposure",
        curves=(
            Curve("slope_rms", "RMS of the slopes", _RESIDUAL),
            Curve("path_rms", "RMS inside the exposure", _RESIDUAL),
            Curve("delay_steps", "exposure's end to first input", "Loop: delay (fast steps)"),
            Curve("clipped_steps", "steps that limits changed", "Loop: steps clipped (count)"),
        ),
        shown_by="devices.log_control",
    ),
    Topic(
        LATENCY, pb.Latency, "exposure",
        curves=tuple(
            Curve(field, label, _LATENCY, 1e-6, since="exposure_end_ns", zero=False)
            for field, label in (
                ("first_byte_ns", "first byte"), ("complete_ns", "frame complete"), ("estimated_ns", "estimated"),
                ("command_sent_ns", "command sent"), ("command_acknowledged_ns", "acknowledged"),
            )
        ),
    ),
    Topic(ESTIMATION, pb.Estimation, "exposure", curves=(Curve("took_ns", "takes", _LATENCY, 1e-6, zero=False),)),
    Topic(
        CONNECTION, pb.ConnectionStatistics, "time",
        curves=(
            *(Curve(field, field.replace("_", " "), _LOST, zero=False) for field in _FAULTS),
            Curve("round_trip_s", "round trip", "Command round trip (ms)", 1e3),
            Curve("bytes_received", "to host", "Received (kB/s)", 1e-3, shows="rate"),
        ),
    ),
    Topic(
        CLOCK, pb.ClockSample, "time",
        curves=(
            Curve("sigma_ns", "offset sd", "Clock offset sd (µs)", 1e-3),
            Curve("offset_ns", "offset change", "Clock offset change (µs)", 1e-3, shows="change"),
            Curve("frequency_ppm", "runs fast by", "Clock rate (ppm)"),
            Curve("round_trip_ns", "round trip", "Clock round trip (µs)", 1e-3),
        ),
    ),
    Topic(LOG, Log, "time", shown_by="devices.log_log"),
)  # fmt: skip

SCHEMAS = {row.message.DESCRIPTOR.full_name: row.message for row in TOPICS}
"""Message class by the full name of its schema."""
PICTURES = {row.after: tuple(each.name for each in TOPICS if each.after == row.after) for row in TOPICS if row.after}
"""The topics with facts about an exposure's pictures, and the topics of the pictures that follow them."""
RUNS = {row.name: row.message.DESCRIPTOR.full_name for row in TOPICS if "u" in row.message.DESCRIPTOR.fields_by_name}
"""The topics with the inputs of runs of steps, and their schemas."""
_UNKNOWN = Topic("", Message)


def find(name: str, message: Message | None) -> Topic:
    """The row of a message; where the topic does not hold such messages, a row that belongs to its time only."""
    row = named(name)
    return row if isinstance(message, row.message) else _UNKNOWN


@lru_cache(maxsize=256)
def named(name: str) -> Topic:
    """The row of a topic; one without a name for a topic that aolink does not know."""
    for row in TOPICS:
        if name == row.name or (row.name.endswith("/") and name.startswith(row.name)):
            return row
    return _UNKNOWN


def estimate_topic(estimator: str) -> str:
    """Topic of an estimator's estimates."""
    return ESTIMATE + estimator


def estimation_topic(estimator: str) -> str:
    """Topic of the messages about the exposures that an estimator had time for."""
    return ESTIMATION + estimator


RIG_ATTACHMENT = "rig.toml"
BASIS_ATTACHMENT = "exposure_basis.npy"
OUTPUTS_ATTACHMENT = "exposure_outputs.npy"
OF_EACH_FILE = (RIG_ATTACHMENT, BASIS_ATTACHMENT, OUTPUTS_ATTACHMENT)
"""Attachments at the beginning of every recording."""
TRUE_SCENE_ATTACHMENT = "true_scene.npy"
"""With simulated rigs, the counts that the picture sensor would have of the scene at rest, without noise and blur."""
SESSION_METADATA = "aolink"
"""Metadata written at the start: versions, rig, devices, note."""
RIG_METADATA = "aolink/rig"
"""Metadata with the rig file a second time, in case the attachment is damaged."""
CHANNEL_METADATA = "aolink/channel"
"""Metadata for each topic: its id, name and schema a second time, in case their chunk is damaged."""
PART, PART_OF = "part", "part_of"
"""Keys in the metadata of a session in several files: the number of this one, and the name that they have in common."""
SIDE_OF = "side_of"
"""Key in the metadata of a side file: the digest of the recording that its estimates are of."""
CALIBRATION = "calibration"
"""Key in the metadata of a session that recorded frames for a calibration: the kind of light."""
END_METADATA = "aolink/end"
"""Metadata written at the end: how the session ended, and its counts."""
