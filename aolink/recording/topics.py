"""The topics of a recording, and the schema of each."""

from __future__ import annotations

from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message

from aolink.recording import schemas_pb2
from aolink.wire import messages_pb2

IMAGE = "/camera/image"
EXPOSURE = "/camera/exposure"
SCENE = "/scene/image"
"""A second, picture sensor that shares the exposure."""
SCENE_EXPOSURE = "/scene/exposure"
RESTORED = "/restored/"
"""Prefix."""
RESTORED_SCENE = "/restored/image"
RESTORED_SPOTS = "/restored/spot"
RESTORATION = "/restored/exposure"
PICTURES = {EXPOSURE: (IMAGE,), SCENE_EXPOSURE: (SCENE,), RESTORATION: (RESTORED_SCENE, RESTORED_SPOTS)}
"""What is known about the pictures of an exposure, and which pictures follow it."""
COMMAND = "/mirror/command"
APPLIED = "/mirror/applied"
CLOCK = "/clock"
LINK = "/link"
TRUTH = "/truth"
LATENCY = "/latency"
LOG = "/log"
ESTIMATE = "/estimate/"
"""Prefix; the estimator's name follows."""
ESTIMATION = "/estimation/"
"""Prefix as well: what the estimator had time for."""

SCHEMAS: dict[str, type[Message]] = {
    message.DESCRIPTOR.full_name: message
    for message in (
        RawImage,
        Log,
        schemas_pb2.ExposureInfo,
        schemas_pb2.ClockSample,
        schemas_pb2.LinkStatistics,
        schemas_pb2.Latency,
        schemas_pb2.Estimate,
        schemas_pb2.Estimation,
        schemas_pb2.Restoration,
        messages_pb2.CommandBlock,
        messages_pb2.Applied,
        messages_pb2.Truth,
    )
}
"""Message class by the full name of its schema."""

RIG_ATTACHMENT = "rig.toml"
BASIS_ATTACHMENT = "exposure_basis.npy"
OUTPUTS_ATTACHMENT = "exposure_outputs.npy"
OF_EACH_FILE = (RIG_ATTACHMENT, BASIS_ATTACHMENT, OUTPUTS_ATTACHMENT)
"""Attachments that every recording is begun with."""
TRUE_SCENE_ATTACHMENT = "true_scene.npy"
"""Simulated rigs: what the picture sensor would read out of the scene at rest, without noise and blur."""
SESSION_METADATA = "aolink"
"""Written at the start: versions, rig, devices, note."""
RIG_METADATA = "aolink/rig"
"""The rig file a second time, in case that the attachment is damaged."""
CHANNEL_METADATA = "aolink/channel"
"""One for each topic: its id, name and schema a second time, in case that their chunk is damaged."""
CALIBRATION = "calibration"
"""Key in the metadata of a session that recorded frames for a calibration: what they show."""
END_METADATA = "aolink/end"
"""Written at the end: how the session ended, and its counts."""


def estimate_topic(name: str) -> str:
    """Topic of an estimator."""
    return ESTIMATE + name


def estimation_topic(name: str) -> str:
    """Topic of what an estimator had time for."""
    return ESTIMATION + name
