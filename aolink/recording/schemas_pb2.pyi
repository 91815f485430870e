from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ExposureInfo(_message.Message):
    __slots__ = ("frame_id", "first_step", "last_step", "device_start_ns", "device_end_ns", "host_start_ns", "clock_sigma_ns", "host_first_byte_ns", "host_receive_ns", "chunks_lost", "missing_offset", "missing_length", "frames_lost_before", "exposure_offset_ns", "alignment_sigma_ns", "slopes", "rows_unknown")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    LAST_STEP_FIELD_NUMBER: _ClassVar[int]
    DEVICE_START_NS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_END_NS_FIELD_NUMBER: _ClassVar[int]
    HOST_START_NS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_SIGMA_NS_FIELD_NUMBER: _ClassVar[int]
    HOST_FIRST_BYTE_NS_FIELD_NUMBER: _ClassVar[int]
    HOST_RECEIVE_NS_FIELD_NUMBER: _ClassVar[int]
    CHUNKS_LOST_FIELD_NUMBER: _ClassVar[int]
    MISSING_OFFSET_FIELD_NUMBER: _ClassVar[int]
    MISSING_LENGTH_FIELD_NUMBER: _ClassVar[int]
    FRAMES_LOST_BEFORE_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_OFFSET_NS_FIELD_NUMBER: _ClassVar[int]
    ALIGNMENT_SIGMA_NS_FIELD_NUMBER: _ClassVar[int]
    SLOPES_FIELD_NUMBER: _ClassVar[int]
    ROWS_UNKNOWN_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    first_step: int
    last_step: int
    device_start_ns: int
    device_end_ns: int
    host_start_ns: int
    clock_sigma_ns: float
    host_first_byte_ns: int
    host_receive_ns: int
    chunks_lost: int
    missing_offset: _containers.RepeatedScalarFieldContainer[int]
    missing_length: _containers.RepeatedScalarFieldContainer[int]
    frames_lost_before: int
    exposure_offset_ns: int
    alignment_sigma_ns: float
    slopes: _containers.RepeatedScalarFieldContainer[float]
    rows_unknown: bool
    def __init__(self, frame_id: _Optional[int] = ..., first_step: _Optional[int] = ..., last_step: _Optional[int] = ..., device_start_ns: _Optional[int] = ..., device_end_ns: _Optional[int] = ..., host_start_ns: _Optional[int] = ..., clock_sigma_ns: _Optional[float] = ..., host_first_byte_ns: _Optional[int] = ..., host_receive_ns: _Optional[int] = ..., chunks_lost: _Optional[int] = ..., missing_offset: _Optional[_Iterable[int]] = ..., missing_length: _Optional[_Iterable[int]] = ..., frames_lost_before: _Optional[int] = ..., exposure_offset_ns: _Optional[int] = ..., alignment_sigma_ns: _Optional[float] = ..., slopes: _Optional[_Iterable[float]] = ..., rows_unknown: _Optional[bool] = ...) -> None: ...

class ClockSample(_message.Message):
    __slots__ = ("device", "host_send_ns", "device_receive_ns", "device_send_ns", "host_receive_ns", "round_trip_ns", "accepted", "offset_ns", "frequency_ppm", "sigma_ns")
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    HOST_SEND_NS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_RECEIVE_NS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_SEND_NS_FIELD_NUMBER: _ClassVar[int]
    HOST_RECEIVE_NS_FIELD_NUMBER: _ClassVar[int]
    ROUND_TRIP_NS_FIELD_NUMBER: _ClassVar[int]
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    OFFSET_NS_FIELD_NUMBER: _ClassVar[int]
    FREQUENCY_PPM_FIELD_NUMBER: _ClassVar[int]
    SIGMA_NS_FIELD_NUMBER: _ClassVar[int]
    device: str
    host_send_ns: int
    device_receive_ns: int
    device_send_ns: int
    host_receive_ns: int
    round_trip_ns: int
    accepted: bool
    offset_ns: float
    frequency_ppm: float
    sigma_ns: float
    def __init__(self, device: _Optional[str] = ..., host_send_ns: _Optional[int] = ..., device_receive_ns: _Optional[int] = ..., device_send_ns: _Optional[int] = ..., host_receive_ns: _Optional[int] = ..., round_trip_ns: _Optional[int] = ..., accepted: _Optional[bool] = ..., offset_ns: _Optional[float] = ..., frequency_ppm: _Optional[float] = ..., sigma_ns: _Optional[float] = ...) -> None: ...

