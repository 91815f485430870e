"""Whole sessions with a GigE camera: recorded, estimated and replayed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aolink import estimate, simulate
from aolink.devices.cameras.pixel_formats import PIXEL_FORMATS
from aolink.devices.interfaces import Lacks
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.recording.schemas_pb2 import ConnectionStatistics, ExposureInfo
from aolink.session import record
from aolink.session.replay import replay
from tests.devices.cameras.gige import PICTURES, codes, lenslet, need_aravis, packed
from tests.devices.simulators.gige import FAKE, RELAY, Faults, gige_camera
from tests.kinds import messages_of, truth_of

need_aravis()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("address", "keys", "lacks"),
    [
        (RELAY, {}, Lacks.TRIGGER),
        (RELAY, {"trigger": '"hardware:Line1"'}, ""),
        (FAKE, {}, f"{Lacks.TIME}; {Lacks.TRIGGER}"),
    ],
    ids=["clock", "trigger", "no clock"],
)
def test_a_session_is_recorded_estimated_and_replayed(
    tmp_path: Path, address: str, keys: dict[str, str], lacks: str
) -> None:
    """The pictures are the simulated plant's, rendered ahead; the relay drops packets, so that some frames have holes.

    The camera's clock is latched, or the arrival of its frames stands for their time.
    """
    rig = lenslet(address, packet_size=136, resend="false", **keys)
    rig = replace(rig, mirror=replace(rig.mirror, watchdog_s=10.0))  # a busy machine may hold a session up for long
    truth = simulate(rig, PICTURES, seed=4)
    frames = packed(np.array([each.pixels for each in truth]), PIXEL_FORMATS["Mono12p"])
    with gige_camera(tmp_path, frames, codes("Mono12p"), Faults(loss=0.05, seed=1, edges_hz=10.0, clock_fast=60e-6)):
        report = record(rig, None, None, tmp_path / "a.mcap", estimators=["o3"], exposures=12)
    assert (report.ended, report.commands.commanded, report.estimation["o3"].failed) == ("complete", 0, "")
    recording = Recording(tmp_path / "a.mcap")
    assert recording.metadata["camera"].startswith("Aravis Fake, serial number GV01")
    assert recording.metadata["camera_lacks"] == lacks
    counted = messages_of(ConnectionStatistics, recording, topics.CONNECTION)[-1]
    chunks_lost = sum(each.chunks_lost for each in messages_of(ExposureInfo, recording, topics.EXPOSURE))
    assert (counted.device, report.connection_faults["sequence_gaps"]) == ("camera", counted.sequence_gaps)
    assert counted.sequence_gaps >= chunks_lost

    exposures, estimates = list(recording.exposures()), estimate(recording, "o3").estimates("o3")
    errors = []
    for exposure, found in zip(exposures, estimates, strict=True):
        rendered = next(each for each in truth if np.array_equal(each.pixels * exposure.mask, exposure.pixels))
        errors.append((found.path - truth_of(rendered).path) / found.path_sd)
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 2
    for (_, (again,)), found in zip(replay(recording, ["o3"]), estimates, strict=True):
        assert np.array_equal(again.path, found.path)
