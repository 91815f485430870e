"""The loop without a wire: its delay, its limits, and what it does when the spot is lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aolink.control import ControllerRow, ControlLoop, Seen, State, find_controller
from aolink.control.loop import BLIND_EXPOSURES, TRUSTED_EXPOSURES, centroids
from aolink.errors import ControlError
from aolink.estimation import Status, make_estimator
from aolink.exposure import Exposure
from aolink.jobs.closed_loop import Closed, closed_loop
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig
from aolink.simulation.model import simulate
from tests.control.rigs import DRIFT, VIBRATION, small_rig
from tests.simulation.rolling import rolling


def residual(series: list[Closed]) -> float:
    """Root mean square of the true slopes at the fast rate, once the loop has settled."""
    truths = [each.exposure.truth for each in series[10:]]
    return float(np.sqrt(np.mean([truth.path**2 for truth in truths if truth is not None])))


def run(rig: Rig, controller: str, estimator: str = "", exposures: int = 60) -> list[Closed]:
    return list(closed_loop(rig, controller, estimator, exposures))


def test_the_integrator_takes_off_what_is_slow() -> None:
    rig = small_rig(DRIFT)
    assert residual(run(rig, "integrator")) < 0.6 * residual(run(rig, ""))


def test_a_controller_may_be_given_by_its_row() -> None:
    """As one that is not installed is."""
    rig = small_rig(DRIFT)
    row = ControllerRow(name="mine", summary="", build=find_controller("integrator", rig).build, needs_state=False)
    ours = list(closed_loop(rig, row, "", 12))
    assert residual(ours) == residual(run(rig, "integrator", exposures=12))
    assert ours[-1].act is not None
    assert ours[-1].act.acting == "mine"


def test_lqg_takes_off_a_vibration_that_the_integrator_makes_worse() -> None:
    """At 0.6 of the frame rate a centroid comes too late for an integrator; the model knows what comes next."""
    rig = small_rig(VIBRATION)
    still = residual(run(rig, ""))
    assert residual(run(rig, "integrator")) > still
    assert residual(run(rig, "lqg", "o1")) < 0.5 * still


def test_an_exposure_changes_nothing_before_its_delay_is_over() -> None:
    rig = small_rig(DRIFT, control="delay_s = 0.012")
    (exposure,) = simulate(rig, 1)
    loop = ControlLoop(rig, "integrator")
    before = loop.inputs(0, 80)
    act = loop.see(exposure, None, earliest_step=40)
    assert (act.first_step, act.delay_steps, act.late) == (52, 12, False)
    after = loop.inputs(40, 40)
    assert np.array_equal(after[:12], before[40:52])
    assert (after[12:] != before[52:]).all()


def test_what_is_queued_and_due_stays_and_the_rest_is_changed() -> None:
    """An estimate that comes late changes the inputs from the first step that can still be changed."""
    rig = small_rig(DRIFT, control="delay_s = 0.002")
    (exposure,) = simulate(rig, 1)
    loop = ControlLoop(rig, "integrator")
    loop.inputs(0, 100)
    act = loop.see(exposure, None, earliest_step=75)
    assert (act.first_step, act.delay_steps, act.late) == (75, 35, True)
    u = loop.inputs(0, 100)
    assert not u[:75].any()
    assert u[75:].all()


def test_the_loop_goes_on_from_what_the_mirror_was_sent() -> None:
    """A mirror that was parked is on its way: what it was sent is not what the loop had meant."""
    rig = small_rig(DRIFT, mirror="slew_max_per_s = 1.0")
    loop = ControlLoop(rig, "integrator")
    (exposure,) = simulate(rig, 1)
    loop.inputs(0, 60)
    loop.see(seen_at(exposure, -0.8), None, earliest_step=60)
    assert loop.inputs(60, 60)[-1] > 0.04
    sent = np.array([[0.001], [0.002], [0.003], [0.004], [0.005]])
    loop.commanded(110, sent)
    loop.see(seen_at(replace(exposure, first_step=60), -0.8), None, earliest_step=115)
    np.testing.assert_array_equal(loop.inputs(110, 5), sent)
    np.testing.assert_allclose(loop.inputs(115, 1), [[0.006]])


def test_nothing_beyond_limits_and_slew_is_given_and_nothing_winds_up() -> None:
    """A spot that stays beyond the mirror's reach for a while must not keep it at its limit afterwards."""
    rig = small_rig(control="gain = 0.8\nleak = 0.0", mirror="slew_max_per_s = 20.0")
    rig = replace(rig, mirror=replace(rig.mirror, input_max=np.array([0.2])))
    loop, step, inputs = ControlLoop(rig, "integrator"), 0, []
    for number, exposure in enumerate(simulate(rig, 40)):
        slope = -0.6 if number < 20 else 0.1
        inputs.append(loop.inputs(step, exposure.first_step + 40 - step))
        step = exposure.first_step + 40
        loop.see(seen_at(exposure, slope), None, step)
    u = np.concatenate(inputs)[:, 0]
    assert u.max() == 0.2
    assert np.abs(np.diff(u)).max() <= 0.02 + 1e-12
    # It left its limit with the first exposure that asked for it.
    left = np.flatnonzero((u[:-1] == 0.2) & (u[1:] < 0.2))[0]
    assert 21 * 40 <= left <= 21 * 40 + 12


def seen_at(exposure: Exposure, slope: float) -> Exposure:
    """An exposure whose centroid was measured elsewhere."""
    return replace(exposure, slopes=np.array([slope]))


