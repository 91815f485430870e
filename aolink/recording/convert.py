"""Conversion between plain data and the messages of a recording. It is lossless: the data that is read back is that
which was written, bit for bit."""

from __future__ import annotations

from dataclasses import asdict
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import zstandard
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from numpy.typing import NDArray

from aolink.assembly import Frame
from aolink.errors import RecordingError
from aolink.estimation import ExposureModel
from aolink.estimation.estimate import LARGE, AlignmentError, Estimate, Status
from aolink.estimation.verdict import Fit, Verdict
from aolink.exposure import Exposure, Truth
from aolink.limits import CHUNK_BYTES
from aolink.numerics.covariance import CORRELATION_STEP, correlation_steps, from_correlation_steps
from aolink.recording import schemas_pb2 as pb
from aolink.wire import messages_pb2 as wire

if TYPE_CHECKING:
    from aolink.control import Act
    from aolink.restoration import RestoredPictures

_COUNTS = np.dtype("<u2")

# Fields that a frame, restored pictures and an estimate share with their messages.
_OF_FRAME = (
    "frame_id", "first_step", "last_step", "device_start_ns", "device_end_ns", "host_start_ns", "clock_sigma_ns",
    "alignment_sigma_ns", "host_first_byte_ns", "host_receive_ns", "chunks_lost", "frames_lost_before",
    "exposure_offset_ns", "rows_unknown",
)  # fmt: skip
_OF_ACT = (
    "frame_id", "first_step", "delay_steps", "late", "reason", "slope_rms", "path_rms", "clipped_steps", "acting",
)  # fmt: skip
_OF_RESTORATION = ("frame_id", "estimator", "method", "scene_noise_sd", "path_noise_sd", "reason")
_OF_VERDICT = ("kind", "pixels", "motion", "zero", "exposures", "widening", "since", "nis")
_OF_ESTIMATE = ("estimator", "frame_id", "first_step", "n_steps", "reason")


def frame_messages(frame: Frame) -> tuple[pb.ExposureInfo, RawImage]:
    """The messages of a frame: its facts, and its picture."""
    height, width = frame.pixels.shape
    offsets, lengths = _runs(~frame.mask.ravel())
    facts = {name: getattr(frame, name) for name in _OF_FRAME}
    info = pb.ExposureInfo(missing_offset=2 * offsets, missing_length=2 * lengths, slopes=frame.slopes, **facts)
    sensor = "scene" if frame.plane else "camera"
    image = RawImage(frame_id=sensor, width=width, height=height, encoding="mono16", step=2 * width)
    image.timestamp.FromNanoseconds(frame.host_start_ns or frame.host_receive_ns)
    image.data = frame.pixels.astype("<u2").tobytes()
    return info, image


def control_message(act: Act, controller: str, estimator: str) -> pb.Control:
    """The message of a controller's result for an exposure."""
    return pb.Control(
        controller=controller, estimator=estimator, state=pb.Control.State.Name(act.state),
        **{name: getattr(act, name) for name in _OF_ACT},
    )  # fmt: skip


def restoration_message(done: RestoredPictures) -> pb.Restoration:
    """The message with the facts about an exposure's restored pictures."""
    return pb.Restoration(**{name: getattr(done, name) for name in _OF_RESTORATION})


def restored_from_messages(info: pb.Restoration, scene: RawImage | None, spots: RawImage | None) -> RestoredPictures:
    """Inverse of `restoration_message` and `float_image`."""
    from aolink.restoration import RestoredPictures  # the import takes a second, and few readers of a recording need it

    return RestoredPictures(
        scene=scene and picture_from_float_image(scene), spots=spots and picture_from_float_image(spots),
        **{name: getattr(info, name) for name in _OF_RESTORATION},
    )  # fmt: skip


def float_image(picture: NDArray[np.float32], time_ns: int) -> RawImage:
    """The message of a restored picture."""
    height, width = picture.shape
    image = RawImage(frame_id="restored", width=width, height=height, encoding="32FC1", step=4 * width)
    image.timestamp.FromNanoseconds(time_ns)
    image.data = picture.astype("<f4").tobytes()
    return image


def picture_from_float_image(image: RawImage) -> NDArray[np.float32]:
    """Inverse of `float_image`."""
    return np.frombuffer(image.data, dtype="<f4").astype(np.float32).reshape(image.height, image.width)


