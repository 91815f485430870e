"""What goes wrong on the line of any serial mirror in the middle of a session."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import AolinkError
from aolink.extensions import installed
from aolink.recording.reader import Recording
from aolink.session import Report, record
from tests.devices.mirrors import bench
from tests.devices.mirrors.serial_mirrors import MIRRORS, PARK, with_each
from tests.devices.simulators.serial_device import Faults, SerialDevice

UNDER_WAY = 25
"""Moves after which a session has recorded exposures of moving spots."""
Session = Callable[..., Path]


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Session]:
    """Records exposures with a mirror; gives the file."""
    bench.install(monkeypatch, tmp_path)

    def run(name: str, device: SerialDevice, report: Report, exposures: int = 0) -> Path:
        path = tmp_path / f"{name}.mcap"
        record(MIRRORS[name].rig(device), None, None, path, exposures=exposures, report=report)
        return path

    yield run
    installed.cache_clear()


def steps_ended(report: Report) -> int:
    return sum((report.steps_applied, report.steps_late, report.steps_superseded, report.steps_refused,
                report.steps_not_reported))  # fmt: skip


@pytest.mark.parametrize(
    "faults",
    [Faults(late_s=0.002, split=True), Faults(late_s=2.5 * bench.FAST_STEP_S, after_moves=10)],
    ids=["late and split", "later than fast steps"],
)
def test_answers_that_are_late_or_come_in_pieces_are_borne(faults: Faults, session: Session) -> None:
    """Where each input takes the line longer than a fast step, steps are late and the recording says which."""

    def check(name: str) -> None:
        with MIRRORS[name].make(faults=faults) as device:
            path = session(name, device, report := Report(), exposures=4)
            assert MIRRORS[name].is_parked(device)
        assert (report.ended, report.steps_clipped) == ("complete", 0)
        assert steps_ended(report) == report.steps_commanded
        recording = Recording(path)
        if faults.after_moves and "queues no inputs" in recording.metadata["mirror_lacks"]:
            assert report.steps_late > 0
        assert max(np.abs(each.inputs - PARK).max() for each in recording.exposures()) > 0.2

    with_each(check)


@pytest.mark.parametrize(
    ("faults", "what"),
    [
        (Faults(garbled=frozenset({0}), after_moves=UNDER_WAY), "cable good|is no message|line loses bytes"),
        (Faults(refused=frozenset({1}), after_moves=UNDER_WAY), "with 'NO'|its error 53|an error .* code 7"),
        (Faults(unplugged_at=5, after_moves=UNDER_WAY), r"lost /dev/pts/\d+: .*is the device still there\?"),
        (Faults(silent_from=5, after_moves=UNDER_WAY), "does not answer .*nothing came: is it switched on"),
        (Faults(late_s=1.3, after_moves=UNDER_WAY), "does not answer .*came: is it switched on"),
    ],
    ids=["garbled", "refused", "unplugged", "silent", "too late"],
)
def test_a_line_that_fails_ends_the_session_with_the_mirror_parked_where_it_hears(
    faults: Faults, what: str, session: Session, tmp_path: Path
) -> None:
    """A line that is late by more than the driver waits is one that does not answer."""

    def check(name: str) -> None:
        with MIRRORS[name].make(faults=faults) as device:
            with pytest.raises(AolinkError, match=what) as raised:
                session(name, device, report := Report())
            assert "\n" not in str(raised.value)
            assert "lost" in what or MIRRORS[name].is_parked(device)
        assert steps_ended(report) == report.steps_commanded > 0
        bench.check_ended(report, tmp_path / f"{name}.mcap")

    with_each(check, MIRRORS.keys() - ({"playzerx"} if faults.refused else {}))  # which acknowledges nothing


def test_a_mirror_whose_power_failed_for_a_moment_ends_the_session(session: Session, tmp_path: Path) -> None:
    """It is as it was switched on: PI's axes without servos, the PlayzerX with its analog input."""

    def check(name: str) -> None:
        what = r"its error 5 \(an axis has its servo off|off by .*samples a second as it was told to"
        with MIRRORS[name].make(faults=Faults(reset_at=4, after_moves=UNDER_WAY)) as device:
            with pytest.raises(AolinkError, match=what):
                session(name, device, report := Report())
            if name == "playzerx":
                assert MIRRORS[name].is_parked(device)
            else:  # without servos nothing moves
                assert not MIRRORS[name].holds_the_safe_input(device)
        bench.check_ended(report, tmp_path / f"{name}.mcap")

    with_each(check, ["pi_gcs2", "playzerx"])


def test_an_optotune_driver_whose_power_failed_for_a_moment_goes_on_with_the_next_input(session: Session) -> None:
    """As far as is known: its manual does not say whether it wants another START."""
    with MIRRORS["optotune"].make(faults=Faults(reset_at=4, after_moves=UNDER_WAY)) as device:
        session("optotune", device, report := Report(), exposures=4)
        assert MIRRORS["optotune"].is_parked(device)
    assert report.ended == "complete"


def test_a_unit_whose_power_failed_for_a_moment_is_seen_not_to_follow(session: Session) -> None:
    """It ignores the host then, and is read back: the recording has what it held."""

    def check(name: str) -> None:
        with MIRRORS[name].make(faults=Faults(reset_at=4, after_moves=UNDER_WAY)) as device:
            path = session(name, device, report := Report(), exposures=8)
            rest = MIRRORS[name].inputs(np.array(device.now()))
        assert (report.ended, report.steps_clipped > 10) == ("complete", True)
        last = list(Recording(path).exposures())[-1]
        np.testing.assert_allclose(last.inputs, np.tile(rest, (len(last.inputs), 1)), atol=1e-3)

    with_each(check, ["thorlabs_aligner", "thorlabs_piezo"])
