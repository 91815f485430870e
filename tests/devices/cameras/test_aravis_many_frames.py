"""Ten thousand frames of a GigE camera, bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aolink.devices.cameras.pixel_formats import PIXEL_FORMATS
from aolink.devices.interfaces import Lacks
from tests.devices.cameras.gige import (
    expected,
    fast_rig,
    need_aravis,
    noise,
    numbers_of,
    opened,
    packed,
    started,
    taken,
)
from tests.devices.simulators.gige import FAKE, gige_camera

need_aravis()
FRAMES = 10_000


@pytest.mark.rare
def test_every_pixel_arrives_and_ids_go_on_where_16_bits_end(tmp_path: Path) -> None:
    """Straight from Aravis's fake camera, without a relay; it tells no time, and its ids end after 135 frames.

    It is asked for 1000 frames a second, its most; a busy machine gives 200.
    """
    pictures = noise(16, 16)
    with gige_camera(tmp_path, packed(pictures, PIXEL_FORMATS["Mono16"]), {}), opened(fast_rig(), FAKE) as camera:
        assert camera.description.startswith("Aravis Fake, serial number GV01, firmware 0.8.")
        assert camera.description.endswith(", Mono16 from 127.0.0.1 by Aravis")
        assert camera.lacks == (Lacks.TIME, Lacks.TRIGGER)
        assert camera.time_ns() is None
        frames = taken(started(camera), FRAMES)
    wrong = sum(int(np.count_nonzero(frame.pixels != expected(pictures, frame))) for frame in frames)
    numbers = numbers_of(frames)
    assert (len(frames) >= FRAMES, wrong) == (True, 0)
    assert (np.diff(numbers) >= 1).all()
    assert numbers[-1] - numbers[0] < 1.1 * len(frames)  # a machine that is held up drops packets
    assert numbers[0] <= 65535 < numbers[-1]
    assert all(frame.start_ns is None for frame in frames)
    assert not any(frame.pixels.flags.owndata for frame in frames)  # as Aravis has written them
