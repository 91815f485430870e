from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aolink import simulate
from aolink.errors import ViewerError
from aolink.rig import load_rig
from aolink.viewing.timebase import Timebase

PERIOD, STEP_NS = 200, 1_000_000


def timebase(drift_ppm: float = 0.0) -> Timebase:
    starts = np.arange(50, dtype=np.int64) * PERIOD * STEP_NS
    return Timebase(
        fast_step_ns=STEP_NS, frame_period_steps=PERIOD, first_step=1000, frame_id=5, origin_ns=9_000_000_000,
        device_ns=9_000_000_000 + starts,
        host_ns=1_700_000_000_000_000_000 + starts - np.rint(starts * drift_ppm * 1e-6).astype(np.int64),
    )  # fmt: skip


def test_fast_steps_have_exact_device_times() -> None:
    assert timebase().device_of_step([1000, 1001, 900]).tolist() == [9_000_000_000, 9_001_000_000, 8_900_000_000]


def test_a_fast_step_belongs_to_the_newest_frame_that_had_begun() -> None:
    assert timebase().frame_of_step([999, 1000, 1199, 1200]).tolist() == [4, 5, 5, 6]


def test_host_times_follow_a_drifting_clock() -> None:
    base = timebase(drift_ppm=50)
    middle = (base.host_ns[20] + base.host_ns[21]) // 2
    assert base.device_of_host([middle])[0] == pytest.approx((base.device_ns[20] + base.device_ns[21]) // 2, abs=2)


def test_host_times_before_the_first_exposure_keep_its_offset() -> None:
    base = timebase(drift_ppm=50)
    assert base.device_of_host([base.host_ns[0] - 7_000])[0] == base.device_ns[0] - 7_000


def test_no_exposure_is_one_clear_error() -> None:
    with pytest.raises(ViewerError, match="no exposure"):
        Timebase.of(load_rig("section-vi"), [])


def test_it_keeps_the_newest_of_a_session_that_goes_on_for_long() -> None:
    (exposure,), base = simulate("section-vi", n_exposures=1, seed=1), timebase()
    for k in range(3000):
        later = replace(exposure, device_start_ns=10**12 + k * 10**6, host_start_ns=2 * 10**18 + k * 10**6)
        base = base.followed_by([later])
    assert len(base.device_ns) == len(base.host_ns) < 1500
    assert base.device_of_host([base.host_ns[-1] - 500_000])[0] == base.device_ns[-1] - 500_000