class CommandAnswer(_message.Message):
    __slots__ = ("block_id", "first_step", "n_steps", "answer", "text", "late_steps", "superseded_steps", "queue_end_step", "tries", "times_full", "sent_ns", "answered_ns", "device_ns")
    class Answer(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        OK: _ClassVar[CommandAnswer.Answer]
        OUT_OF_RANGE: _ClassVar[CommandAnswer.Answer]
        WRONG_SHAPE: _ClassVar[CommandAnswer.Answer]
        QUEUE_FULL: _ClassVar[CommandAnswer.Answer]
        NOT_SUPPORTED: _ClassVar[CommandAnswer.Answer]
        TOO_LATE: _ClassVar[CommandAnswer.Answer]
        LATCHED: _ClassVar[CommandAnswer.Answer]
        NONE: _ClassVar[CommandAnswer.Answer]
    OK: CommandAnswer.Answer
    OUT_OF_RANGE: CommandAnswer.Answer
    WRONG_SHAPE: CommandAnswer.Answer
    QUEUE_FULL: CommandAnswer.Answer
    NOT_SUPPORTED: CommandAnswer.Answer
    TOO_LATE: CommandAnswer.Answer
    LATCHED: CommandAnswer.Answer
    NONE: CommandAnswer.Answer
    BLOCK_ID_FIELD_NUMBER: _ClassVar[int]
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    N_STEPS_FIELD_NUMBER: _ClassVar[int]
    ANSWER_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    LATE_STEPS_FIELD_NUMBER: _ClassVar[int]
    SUPERSEDED_STEPS_FIELD_NUMBER: _ClassVar[int]
    QUEUE_END_STEP_FIELD_NUMBER: _ClassVar[int]
    TRIES_FIELD_NUMBER: _ClassVar[int]
    TIMES_FULL_FIELD_NUMBER: _ClassVar[int]
    SENT_NS_FIELD_NUMBER: _ClassVar[int]
    ANSWERED_NS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_NS_FIELD_NUMBER: _ClassVar[int]
    block_id: int
    first_step: int
    n_steps: int
    answer: CommandAnswer.Answer
    text: str
    late_steps: int
    superseded_steps: int
    queue_end_step: int
    tries: int
    times_full: int
    sent_ns: int
    answered_ns: int
    device_ns: int
    def __init__(self, block_id: _Optional[int] = ..., first_step: _Optional[int] = ..., n_steps: _Optional[int] = ..., answer: _Optional[_Union[CommandAnswer.Answer, str]] = ..., text: _Optional[str] = ..., late_steps: _Optional[int] = ..., superseded_steps: _Optional[int] = ..., queue_end_step: _Optional[int] = ..., tries: _Optional[int] = ..., times_full: _Optional[int] = ..., sent_ns: _Optional[int] = ..., answered_ns: _Optional[int] = ..., device_ns: _Optional[int] = ...) -> None: ...

class ConnectionStatistics(_message.Message):
    __slots__ = ("device", "messages_received", "bytes_received", "messages_sent", "bytes_sent", "bad_crc", "bad_framing", "bad_payload", "sequence_gaps", "duplicates", "retransmits", "commands_in_flight", "round_trip_s", "queue_end_step", "reports_asked")
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    MESSAGES_RECEIVED_FIELD_NUMBER: _ClassVar[int]
    BYTES_RECEIVED_FIELD_NUMBER: _ClassVar[int]
    MESSAGES_SENT_FIELD_NUMBER: _ClassVar[int]
    BYTES_SENT_FIELD_NUMBER: _ClassVar[int]
    BAD_CRC_FIELD_NUMBER: _ClassVar[int]
    BAD_FRAMING_FIELD_NUMBER: _ClassVar[int]
    BAD_PAYLOAD_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_GAPS_FIELD_NUMBER: _ClassVar[int]
    DUPLICATES_FIELD_NUMBER: _ClassVar[int]
    RETRANSMITS_FIELD_NUMBER: _ClassVar[int]
    COMMANDS_IN_FLIGHT_FIELD_NUMBER: _ClassVar[int]
    ROUND_TRIP_S_FIELD_NUMBER: _ClassVar[int]
    QUEUE_END_STEP_FIELD_NUMBER: _ClassVar[int]
    REPORTS_ASKED_FIELD_NUMBER: _ClassVar[int]
    device: str
    messages_received: int
    bytes_received: int
    messages_sent: int
    bytes_sent: int
    bad_crc: int
    bad_framing: int
    bad_payload: int
    sequence_gaps: int
    duplicates: int
    retransmits: int
    commands_in_flight: int
    round_trip_s: float
    queue_end_step: int
    reports_asked: int
    def __init__(self, device: _Optional[str] = ..., messages_received: _Optional[int] = ..., bytes_received: _Optional[int] = ..., messages_sent: _Optional[int] = ..., bytes_sent: _Optional[int] = ..., bad_crc: _Optional[int] = ..., bad_framing: _Optional[int] = ..., bad_payload: _Optional[int] = ..., sequence_gaps: _Optional[int] = ..., duplicates: _Optional[int] = ..., retransmits: _Optional[int] = ..., commands_in_flight: _Optional[int] = ..., round_trip_s: _Optional[float] = ..., queue_end_step: _Optional[int] = ..., reports_asked: _Optional[int] = ...) -> None: ...

class Latency(_message.Message):
    __slots__ = ("frame_id", "exposure_end_ns", "first_byte_ns", "complete_ns", "estimated_ns", "command_sent_ns", "command_acknowledged_ns", "command_applied_ns")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_END_NS_FIELD_NUMBER: _ClassVar[int]
    FIRST_BYTE_NS_FIELD_NUMBER: _ClassVar[int]
    COMPLETE_NS_FIELD_NUMBER: _ClassVar[int]
    ESTIMATED_NS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_SENT_NS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_ACKNOWLEDGED_NS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_APPLIED_NS_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    exposure_end_ns: int
    first_byte_ns: int
    complete_ns: int
    estimated_ns: int
    command_sent_ns: int
    command_acknowledged_ns: int
    command_applied_ns: int
    def __init__(self, frame_id: _Optional[int] = ..., exposure_end_ns: _Optional[int] = ..., first_byte_ns: _Optional[int] = ..., complete_ns: _Optional[int] = ..., estimated_ns: _Optional[int] = ..., command_sent_ns: _Optional[int] = ..., command_acknowledged_ns: _Optional[int] = ..., command_applied_ns: _Optional[int] = ...) -> None: ...

class Estimate(_message.Message):
    __slots__ = ("estimator", "frame_id", "first_step", "n_steps", "status", "reason", "axes", "n_states", "n_coefficients", "n_measurements", "end_state", "end_covariance", "coefficients", "coefficient_covariance", "innovation", "innovation_covariance", "nis", "innovation_variance", "correlated_end_covariance", "correlated_coefficient_covariance", "alignment_steps", "alignment_coefficients", "alignment_end_state", "verdict")
    class Status(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        OK: _ClassVar[Estimate.Status]
        GATED: _ClassVar[Estimate.Status]
        DIVERGED: _ClassVar[Estimate.Status]
        REINITIALISED: _ClassVar[Estimate.Status]
        INPUT_INVALID: _ClassVar[Estimate.Status]
        PREDICTED: _ClassVar[Estimate.Status]
    OK: Estimate.Status
    GATED: Estimate.Status
    DIVERGED: Estimate.Status
    REINITIALISED: Estimate.Status
    INPUT_INVALID: Estimate.Status
    PREDICTED: Estimate.Status
    ESTIMATOR_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    N_STEPS_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    AXES_FIELD_NUMBER: _ClassVar[int]
    N_STATES_FIELD_NUMBER: _ClassVar[int]
    N_COEFFICIENTS_FIELD_NUMBER: _ClassVar[int]
    N_MEASUREMENTS_FIELD_NUMBER: _ClassVar[int]
    END_STATE_FIELD_NUMBER: _ClassVar[int]
    END_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    COEFFICIENTS_FIELD_NUMBER: _ClassVar[int]
    COEFFICIENT_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    INNOVATION_FIELD_NUMBER: _ClassVar[int]
    INNOVATION_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    NIS_FIELD_NUMBER: _ClassVar[int]
    INNOVATION_VARIANCE_FIELD_NUMBER: _ClassVar[int]
    CORRELATED_END_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    CORRELATED_COEFFICIENT_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    ALIGNMENT_STEPS_FIELD_NUMBER: _ClassVar[int]
    ALIGNMENT_COEFFICIENTS_FIELD_NUMBER: _ClassVar[int]
    ALIGNMENT_END_STATE_FIELD_NUMBER: _ClassVar[int]
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    estimator: str
    frame_id: int
    first_step: int
    n_steps: int
    status: Estimate.Status
    reason: str
    axes: int
    n_states: int
    n_coefficients: int
    n_measurements: int
    end_state: _containers.RepeatedScalarFieldContainer[float]
    end_covariance: _containers.RepeatedScalarFieldContainer[float]
    coefficients: _containers.RepeatedScalarFieldContainer[float]
    coefficient_covariance: _containers.RepeatedScalarFieldContainer[float]
    innovation: _containers.RepeatedScalarFieldContainer[float]
    innovation_covariance: _containers.RepeatedScalarFieldContainer[float]
    nis: _containers.RepeatedScalarFieldContainer[float]
    innovation_variance: _containers.RepeatedScalarFieldContainer[float]
    correlated_end_covariance: bytes
    correlated_coefficient_covariance: bytes
    alignment_steps: float
    alignment_coefficients: _containers.RepeatedScalarFieldContainer[float]
    alignment_end_state: _containers.RepeatedScalarFieldContainer[float]
    verdict: Verdict
    def __init__(self, estimator: _Optional[str] = ..., frame_id: _Optional[int] = ..., first_step: _Optional[int] = ..., n_steps: _Optional[int] = ..., status: _Optional[_Union[Estimate.Status, str]] = ..., reason: _Optional[str] = ..., axes: _Optional[int] = ..., n_states: _Optional[int] = ..., n_coefficients: _Optional[int] = ..., n_measurements: _Optional[int] = ..., end_state: _Optional[_Iterable[float]] = ..., end_covariance: _Optional[_Iterable[float]] = ..., coefficients: _Optional[_Iterable[float]] = ..., coefficient_covariance: _Optional[_Iterable[float]] = ..., innovation: _Optional[_Iterable[float]] = ..., innovation_covariance: _Optional[_Iterable[float]] = ..., nis: _Optional[_Iterable[float]] = ..., innovation_variance: _Optional[_Iterable[float]] = ..., correlated_end_covariance: _Optional[bytes] = ..., correlated_coefficient_covariance: _Optional[bytes] = ..., alignment_steps: _Optional[float] = ..., alignment_coefficients: _Optional[_Iterable[float]] = ..., alignment_end_state: _Optional[_Iterable[float]] = ..., verdict: _Optional[_Union[Verdict, _Mapping]] = ...) -> None: ...

class Verdict(_message.Message):
    __slots__ = ("fit", "kind", "pixels", "motion", "zero", "exposures", "nis", "since", "widening")
    class Fit(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        UNKNOWN: _ClassVar[Verdict.Fit]
        FITS: _ClassVar[Verdict.Fit]
        DOES_NOT_FIT: _ClassVar[Verdict.Fit]
    UNKNOWN: Verdict.Fit
    FITS: Verdict.Fit
    DOES_NOT_FIT: Verdict.Fit
    FIT_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    PIXELS_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    ZERO_FIELD_NUMBER: _ClassVar[int]
    EXPOSURES_FIELD_NUMBER: _ClassVar[int]
    NIS_FIELD_NUMBER: _ClassVar[int]
    SINCE_FIELD_NUMBER: _ClassVar[int]
    WIDENING_FIELD_NUMBER: _ClassVar[int]
    fit: Verdict.Fit
    kind: str
    pixels: float
    motion: float
    zero: float
    exposures: int
    nis: float
    since: int
    widening: float
    def __init__(self, fit: _Optional[_Union[Verdict.Fit, str]] = ..., kind: _Optional[str] = ..., pixels: _Optional[float] = ..., motion: _Optional[float] = ..., zero: _Optional[float] = ..., exposures: _Optional[int] = ..., nis: _Optional[float] = ..., since: _Optional[int] = ..., widening: _Optional[float] = ...) -> None: ...

class Estimation(_message.Message):
    __slots__ = ("estimator", "frame_id", "skipped", "reason", "took_ns")
    ESTIMATOR_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    TOOK_NS_FIELD_NUMBER: _ClassVar[int]
    estimator: str
    frame_id: int
    skipped: bool
    reason: str
    took_ns: int
    def __init__(self, estimator: _Optional[str] = ..., frame_id: _Optional[int] = ..., skipped: _Optional[bool] = ..., reason: _Optional[str] = ..., took_ns: _Optional[int] = ...) -> None: ...

class Restoration(_message.Message):
    __slots__ = ("frame_id", "estimator", "method", "scene_noise_sd", "path_noise_sd", "reason")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    ESTIMATOR_FIELD_NUMBER: _ClassVar[int]
    METHOD_FIELD_NUMBER: _ClassVar[int]
    SCENE_NOISE_SD_FIELD_NUMBER: _ClassVar[int]
    PATH_NOISE_SD_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    estimator: str
    method: str
    scene_noise_sd: float
    path_noise_sd: float
    reason: str
    def __init__(self, frame_id: _Optional[int] = ..., estimator: _Optional[str] = ..., method: _Optional[str] = ..., scene_noise_sd: _Optional[float] = ..., path_noise_sd: _Optional[float] = ..., reason: _Optional[str] = ...) -> None: ...

class Control(_message.Message):
    __slots__ = ("controller", "estimator", "frame_id", "first_step", "delay_steps", "late", "state", "reason", "slope_rms", "path_rms", "clipped_steps", "acting")
    class State(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        CLOSED: _ClassVar[Control.State]
        HELD: _ClassVar[Control.State]
        PARKED: _ClassVar[Control.State]
    CLOSED: Control.State
    HELD: Control.State
    PARKED: Control.State
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    ESTIMATOR_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    DELAY_STEPS_FIELD_NUMBER: _ClassVar[int]
    LATE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    SLOPE_RMS_FIELD_NUMBER: _ClassVar[int]
    PATH_RMS_FIELD_NUMBER: _ClassVar[int]
    CLIPPED_STEPS_FIELD_NUMBER: _ClassVar[int]
    ACTING_FIELD_NUMBER: _ClassVar[int]
    controller: str
    estimator: str
    frame_id: int
    first_step: int
    delay_steps: int
    late: bool
    state: Control.State
    reason: str
    slope_rms: float
    path_rms: float
    clipped_steps: int
    acting: str
    def __init__(self, controller: _Optional[str] = ..., estimator: _Optional[str] = ..., frame_id: _Optional[int] = ..., first_step: _Optional[int] = ..., delay_steps: _Optional[int] = ..., late: _Optional[bool] = ..., state: _Optional[_Union[Control.State, str]] = ..., reason: _Optional[str] = ..., slope_rms: _Optional[float] = ..., path_rms: _Optional[float] = ..., clipped_steps: _Optional[int] = ..., acting: _Optional[str] = ...) -> None: ...
