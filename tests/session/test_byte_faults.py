"""Sessions over lines that damage bytes, on virtual time: nothing wrong is recorded, and the same seed is the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aolink.recording.reader import Recording
from aolink.rig import Faults, load_rig, with_faults
from aolink.session import Report, record
from tests.commands import simulated_rig

RIG = load_rig("section-vi")
LINE = [
    "bitflip=1e-4", "lost=2e-4", "repeated=2e-4", "inserted=2e-4", "burst=1e-4", "stall=0.01", "jitter_s=1e-3",
    "delay_to_host_s=2e-3",
]  # fmt: skip


def session(path: Path, faults: list[str], exposures: int) -> Report:
    options = [word for fault in faults for word in ("--fault", fault)]
    with simulated_rig("section-vi", *options) as ports:
        return record(RIG, *ports, path, exposures=exposures)


@pytest.mark.slow
def test_damaged_bytes_change_no_pixel_and_no_command_and_are_the_same_again(tmp_path: Path) -> None:
    reports = [session(tmp_path / name, LINE, 40) for name in ("a", "b")]
    session(tmp_path / "good", [], 40)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    report = reports[0]
    assert report.ended == "complete"
    assert report.blocks_retransmitted > 0
    assert report.commands.commanded == report.commands.applied + report.commands.not_reported == 8000
    good = {exposure.first_step: exposure for exposure in Recording(tmp_path / "good").exposures()}
    exposures = list(Recording(tmp_path / "a").exposures())
    assert 0 < len(exposures) < 40
    shift = exposures[0].first_step - 200 * (exposures[0].frame_id - 1)
    for each in exposures:
        true = good[each.first_step - shift + min(good)]
        assert np.array_equal(each.pixels[each.mask], true.pixels[each.mask])
        assert each.inputs_assumed or np.array_equal(each.inputs, true.inputs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "shows"),
    [
        ("late=0.2", lambda report, exposures: 0 < report.commands.late < 2000),
        ("missing=0.3", lambda report, exposures: 0 < len(exposures) < 20),
        ("saturated=0.01", lambda report, exposures: any((each.pixels == 65535).any() for each in exposures)),
        ("dark=1", lambda report, exposures: max(abs(each.pixels.mean() - 20_000) for each in exposures) < 1500),
    ],
)
def test_faults_of_the_devices_show(tmp_path: Path, fault: str, shows: object) -> None:
    report = session(tmp_path / "a", [fault], 20)
    assert report.ended == "complete"
    assert callable(shows)
    assert shows(report, list(Recording(tmp_path / "a").exposures())), report


def test_a_clock_that_is_set_shows_as_uncertain(tmp_path: Path) -> None:
    report = session(tmp_path / "a", ["clock_step_s=0.05", "clock_step_at_s=3"], 40)
    assert report.ended == "complete"
    assert any("clock was set forward by 0.05" in warning for warning in report.warnings)
    assert max(each.clock_sigma_ns for each in Recording(tmp_path / "a").exposures()) > 40e6


def test_faults_by_name() -> None:
    assert with_faults(Faults(dark_rate=0.1), ["bitflip=1e-6", "jitter_s=0.1"]) == replace(
        Faults(dark_rate=0.1), bit_error_rate=1e-6, jitter_s=0.1
    )
