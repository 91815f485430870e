"""Ways out of a session, as the benchmark `time_to_park` measures them: the mirror is parked, by its own clock."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from aolink.rig import load_rig
from tests.session.conftest import Ports

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from bench_rows.parking import RIG, WAYS, parked_after_s

BY_NAME = {way.name: way for way in WAYS}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGKILL of the host", "the host is stopped (SIGSTOP)"])
def test_a_mirror_whose_host_is_gone_is_parked_within_its_watchdog(serve: Ports, name: str) -> None:
    """The host sends nothing any more, so that only the device counts the time."""
    with serve() as ports:
        assert parked_after_s(BY_NAME[name], *ports) <= load_rig(RIG).mirror.watchdog_s


@pytest.mark.slow
def test_a_host_that_fails_parks_the_mirror(serve: Ports) -> None:
    with serve() as ports:
        assert parked_after_s(BY_NAME["an exception"], *ports) == pytest.approx(0.0, abs=2.0)  # a number: it is parked
