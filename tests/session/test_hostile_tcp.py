"""The table of lies once more where a stranger is most likely: over TCP, and by the clock on the wall."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from aolink.rig import load_rig, parse_rig
from aolink.wire import messages_pb2 as pb
from tests.hostile import changed
from tests.session.test_hostile import CAMERA, MIRROR, assert_caught, says

RIG = parse_rig(load_rig("section-vi-lively").toml.replace("exposure_steps = 200", "exposure_steps = 50"))
"""With four times as many frames, which a test waits for."""
IN_REAL_TIME = [("mirror", *each) for each in MIRROR if each[0] is not pb.VirtualTime]
"""There `VirtualTime` changes nothing."""
LIES = [*IN_REAL_TIME, *(("camera", *each) for each in CAMERA)]
AT_ONCE = 8
"""Sessions, which wait most of the time."""


@pytest.mark.slow
@pytest.mark.parametrize("part", range(3))
def test_a_device_that_lies_ends_the_session_with_the_field(tmp_path: Path, part: int) -> None:
    def told(number: int) -> None:
        line, kind, field, value = LIES[number]
        named = {"offset": "data", "first_step": "last_step"}.get(field, field) if line == "camera" else field
        (folder := tmp_path / str(number)).mkdir()
        assert_caught(
            folder, {line: changed(kind, says(field, value), 2)}, rf"{kind.__name__}\.{named}",
            rig=RIG, exposures=100, real_time=True, tcp=True,
        )  # fmt: skip

    with ThreadPoolExecutor(AT_ONCE) as pool:
        results = {number: pool.submit(told, number) for number in range(part, len(LIES), 3)}
    failed = {LIES[number][1:]: error for number, each in results.items() if (error := each.exception())}
    assert not failed
