from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class Run(_message.Message):
    __slots__ = ("first_step", "n_steps", "u")
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    N_STEPS_FIELD_NUMBER: _ClassVar[int]
    U_FIELD_NUMBER: _ClassVar[int]
    first_step: int
    n_steps: int
    u: bytes
    def __init__(self, first_step: _Optional[int] = ..., n_steps: _Optional[int] = ..., u: _Optional[bytes] = ...) -> None: ...
