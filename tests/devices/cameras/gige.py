"""What the tests of GigE cameras share: rigs, pictures and their bytes, frames taken for a while."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.devices.cameras.aravis import AravisCamera
from aolink.devices.cameras.pixel_formats import PIXEL_FORMATS, PixelFormat
from aolink.devices.simple import SimpleFrame
from aolink.rig import Rig, load_rig, parse_rig
from tests.devices.simulators.gige import FIRST_ID, LIBRARY, RELAY
from tests.needs import missing

PICTURES = 64
LONGEST_S = 60.0
"""How long a test waits for frames, at most, and 20 ms for each frame."""


def need_aravis() -> None:
    """Skip the module where Aravis is missing; in CI it must not be."""
    try:
        ctypes.CDLL(LIBRARY)
    except OSError as error:
        missing("Aravis (Debian: libaravis-0.8-0)", error)


def fast_rig(bits: int = 16, size: int = 16, period_steps: int = 10) -> Rig:
    """Exposures of 0.5 ms, as small a picture as is wanted, a frame every 0.1 ms times ``period_steps``."""
    changes = {
        "fast_step_s = 0.001": "fast_step_s = 0.0001",
        "exposure_steps = 200": f"exposure_steps = 5\nframe_period_steps = {period_steps}",
        "bit_depth = 12": f"bit_depth = {bits}",
        "window = [16, 16]": f"window = [{size}, {size}]",
        "black_level = 400": "black_level = 10",
    }
    return changed(load_rig("single-lenslet").toml, changes)


def changed(toml: str, changes: dict[str, str]) -> Rig:
    for before, after in changes.items():
        assert before in toml
        toml = toml.replace(before, after)
    return parse_rig(toml)


def noise(bits: int, size: int) -> NDArray[np.uint16]:
    """Pictures of which every bit counts, (PICTURES, size, size)."""
    return np.random.default_rng(1).integers(0, 1 << bits, (PICTURES, size, size), dtype=np.uint16)


def packed(counts: NDArray[np.uint16], pixel_format: PixelFormat) -> NDArray[np.uint8]:
    """The bytes of pictures (pictures, rows, columns), (pictures, bytes): pixel k stands at bit k times its bits."""
    numbers = (sum(int(n) << k * pixel_format.stored_bits for k, n in enumerate(each.ravel())) for each in counts)
    size = pixel_format.size(counts[0].size)
    return np.array([np.frombuffer(number.to_bytes(size, "little"), np.uint8) for number in numbers])


def codes(*names: str) -> dict[str, int]:
    return {name: PIXEL_FORMATS[name].code for name in names}


@contextmanager
def opened(rig: Rig, address: str = RELAY, **keys: Any) -> Iterator[AravisCamera]:
    """A camera, closed in the end."""
    camera = AravisCamera(rig, address=address, **keys)
    try:
        yield camera
    finally:
        camera.close()


def taken(camera: AravisCamera, n_frames: int) -> list[SimpleFrame]:
    """So many frames, or those that come in a long time."""
    frames: list[SimpleFrame] = []
    until_s = time.monotonic() + LONGEST_S + 0.02 * n_frames
    while len(frames) < n_frames and time.monotonic() < until_s:
        frames += camera.frames()
        time.sleep(0.002)  # as a session, which leaves the processor to others between two calls
    return frames


def started(camera: AravisCamera) -> AravisCamera:
    now_ns = camera.time_ns()
    camera.start(time.monotonic_ns() if now_ns is None else now_ns, 0)
    return camera


def numbers_of(frames: list[SimpleFrame]) -> NDArray[np.int64]:
    return np.array([frame.number for frame in frames], dtype=np.int64)


def expected(pictures: NDArray[np.uint16], frame: SimpleFrame) -> NDArray[np.uint16]:
    """The picture that was sent with the number of this frame, with zeros where nothing arrived."""
    assert frame.number is not None
    picture: NDArray[np.uint16] = pictures[(frame.number - FIRST_ID) % 65535 % PICTURES]
    return picture if frame.mask is None else picture * frame.mask


def lenslet(address: str = RELAY, **keys: object) -> Rig:
    """A rig with nothing but a GigE camera of 12 bits: a spot moves by itself, 10 exposures a second of 40 ms."""
    toml = load_rig("single-lenslet").toml
    drive = toml[toml.index("[drive]") : toml.index("[simulation]")]
    changes = {
        "exposure_steps = 200": "exposure_steps = 40\nframe_period_steps = 100",
        drive: '[drive]\nkind = "none"\n\n',
        "[simulation]": "\n".join(
            [
                '[devices.camera]\ndriver = "aravis"',
                f'address = "{address}"\nstamp_at = "end"',
                *(f"{key} = {value}" for key, value in keys.items()),
                "\n[simulation]",
            ]
        ),
    }
    return changed(toml, changes)
