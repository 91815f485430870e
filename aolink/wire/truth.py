"""The wire's form of an exposure's true states and path."""

from __future__ import annotations

from aolink.exposure import Truth
from aolink.wire import messages_pb2 as pb

_LARGEST_PATH = 65_536
"""Numbers in a truth's path, beyond which single precision must do."""


def truth_message(frame_id: int, truth: Truth) -> pb.Truth:
    """The wire's form of a `Truth`."""
    message = pb.Truth(
        frame_id=frame_id, axes=truth.start_state.shape[0], n_outputs=truth.path.shape[0],
        start_state=truth.start_state.ravel(), end_state=truth.end_state.ravel(),
    )  # fmt: skip
    small = truth.path.size <= _LARGEST_PATH
    (message.path if small else message.path_single).extend(truth.path.ravel().tolist())
    return message
