"""What the model says of a loop's stability, against loops that are followed, and against arithmetic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aolink.control import check_stable, stability
from aolink.errors import ControlError
from aolink.jobs.closed_loop import closed_loop
from aolink.rig import Rig
from tests.control.rigs import DRIFT, VIBRATION, small_rig


def instant(gain: float) -> Rig:
    """A mirror that follows at once, and the shortest delay: y(j+1) = u(j), but for one step of the forty."""
    rig = small_rig(control=f"gain = {gain}\nleak = 0.0\ndelay_s = 0.001")
    return replace(rig, plant=replace(rig.plant, A=np.array([[1e-9]]), B=np.array([[1 - 1e-9]])))


def test_the_integrator_is_stable_up_to_the_gain_that_arithmetic_gives() -> None:
    """y(j+1) = a u(j) + (1 - a) u(j-1) with a share a of the exposure, u(j) = u(j-1) - g y(j).

    z^2 - (1 - g a) z + g (1 - a) = 0 has a root at -1 for g = 2 / (2 a - 1): the mirror's one step and the delay's
    are two of the forty.
    """
    a = 38 / 40
    found = stability(instant(0.5), "integrator")
    assert np.isclose(found.gain_margin, 2 / (2 * a - 1) / 0.5, rtol=0.1)
    roots = np.roots([1, -(1 - 0.5 * a), 0.5 * (1 - a)])
    assert np.isclose(found.radius, np.abs(roots).max(), atol=0.02)


def test_the_margin_is_one_that_a_loop_really_has() -> None:
    """A loop whose mirror is stronger than believed by less than the margin is calm, and by more it is not."""
    rig = small_rig(DRIFT, control="gain = 0.6")
    margin = stability(rig, "integrator").gain_margin

    def last(factor: float) -> float:
        strong = replace(rig, control=replace(rig.control, gain=0.6 * factor))
        return float(np.abs([each.act.slope_rms for each in [*closed_loop(strong, "integrator", "", 60)][-10:]
                             if each.act is not None]).max())  # fmt: skip

    assert last(0.85 * margin) < 0.4
    assert last(1.2 * margin) > 0.5


def test_a_stable_loop_of_lqg_has_a_margin() -> None:
    found = stability(small_rig(VIBRATION), "lqg")
    assert found.stable
    assert found.gain_margin > 1.3


def test_an_unstable_loop_is_refused_with_its_margin() -> None:
    with pytest.raises(ControlError, match=r"the loop of integrator on small-loop is unstable: .* below 0\.\d+ times"):
        check_stable(small_rig(control="gain = 4.0"), "integrator")


def test_a_mirror_whose_safe_input_is_not_zero_is_judged_as_one_whose_is() -> None:
    plain, shifted = (stability(small_rig(mirror=text), "integrator") for text in ("", "park = 0.3"))
    assert np.isclose(plain.radius, shifted.radius, atol=0.03)
