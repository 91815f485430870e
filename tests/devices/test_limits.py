"""The limits of what a mirror is sent, and how it goes to what is wanted after it was parked or left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aolink.devices.limits import CommandLimits
from aolink.errors import DeviceError
from aolink.rig import load_rig

RIG = load_rig("section-vi")
MOST = 0.001
SLOW = replace(RIG, mirror=replace(RIG.mirror, slew_max_per_s=MOST / RIG.timing.fast_step_s))


def rows(*values: float) -> np.ndarray:
    return np.array(values)[:, None]


def test_a_parked_mirror_goes_to_what_is_wanted_as_fast_as_it_may_and_then_a_jump_is_refused() -> None:
    limits = CommandLimits(SLOW)
    limits.take(0, rows(0.001, 0.002, 0.003))
    limits.parked()
    np.testing.assert_allclose(limits.take(50, rows(0.003, 0.003)), rows(0.001, 0.002))
    np.testing.assert_allclose(limits.take(52, rows(0.003, 0.003)), rows(0.003, 0.003))
    with pytest.raises(DeviceError, match=r"changes by 0.002 to fast step 54, more than mirror.slew_max_per_s"):
        limits.take(54, rows(0.005))


def test_what_replaces_steps_of_the_way_there_goes_on_from_the_step_before_them() -> None:
    """A block ends at what was wanted, and another one takes the place of its second half."""
    limits = CommandLimits(SLOW)
    limits.parked()
    limits.take(50, rows(*[0.003] * 6))
    np.testing.assert_allclose(limits.take(51, rows(*[0.0035] * 4)), rows(0.002, 0.003, 0.0035, 0.0035))
    np.testing.assert_allclose(limits.take(54, rows(0.004)), rows(0.004))


def test_steps_that_were_left_out_hold_what_they_were_sent_before_or_the_safe_input() -> None:
    limits = CommandLimits(SLOW)
    limits.take(10, rows(0.001, 0.002, 0.003))
    np.testing.assert_array_equal(limits.go_on_from(11, 15), rows(0.002, 0.003, 0.0, 0.0))
    np.testing.assert_allclose(limits.take(15, rows(0.003, 0.003)), rows(0.001, 0.002))
    # While something is queued for the step before, the way goes on from that.
    np.testing.assert_array_equal(limits.go_on_from(11, 13), rows(0.002, 0.003))
    np.testing.assert_allclose(limits.take(13, rows(0.009, 0.0)), rows(0.004, 0.003))


def test_without_a_slew_limit_everything_within_the_limits_is_sent_as_it_is() -> None:
    limits = CommandLimits(RIG)
    limits.parked()
    wanted = rows(*RIG.mirror.input_max, *RIG.mirror.input_min)
    assert limits.take(0, wanted) is wanted
