"""A line that fails in the middle of a session, with any serial mirror."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from aolink.errors import AolinkError
from aolink.session import Report
from tests.devices.mirrors import bench
from tests.devices.mirrors.serial_mirrors import MIRRORS, UNDER_WAY, with_each
from tests.devices.simulators.serial_device import Faults

Session = Callable[..., Path]


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
        assert bench.steps_ended(report) == report.steps_commanded > 0
        bench.check_ended(report, tmp_path / f"{name}.mcap")

    # The piezo's line is the aligner's, and has twice as many answers to wait for.
    with_each(check, MIRRORS.keys() - ({"thorlabs_piezo"} if faults.late_s else {}))