def dark(exposure: Exposure) -> Exposure:
    return replace(exposure, pixels=np.full_like(exposure.pixels, 5000))


@pytest.mark.parametrize(("when_lost", "state"), [("hold", State.HELD), ("park", State.PARKED)])
def test_light_lost_opens_the_loop_after_a_while_and_light_closes_it_again(when_lost: str, state: State) -> None:
    rig = small_rig(DRIFT, control=f'when_lost = "{when_lost}"')
    exposures = simulate(rig, 24)
    loop, step, acts, inputs = ControlLoop(rig, "lqg"), 0, [], []
    estimator = make_estimator(rig, "o1")
    gone = range(6, 6 + BLIND_EXPOSURES + 4)
    for number, exposure in enumerate(exposures):
        shown = dark(exposure) if number in gone else exposure
        inputs.append(loop.inputs(step, exposure.first_step + 40 - step))
        step = exposure.first_step + 40
        acts.append(loop.see(shown, estimator.step(shown), step))
    lost, back = gone.start + BLIND_EXPOSURES, gone.stop + TRUSTED_EXPOSURES - 1
    assert {act.state for act in acts[:lost]} == {State.CLOSED}
    assert {act.state for act in acts[lost:back]} == {state}
    assert {act.state for act in acts[back:]} == {State.CLOSED}
    assert "gave no measurement" in acts[lost].reason
    assert np.isnan(acts[lost].slope_rms)
    held = np.concatenate(inputs[lost + 2 : back])
    assert (held == held[0]).all()
    assert (held == 0).all() == (when_lost == "park")


@pytest.mark.parametrize("status", [Status.DIVERGED, Status.REINITIALISED])
def test_an_estimator_that_has_lost_itself_opens_the_loop_at_once(status: Status) -> None:
    rig = small_rig(DRIFT)
    exposures = simulate(rig, 8)
    loop, estimator, acts = ControlLoop(rig, "lqg"), make_estimator(rig, "o1"), []
    for number, exposure in enumerate(exposures):
        estimate = estimator.step(exposure)
        if number == 3:
            estimate = replace(estimate, status=status)
        acts.append(loop.see(exposure, estimate, exposure.first_step + 40))
    assert [act.state for act in acts] == [0, 0, 0, 1, 1, 1, 0, 0]
    assert acts[3].reason == f"the estimator is {status.name.lower()} at frame 4"


def test_without_any_exposure_the_prediction_runs_on_and_then_the_mirror_holds() -> None:
    """Frames lost, or an estimator that is too late."""
    rig = small_rig(VIBRATION)
    loop, estimator = ControlLoop(rig, "lqg"), make_estimator(rig, "o1")
    for exposure in simulate(rig, 5):
        loop.see(exposure, estimator.step(exposure), exposure.first_step + 40)
    u = loop.inputs(200, 800)[:, 0]
    patience = (BLIND_EXPOSURES + 1) * 40 + loop.delay_steps
    predicted, then = u[:patience], u[patience + 1 :]
    assert np.ptp(predicted) > 0.05  # it swings on with the vibration
    assert (then == then[0]).all()
    (late,) = simulate(rig, 1)
    late = replace(late, first_step=800, frame_id=21)
    act = loop.see(late, estimator.step(late), 1000)
    assert act.state is State.HELD
    assert "no measurement had come for" in act.reason


def test_before_the_first_exposure_the_mirror_holds_its_safe_input() -> None:
    rig = small_rig(mirror="park = 0.25")
    assert (ControlLoop(rig, "integrator").inputs(0, 60) == 0.25).all()


def test_centroids_are_those_of_the_frame() -> None:
    rig = small_rig(DRIFT)
    for exposure in simulate(rig, 4):
        assert exposure.truth is not None
        assert abs(centroids(rig, exposure)[0] - exposure.truth.path.mean()) < 0.02
        assert np.isnan(centroids(rig, dark(exposure))).all()


def test_a_controller_that_does_not_exist_is_named_with_those_that_do() -> None:
    with pytest.raises(ControlError, match="there is no controller 'pid': use one of integrator, lqg"):
        ControlLoop(small_rig(), "pid")


class Nonsense:
    """A controller of somebody else that is wrong in one way or the other."""

    def __init__(self, given: object) -> None:
        self._given = given

    def see(self, seen: Seen) -> None:
        pass

    def step(self, held: FloatArray) -> FloatArray:
        if isinstance(self._given, Exception):
            raise self._given
        return np.asarray(self._given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([0.1, 0.2], r"the controller mine gives an array of \(2,\), expected \(1,\) finite inputs"),
        ([np.nan], "the controller mine gives a number that is not finite"),
        (KeyError("gone"), r"the controller mine failed: KeyError\('gone'\)$"),
    ],
)
def test_a_controller_that_gives_nonsense_is_an_error_that_names_it(given: object, message: str) -> None:
    rig = small_rig()
    row = ControllerRow(name="mine", summary="", build=lambda rig: Nonsense(given), needs_state=False)
    loop = ControlLoop(rig, row)
    (exposure,) = simulate(rig, 1)
    loop.see(exposure, None, 40)
    with pytest.raises(ControlError, match=message):
        loop.inputs(40, 20)


def test_a_camera_that_exposes_row_by_row_is_refused() -> None:
    with pytest.raises(ControlError, match="with a global shutter"):
        ControlLoop(rolling("sh-4x4", 2e-4), "integrator")
    ControlLoop(rolling("sh-4x4", 0.0), "integrator")
