"""What the tests of camera drivers share: simulated pictures as files, and a session that records a camera alone."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from aolink import estimate, simulate
from aolink.estimation import Status
from aolink.exposure import Exposure
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig, parse_rig
from aolink.session import Report, record

EXPOSURE_STEPS = 40
"""Fast steps of an exposure, of a millisecond each; frame after frame, so that a session is short."""
BITS_8 = {"bit_depth": (16, 8), "black_level": (20000, 60), "counts_per_density": (2000, 5)}
"""The rig's sensor with 8 bits."""


def rig_of(camera: str, folder: Path, **changes: tuple[object, object]) -> Rig:
    """The paper's rig with short exposures, a table ``[devices.camera]``, and changed keys."""
    text = load_rig("section-vi").toml
    for key, (old, new) in {"exposure_steps": (200, EXPOSURE_STEPS), **changes}.items():
        assert f"{key} = {old}" in text
        text = text.replace(f"{key} = {old}", f"{key} = {new}")
    return parse_rig(f"{text}\n[devices.camera]\n{camera}\n", folder)


@cache
def pictures(count: int, bits: int = 16) -> list[NDArray[np.uint16]]:
    """What the rig's camera sees while nothing is commanded, no two alike."""
    rig = rig_of('driver = "folder"', Path(), **(BITS_8 if bits == 8 else {}))
    return [exposure.pixels for exposure in simulate(rig, n_exposures=count, seed=1)]


def save(folder: Path, shown: Sequence[NDArray[np.uint16]]) -> Path:
    """Pictures as PNG files of 16 bits, in the order of their names."""
    folder.mkdir(exist_ok=True)
    for number, picture in enumerate(shown):
        Image.fromarray(picture).save(folder / f"{number:03}.png")
    return folder


def recorded(
    rig: Rig, path: Path, exposures: int, estimators: Sequence[str] = ()
) -> tuple[Report, Recording, list[Exposure]]:
    """Record the rig file's camera alone, with estimators beside it; read it back, and estimate it."""
    report = record(rig, None, None, path, estimators=estimators, exposures=exposures)
    recording = Recording(path)
    found = list(recording.exposures())
    again = estimate(path, "o3").estimates("o3")
    assert [each.frame_id for each in again] == [each.frame_id for each in found]
    assert all(each.status == Status.OK for each in again)
    assert recording.metadata["mirror"] == "none"
    assert all((each.inputs == rig.mirror.park).all() for each in found)
    return report, recording, found


def shown_in(exposures: Sequence[Exposure], shown: Sequence[NDArray[np.uint16]]) -> list[int]:
    """Which of the pictures each exposure has, bit for bit."""
    return [next(k for k, each in enumerate(shown) if np.array_equal(each, found.pixels)) for found in exposures]


def counted(exposures: Sequence[Exposure], shown: Sequence[NDArray[np.uint16]]) -> list[int]:
    """The same, where the camera shows them over and over and counts them: a lost one leaves a gap in the numbers."""
    order = shown_in(exposures, shown)
    assert order == [(order[0] + each.frame_id - exposures[0].frame_id) % len(shown) for each in exposures]
    return order
