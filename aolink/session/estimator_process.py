"""The process of one estimator of a session in real time: it gets exposures and sends estimates over a socket.

It is a process because estimators hold the interpreter's lock, and a loop that shares the lock with them waits for
them. There is one for each estimator because a slow one must not hold up a fast one. `aolink.session.estimating` starts
it and is at the other end of the socket.
"""

from __future__ import annotations

import contextlib
import gc
import pickle
import socket
import struct
import time
from typing import Any

import numpy as np

from aolink.errors import AolinkError
from aolink.estimation import make_estimator
from aolink.exposure import Exposure
from aolink.recording import convert
from aolink.rig import Rig

LENGTH = struct.Struct("<Q")
"""Each message on the socket is a pickle behind its length."""
NICENESS = 5
"""Niceness of an estimator that nothing waits for: where all cores are busy, the loop, the devices' drivers, the disk
and the estimator that closes the loop come first."""


READY = None
"""The first message; then, for each exposure, the bytes of its estimate's message and the time that it took, ns. A text
instead gives the reason why there will be no more."""


def packed(message: object) -> bytes:
    """The bytes of a message on the socket."""
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    return LENGTH.pack(len(data)) + data


def main(fileno: int) -> None:
    """Estimate the exposures that come over the socket until it is closed."""
    with socket.socket(fileno=fileno) as connection, connection.makefile("rb") as stream:
        try:
            _serve(connection, stream)
        except (EOFError, ConnectionError):  # the session is over
            return
        except Exception as error:
            with contextlib.suppress(ConnectionError):
                connection.sendall(packed(str(error) if isinstance(error, AolinkError) else repr(error)))


def _serve(connection: socket.socket, stream: Any) -> None:
    rig, name = _received(stream)
    # An estimator computes or loads some things once for a rig; a session must not wait for them.
    make_estimator(rig, name).step(_dark(rig))
    estimator = make_estimator(rig, name)
    gc.collect()
    gc.freeze()  # later collections leave out all that exists by now
    connection.sendall(packed(READY))
    while True:
        exposure: Exposure = _received(stream)
        start_ns = time.monotonic_ns()
        data = convert.estimate_message(estimator.step(exposure)).SerializeToString()
        connection.sendall(packed((data, time.monotonic_ns() - start_ns)))


def _received(stream: Any) -> Any:
    """The next message. Raises EOFError when the socket is closed."""
    header = stream.read(LENGTH.size)
    if len(header) < LENGTH.size:
        raise EOFError
    return pickle.loads(stream.read(*LENGTH.unpack(header)))


def _dark(rig: Rig) -> Exposure:
    steps, shape = rig.window_steps, rig.sensor.shape
    return Exposure(
        frame_id=0, first_step=0, n_steps=steps, pixels=np.zeros(shape, dtype=np.uint16),
        mask=np.ones(shape, dtype=bool), inputs=np.zeros((steps, rig.n_inputs)),
        lead_inputs=np.zeros((0, rig.n_inputs)), start_offset=rig.timing.exposure_offset,
    )  # fmt: skip
