from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Code(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    OK: _ClassVar[Code]
    OUT_OF_RANGE: _ClassVar[Code]
    WRONG_SHAPE: _ClassVar[Code]
    QUEUE_FULL: _ClassVar[Code]
    NOT_SUPPORTED: _ClassVar[Code]
    TOO_LATE: _ClassVar[Code]
    LATCHED: _ClassVar[Code]
OK: Code
OUT_OF_RANGE: Code
WRONG_SHAPE: Code
QUEUE_FULL: Code
NOT_SUPPORTED: Code
TOO_LATE: Code
LATCHED: Code

class Identify(_message.Message):
    __slots__ = ("nonce",)
    NONCE_FIELD_NUMBER: _ClassVar[int]
    nonce: int
    def __init__(self, nonce: _Optional[int] = ...) -> None: ...

class Identity(_message.Message):
    __slots__ = ("nonce", "kind", "model", "serial_number", "firmware", "protocol_version", "schema_hash", "fast_step_ns", "next_step", "step_zero_ns", "virtual_time", "rig_digest", "camera", "mirror")
    class Kind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        UNKNOWN: _ClassVar[Identity.Kind]
        CAMERA: _ClassVar[Identity.Kind]
        MIRROR: _ClassVar[Identity.Kind]
    UNKNOWN: Identity.Kind
    CAMERA: Identity.Kind
    MIRROR: Identity.Kind
    NONCE_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    SERIAL_NUMBER_FIELD_NUMBER: _ClassVar[int]
    FIRMWARE_FIELD_NUMBER: _ClassVar[int]
    PROTOCOL_VERSION_FIELD_NUMBER: _ClassVar[int]
    SCHEMA_HASH_FIELD_NUMBER: _ClassVar[int]
    FAST_STEP_NS_FIELD_NUMBER: _ClassVar[int]
    NEXT_STEP_FIELD_NUMBER: _ClassVar[int]
    STEP_ZERO_NS_FIELD_NUMBER: _ClassVar[int]
    VIRTUAL_TIME_FIELD_NUMBER: _ClassVar[int]
    RIG_DIGEST_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    MIRROR_FIELD_NUMBER: _ClassVar[int]
    nonce: int
    kind: Identity.Kind
    model: str
    serial_number: str
    firmware: str
    protocol_version: int
    schema_hash: bytes
    fast_step_ns: int
    next_step: int
    step_zero_ns: int
    virtual_time: bool
    rig_digest: str
    camera: CameraGeometry
    mirror: MirrorLimits
    def __init__(self, nonce: _Optional[int] = ..., kind: _Optional[_Union[Identity.Kind, str]] = ..., model: _Optional[str] = ..., serial_number: _Optional[str] = ..., firmware: _Optional[str] = ..., protocol_version: _Optional[int] = ..., schema_hash: _Optional[bytes] = ..., fast_step_ns: _Optional[int] = ..., next_step: _Optional[int] = ..., step_zero_ns: _Optional[int] = ..., virtual_time: _Optional[bool] = ..., rig_digest: _Optional[str] = ..., camera: _Optional[_Union[CameraGeometry, _Mapping]] = ..., mirror: _Optional[_Union[MirrorLimits, _Mapping]] = ...) -> None: ...

class CameraGeometry(_message.Message):
    __slots__ = ("width", "height", "bit_depth", "exposure_steps", "frame_period_steps", "scene_width", "scene_height", "scene_bit_depth")
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    BIT_DEPTH_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_STEPS_FIELD_NUMBER: _ClassVar[int]
    FRAME_PERIOD_STEPS_FIELD_NUMBER: _ClassVar[int]
    SCENE_WIDTH_FIELD_NUMBER: _ClassVar[int]
    SCENE_HEIGHT_FIELD_NUMBER: _ClassVar[int]
    SCENE_BIT_DEPTH_FIELD_NUMBER: _ClassVar[int]
    width: int
    height: int
    bit_depth: int
    exposure_steps: int
    frame_period_steps: int
    scene_width: int
    scene_height: int
    scene_bit_depth: int
    def __init__(self, width: _Optional[int] = ..., height: _Optional[int] = ..., bit_depth: _Optional[int] = ..., exposure_steps: _Optional[int] = ..., frame_period_steps: _Optional[int] = ..., scene_width: _Optional[int] = ..., scene_height: _Optional[int] = ..., scene_bit_depth: _Optional[int] = ...) -> None: ...

class MirrorLimits(_message.Message):
    __slots__ = ("n_inputs", "input_min", "input_max", "park", "dac_bits", "queue_steps", "watchdog_s", "parked", "latched", "history_steps")
    N_INPUTS_FIELD_NUMBER: _ClassVar[int]
    INPUT_MIN_FIELD_NUMBER: _ClassVar[int]
    INPUT_MAX_FIELD_NUMBER: _ClassVar[int]
    PARK_FIELD_NUMBER: _ClassVar[int]
    DAC_BITS_FIELD_NUMBER: _ClassVar[int]
    QUEUE_STEPS_FIELD_NUMBER: _ClassVar[int]
    WATCHDOG_S_FIELD_NUMBER: _ClassVar[int]
    PARKED_FIELD_NUMBER: _ClassVar[int]
    LATCHED_FIELD_NUMBER: _ClassVar[int]
    HISTORY_STEPS_FIELD_NUMBER: _ClassVar[int]
    n_inputs: int
    input_min: _containers.RepeatedScalarFieldContainer[float]
    input_max: _containers.RepeatedScalarFieldContainer[float]
    park: _containers.RepeatedScalarFieldContainer[float]
    dac_bits: int
    queue_steps: int
    watchdog_s: float
    parked: bool
    latched: bool
    history_steps: int
    def __init__(self, n_inputs: _Optional[int] = ..., input_min: _Optional[_Iterable[float]] = ..., input_max: _Optional[_Iterable[float]] = ..., park: _Optional[_Iterable[float]] = ..., dac_bits: _Optional[int] = ..., queue_steps: _Optional[int] = ..., watchdog_s: _Optional[float] = ..., parked: _Optional[bool] = ..., latched: _Optional[bool] = ..., history_steps: _Optional[int] = ...) -> None: ...

class CommandBlock(_message.Message):
    __slots__ = ("block_id", "first_step", "n_steps", "u", "cause_frame_id")
    BLOCK_ID_FIELD_NUMBER: _ClassVar[int]
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    N_STEPS_FIELD_NUMBER: _ClassVar[int]
    U_FIELD_NUMBER: _ClassVar[int]
    CAUSE_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    block_id: int
    first_step: int
    n_steps: int
    u: _containers.RepeatedScalarFieldContainer[float]
    cause_frame_id: int
    def __init__(self, block_id: _Optional[int] = ..., first_step: _Optional[int] = ..., n_steps: _Optional[int] = ..., u: _Optional[_Iterable[float]] = ..., cause_frame_id: _Optional[int] = ...) -> None: ...

class CommandAck(_message.Message):
    __slots__ = ("block_id", "code", "text", "late_steps", "superseded_steps", "queue_end_step", "sequence")
    BLOCK_ID_FIELD_NUMBER: _ClassVar[int]
    CODE_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    LATE_STEPS_FIELD_NUMBER: _ClassVar[int]
    SUPERSEDED_STEPS_FIELD_NUMBER: _ClassVar[int]
    QUEUE_END_STEP_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    block_id: int
    code: Code
    text: str
    late_steps: int
    superseded_steps: int
    queue_end_step: int
    sequence: int
    def __init__(self, block_id: _Optional[int] = ..., code: _Optional[_Union[Code, str]] = ..., text: _Optional[str] = ..., late_steps: _Optional[int] = ..., superseded_steps: _Optional[int] = ..., queue_end_step: _Optional[int] = ..., sequence: _Optional[int] = ...) -> None: ...

class Applied(_message.Message):
    __slots__ = ("block_id", "first_step", "n_steps", "u", "source", "device_ns")
    class Source(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        COMMAND: _ClassVar[Applied.Source]
        PARKED: _ClassVar[Applied.Source]
        CLIPPED: _ClassVar[Applied.Source]
        WATCHDOG: _ClassVar[Applied.Source]
        NOT_REPORTED: _ClassVar[Applied.Source]
        AWAITED: _ClassVar[Applied.Source]
        LATE: _ClassVar[Applied.Source]
    COMMAND: Applied.Source
    PARKED: Applied.Source
    CLIPPED: Applied.Source
    WATCHDOG: Applied.Source
    NOT_REPORTED: Applied.Source
    AWAITED: Applied.Source
    LATE: Applied.Source
    BLOCK_ID_FIELD_NUMBER: _ClassVar[int]
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    N_STEPS_FIELD_NUMBER: _ClassVar[int]
    U_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    DEVICE_NS_FIELD_NUMBER: _ClassVar[int]
    block_id: int
    first_step: int
    n_steps: int
    u: _containers.RepeatedScalarFieldContainer[float]
    source: Applied.Source
    device_ns: int
    def __init__(self, block_id: _Optional[int] = ..., first_step: _Optional[int] = ..., n_steps: _Optional[int] = ..., u: _Optional[_Iterable[float]] = ..., source: _Optional[_Union[Applied.Source, str]] = ..., device_ns: _Optional[int] = ...) -> None: ...

class CameraControl(_message.Message):
    __slots__ = ("run", "first_step", "exposures")
    RUN_FIELD_NUMBER: _ClassVar[int]
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    EXPOSURES_FIELD_NUMBER: _ClassVar[int]
    run: bool
    first_step: int
    exposures: int
    def __init__(self, run: _Optional[bool] = ..., first_step: _Optional[int] = ..., exposures: _Optional[int] = ...) -> None: ...

class Park(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Ack(_message.Message):
    __slots__ = ("sequence", "code", "text", "step")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    CODE_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    code: Code
    text: str
    step: int
    def __init__(self, sequence: _Optional[int] = ..., code: _Optional[_Union[Code, str]] = ..., text: _Optional[str] = ..., step: _Optional[int] = ...) -> None: ...

class FrameChunk(_message.Message):
    __slots__ = ("frame_id", "offset", "total", "width", "height", "first_step", "last_step", "exposure_start_ns", "exposure_end_ns", "data", "exposure_offset_ns", "plane")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    LAST_STEP_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_START_NS_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_END_NS_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_OFFSET_NS_FIELD_NUMBER: _ClassVar[int]
    PLANE_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    offset: int
    total: int
    width: int
    height: int
    first_step: int
    last_step: int
    exposure_start_ns: int
    exposure_end_ns: int
    data: bytes
    exposure_offset_ns: int
    plane: int
    def __init__(self, frame_id: _Optional[int] = ..., offset: _Optional[int] = ..., total: _Optional[int] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., first_step: _Optional[int] = ..., last_step: _Optional[int] = ..., exposure_start_ns: _Optional[int] = ..., exposure_end_ns: _Optional[int] = ..., data: _Optional[bytes] = ..., exposure_offset_ns: _Optional[int] = ..., plane: _Optional[int] = ...) -> None: ...

class ClockQuery(_message.Message):
    __slots__ = ("query_id", "host_send_ns")
    QUERY_ID_FIELD_NUMBER: _ClassVar[int]
    HOST_SEND_NS_FIELD_NUMBER: _ClassVar[int]
    query_id: int
    host_send_ns: int
    def __init__(self, query_id: _Optional[int] = ..., host_send_ns: _Optional[int] = ...) -> None: ...

class ClockReply(_message.Message):
    __slots__ = ("query_id", "host_send_ns", "device_receive_ns", "device_send_ns")
    QUERY_ID_FIELD_NUMBER: _ClassVar[int]
    HOST_SEND_NS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_RECEIVE_NS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_SEND_NS_FIELD_NUMBER: _ClassVar[int]
    query_id: int
    host_send_ns: int
    device_receive_ns: int
    device_send_ns: int
    def __init__(self, query_id: _Optional[int] = ..., host_send_ns: _Optional[int] = ..., device_receive_ns: _Optional[int] = ..., device_send_ns: _Optional[int] = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("level", "device_ns", "text")
    class Level(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        INFO: _ClassVar[Event.Level]
        WARNING: _ClassVar[Event.Level]
        ERROR: _ClassVar[Event.Level]
    INFO: Event.Level
    WARNING: Event.Level
    ERROR: Event.Level
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    DEVICE_NS_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    level: Event.Level
    device_ns: int
    text: str
    def __init__(self, level: _Optional[_Union[Event.Level, str]] = ..., device_ns: _Optional[int] = ..., text: _Optional[str] = ...) -> None: ...

class Part(_message.Message):
    __slots__ = ("type", "offset", "total", "data")
    TYPE_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    type: int
    offset: int
    total: int
    data: bytes
    def __init__(self, type: _Optional[int] = ..., offset: _Optional[int] = ..., total: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...

class AppliedQuery(_message.Message):
    __slots__ = ("first_step", "n_steps")
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    N_STEPS_FIELD_NUMBER: _ClassVar[int]
    first_step: int
    n_steps: int
    def __init__(self, first_step: _Optional[int] = ..., n_steps: _Optional[int] = ...) -> None: ...

class Rearm(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class TruthChunk(_message.Message):
    __slots__ = ("frame_id", "offset", "total", "data")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    offset: int
    total: int
    data: bytes
    def __init__(self, frame_id: _Optional[int] = ..., offset: _Optional[int] = ..., total: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...

class Truth(_message.Message):
    __slots__ = ("frame_id", "axes", "n_outputs", "start_state", "end_state", "path", "path_single")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    AXES_FIELD_NUMBER: _ClassVar[int]
    N_OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    START_STATE_FIELD_NUMBER: _ClassVar[int]
    END_STATE_FIELD_NUMBER: _ClassVar[int]
    PATH_FIELD_NUMBER: _ClassVar[int]
    PATH_SINGLE_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    axes: int
    n_outputs: int
    start_state: _containers.RepeatedScalarFieldContainer[float]
    end_state: _containers.RepeatedScalarFieldContainer[float]
    path: _containers.RepeatedScalarFieldContainer[float]
    path_single: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, frame_id: _Optional[int] = ..., axes: _Optional[int] = ..., n_outputs: _Optional[int] = ..., start_state: _Optional[_Iterable[float]] = ..., end_state: _Optional[_Iterable[float]] = ..., path: _Optional[_Iterable[float]] = ..., path_single: _Optional[_Iterable[float]] = ...) -> None: ...

class VirtualTime(_message.Message):
    __slots__ = ("host_ns", "camera_bytes", "mirror_bytes")
    HOST_NS_FIELD_NUMBER: _ClassVar[int]
    CAMERA_BYTES_FIELD_NUMBER: _ClassVar[int]
    MIRROR_BYTES_FIELD_NUMBER: _ClassVar[int]
    host_ns: int
    camera_bytes: int
    mirror_bytes: int
    def __init__(self, host_ns: _Optional[int] = ..., camera_bytes: _Optional[int] = ..., mirror_bytes: _Optional[int] = ...) -> None: ...
