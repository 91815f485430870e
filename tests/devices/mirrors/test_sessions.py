"""Sessions with any serial mirror, and what goes wrong on its line in the middle of one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import AolinkError
from aolink.recording.reader import Recording
from aolink.session import Report
from tests.devices.mirrors import bench
from tests.devices.mirrors.serial_mirrors import MIRRORS, PARK, UNDER_WAY, with_each
from tests.devices.simulators.serial_device import Faults

Session = Callable[..., Path]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "behaviour"), [*((name, {}) for name in MIRRORS), ("pi_gcs2", {"travel_s": 5 * bench.FAST_STEP_S})]
)
def test_a_session_is_recorded_and_estimated(name: str, behaviour: dict[str, float], session: Session) -> None:
    """Also with a stage that is never on its target in it: what it was told counts, its way there is the plant's."""
    with MIRRORS[name].make(**behaviour) as device:
        path = session(name, device, report := Report(), exposures=10)
        assert MIRRORS[name].is_parked(device)
    bench.check_session(report, path, MIRRORS[name].called)


@pytest.mark.slow
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
        assert (report.ended, report.commands.clipped) == ("complete", 0)
        assert report.commands.ended == report.commands.commanded
        recording = Recording(path)
        if faults.after_moves and "queues no inputs" in recording.metadata["mirror_lacks"]:
            assert report.commands.late > 0
        assert max(np.abs(each.inputs - PARK).max() for each in recording.exposures()) > 0.2

    with_each(check)


def test_a_mirror_whose_power_failed_for_a_moment_ends_the_session(session: Session, tmp_path: Path) -> None:
    """PI's axes are without servos then, so that nothing moves."""
    with MIRRORS["pi_gcs2"].make(faults=Faults(reset_at=4, after_moves=UNDER_WAY)) as device:
        with pytest.raises(AolinkError, match="servo off"):
            session("pi_gcs2", device, report := Report())
        assert not MIRRORS["pi_gcs2"].holds_the_safe_input(device)
    bench.check_ended(report, tmp_path / "pi_gcs2.mcap")


def test_an_optotune_driver_whose_power_failed_for_a_moment_goes_on_with_the_next_input(session: Session) -> None:
    """As far as is known: its manual does not say whether it wants another START."""
    with MIRRORS["optotune"].make(faults=Faults(reset_at=4, after_moves=UNDER_WAY)) as device:
        session("optotune", device, report := Report(), exposures=4)
        assert MIRRORS["optotune"].is_parked(device)
    assert report.ended == "complete"


@pytest.mark.slow  # in real time
def test_a_unit_whose_power_failed_for_a_moment_is_seen_not_to_follow(session: Session) -> None:
    """It ignores the host then, and is read back: the recording has what it held."""

    def check(name: str) -> None:
        with MIRRORS[name].make(faults=Faults(reset_at=4, after_moves=UNDER_WAY)) as device:
            path = session(name, device, report := Report(), exposures=8)
            rest = MIRRORS[name].inputs(np.array(device.now()))
        assert (report.ended, report.commands.clipped > 10) == ("complete", True)
        last = list(Recording(path).exposures())[-1]
        np.testing.assert_allclose(last.inputs, np.tile(rest, (len(last.inputs), 1)), atol=1e-3)

    with_each(check, ["thorlabs_aligner", "thorlabs_piezo"])


@pytest.mark.slow
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
        assert report.commands.ended == report.commands.commanded > 0
        bench.check_ended(report, tmp_path / f"{name}.mcap")

    # The piezo's line is the aligner's, and has twice as many answers to wait for.
    with_each(check, MIRRORS.keys() - ({"thorlabs_piezo"} if faults.late_s else {}))