def frame_from_messages(info: pb.ExposureInfo, image: RawImage) -> Frame:
    """Inverse of `frame_messages`; its arrays must not be changed, because other frames may share them."""
    shape, data = (image.height, image.width), image.data
    mask = _whole(shape)
    if info.missing_offset:
        mask = np.ones(len(data) // 2, dtype=bool)
        for offset, length in zip(info.missing_offset, info.missing_length, strict=True):
            mask[offset // 2 : (offset + length + 1) // 2] = False
        mask = mask.reshape(shape)
    pixels = np.frombuffer(data, _COUNTS).astype(np.uint16, copy=False).reshape(shape)
    slopes = np.array(info.slopes) if info.slopes else None
    return Frame(pixels=pixels, mask=mask, slopes=slopes, **{name: getattr(info, name) for name in _OF_FRAME})


@lru_cache(maxsize=8)
def _whole(shape: tuple[int, int]) -> NDArray[np.bool_]:
    """The mask of a complete frame, shared by all of them."""
    mask = np.ones(shape, dtype=bool)
    mask.flags.writeable = False
    return mask


def estimate_message(estimate: Estimate) -> pb.Estimate:
    """The message of an estimate, with the path as coefficients of the exposure basis."""
    axes, n_states = estimate.end_state.shape
    spread = estimate.innovation_covariance.ravel()
    message = pb.Estimate(
        **{name: getattr(estimate, name) for name in _OF_ESTIMATE}, status=pb.Estimate.Status.Name(estimate.status),
        axes=axes, n_states=n_states, n_coefficients=estimate.coefficients.shape[1],
        n_measurements=estimate.innovation.shape[1], end_state=estimate.end_state.ravel(),
        coefficients=estimate.coefficients.ravel(), innovation=estimate.innovation.ravel(),
        innovation_covariance=spread if estimate.innovation_covariance.ndim == 3 else None,
        innovation_variance=spread if estimate.innovation_covariance.ndim == 2 else None, nis=estimate.nis,
    )  # fmt: skip
    for name in ("end_covariance", "coefficient_covariance"):
        covariance = getattr(estimate, name)
        if covariance.shape[-1] > LARGE and (data := correlated(covariance)):
            setattr(message, f"correlated_{name}", data)
        else:
            _fill(message, name, covariance)
    if estimate.alignment is not None:
        message.alignment_steps = estimate.alignment.steps
        _fill(message, "alignment_coefficients", estimate.alignment.coefficients)
        _fill(message, "alignment_end_state", estimate.alignment.end_state)
    if estimate.verdict is not None:
        message.verdict.CopyFrom(pb.Verdict(**asdict(estimate.verdict)))
    return message


def verdict_of(message: pb.Estimate) -> Verdict | None:
    """The verdict in the message of an estimate, where there is one."""
    if not message.HasField("verdict"):
        return None
    numbers = {name: getattr(message.verdict, name) for name in _OF_VERDICT}
    return Verdict(fit=Fit(message.verdict.fit), **numbers)


def correlated(covariance: NDArray[np.float64]) -> bytes:
    """Matrices (axes, n, n) that were rounded by `as_recorded`, as schemas.proto says; empty where they were not."""
    sd = np.sqrt(np.maximum(np.einsum("aii->ai", covariance), 0.0)).astype(np.float32).astype(np.float64)
    steps = correlation_steps(covariance, sd)
    if not np.array_equal(from_correlation_steps(sd, steps), covariance):
        return b""
    signed = np.take(steps.reshape(len(steps), -1), _below_diagonal(steps.shape[-1]), axis=1).astype("<i4")
    numbers = np.ascontiguousarray((signed << 1) ^ (signed >> 31))
    planes = np.ascontiguousarray(numbers.view(np.uint8).reshape(-1, 4).T[:3])
    parts = [sd.astype("<f4").tobytes(), *(each.tobytes() for each in planes)]
    # Low and high bytes are coded separately, because they are distributed differently.
    frame = zstandard.ZstdCompressor(level=1).compressobj(size=sum(map(len, parts)))
    blocks = (frame.compress(each) + frame.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK) for each in parts)
    return b"".join(blocks) + frame.flush()


def is_compressed(data: bytes, axes: int, n: int) -> bool:
    """Whether bytes declare the matrices of `correlated` of this size, and memory has room for them."""
    try:
        size = zstandard.get_frame_parameters(data).content_size
    except zstandard.ZstdError:
        return False
    return 8 * axes * n * n <= CHUNK_BYTES and size == axes * (4 * n + 3 * (n * (n - 1) // 2))


def decoded(data: bytes, axes: int, n: int) -> NDArray[np.float64]:
    """Inverse of `correlated`."""
    try:
        content = np.frombuffer(zstandard.decompress(data) if is_compressed(data, axes, n) else b"", np.uint8)
    except zstandard.ZstdError:
        content = np.empty(0, np.uint8)
    if not len(content):
        raise RecordingError("an estimate in the file has the wrong size: the file is damaged")
    sd = np.frombuffer(content[: 4 * axes * n], "<f4").astype(np.float64).reshape(axes, n)
    planes = np.zeros((axes * (n * (n - 1) // 2), 4), np.uint8)
    planes[:, :3] = content[4 * axes * n :].reshape(3, -1).T
    numbers = planes.view("<i4").reshape(axes, -1)
    steps = np.zeros((axes, n, n))
    np.einsum("aii->ai", steps)[...] = 0.5 / CORRELATION_STEP
    steps.reshape(axes, -1)[:, _below_diagonal(n)] = (numbers >> 1) ^ -(numbers & 1)
    return from_correlation_steps(sd, steps + steps.swapaxes(-1, -2))


@lru_cache(maxsize=8)
def _below_diagonal(n: int) -> NDArray[np.int64]:
    """The indices of the lower triangle without the diagonal, in a matrix that is read row by row."""
    return np.flatnonzero(np.tri(n, k=-1, dtype=bool))


def _covariance(message: pb.Estimate, name: str, axes: int, n: int) -> NDArray[np.float64]:
    data: bytes = getattr(message, f"correlated_{name}")
    return decoded(data, axes, n) if data else _array(getattr(message, name), axes, n, n)


def _fill(message: Message, field: str, values: NDArray[np.float64]) -> None:
    """Set a field of numbers by their bytes on the wire: for half a million numbers, in a tenth of the time."""
    data = np.ascontiguousarray(values, dtype="<f8").tobytes()
    packed = 8 * message.DESCRIPTOR.fields_by_name[field].number + 2
    message.MergeFromString(_varint(packed) + _varint(len(data)) + data)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def estimate_from_message(message: pb.Estimate, model: ExposureModel, exposure: Exposure) -> Estimate:
    """Inverse of `estimate_message`; the path is that of the inputs of its exposure."""
    axes, n, c, m = message.axes, message.n_states, message.n_coefficients, message.n_measurements
    coefficients = _array(message.coefficients, axes, c)
    covariance = _covariance(message, "coefficient_covariance", axes, c)
    if message.innovation_variance:
        spread = _array(message.innovation_variance, axes, m)
    else:
        spread = _array(message.innovation_covariance, axes, m, m)
    alignment, start_covariance = None, covariance[:, :n, :n].copy()
    if message.alignment_steps:
        alignment = AlignmentError(
            message.alignment_steps,
            _array(message.alignment_coefficients, axes, c),
            _array(message.alignment_end_state, axes, n),
        )
        start_covariance = alignment.added_to(start_covariance, "coefficients")
    return Estimate(
        **{name: getattr(message, name) for name in _OF_ESTIMATE}, status=Status(message.status),
        start_state=coefficients[:, :n].copy(), start_covariance=start_covariance,
        end_state=_array(message.end_state, axes, n), end_covariance=_covariance(message, "end_covariance", axes, n),
        coefficients=coefficients, coefficient_covariance=covariance, inputs=exposure.inputs, model=model,
        innovation=_array(message.innovation, axes, m), innovation_covariance=spread, nis=_array(message.nis, axes),
        alignment=alignment, verdict=verdict_of(message),
    )  # fmt: skip


def truth_from_message(message: wire.Truth) -> Truth:
    """The truth of an exposure from the simulated rig's message."""
    axes, outputs = message.axes, message.n_outputs
    return Truth(
        start_state=_array(message.start_state, axes, -1),
        end_state=_array(message.end_state, axes, -1),
        path=_array(message.path or message.path_single, outputs, -1),
    )


def _array(values: object, *shape: int) -> NDArray[np.float64]:
    try:
        return np.array(values, dtype=np.float64).reshape(shape)
    except ValueError:
        raise RecordingError("an estimate or a truth in the file has the wrong size: the file is damaged") from None


def _runs(flags: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2] - edges[::2]
