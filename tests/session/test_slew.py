"""A slew limit in a session: what the mirror is sent, and what it really holds, whatever comes late or is lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aolink.control import ControllerRow, Seen
from aolink.control.integrator import Integrator
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.rig import Rig, parse_rig
from aolink.session.commanding import Inputs
from aolink.wire import messages_pb2 as pb
from tests.control.rigs import DRIFT, small_rig
from tests.kinds import messages_of
from tests.session.simulated_time import Run, SimulatedTimeHub, run_session

MOST = 0.001
"""The change that the mirror may make in a fast step."""
RIG = small_rig(DRIFT, mirror=f"slew_max_per_s = {1000 * MOST}")


def ramp(first_step: int, n_steps: int) -> np.ndarray:
    """As fast as the limit allows, to 0.3, and there it stays."""
    return np.asarray(np.minimum(MOST * np.arange(first_step, first_step + n_steps), 0.3)[:, None])


def session(
    folder: Path,
    happens: dict[int, Callable[[SimulatedTimeHub], None]],
    *,
    rig: Rig = RIG,
    inputs: Inputs | None = None,
) -> Run:
    """A session of 30 exposures, after some of which something happens; the integrator's where no inputs are given."""
    hub, left = SimulatedTimeHub(rig), dict(happens)

    def progress(exposures: int) -> None:
        if exposures in left:
            left.pop(exposures)(hub)

    return run_session(
        hub, rig, folder / "a.mcap", 30, inputs=inputs, controller="" if inputs else "integrator", progress=progress,
        reconnect_s=20,
    )  # fmt: skip


def check(run: Run) -> None:
    """It has gone on to its end; nothing was sent beyond the limit, and the mirror was nowhere faster but to park."""
    assert run.error is None
    report = run.report
    assert report.ended == "complete"
    assert report.commands.commanded == report.commands.ended
    for block in messages_of(pb.CommandBlock, Recording(run.path), topics.COMMAND):
        assert np.abs(np.diff(block.u)).max(initial=0.0) <= MOST * (1 + 1e-6)
    truth = run.hub.truth()
    steps = [step for step in sorted(truth) if truth[step][1] == pb.Applied.COMMAND]
    converter = 2.0 / (2**16 - 1)
    for step in steps:
        change = abs(run.hub.held_inputs[step][0] - run.hub.held_inputs[step - 1][0])
        assert change <= MOST + 2 * converter, f"{change:.4g} to step {step}, {report.commands.late} late"


def test_a_controller_that_takes_longer_than_it_should_changes_what_can_still_be_changed(tmp_path: Path) -> None:
    """The steps that it meant to change first have begun meanwhile, with what the mirror was sent before."""
    hub = SimulatedTimeHub(RIG)

    class HeldUp(Integrator):
        """Every fifth time this machine does something else."""

        def __init__(self, rig: Rig) -> None:
            super().__init__(rig)
            self._seen = 0

        def see(self, seen: Seen) -> None:
            super().see(seen)
            self._seen += 1
            if self._seen % 5 == 0:
                hub.hold_up(0.02)

    row = ControllerRow(name="held up", summary="", build=HeldUp, needs_state=False)
    check(run_session(hub, RIG, tmp_path / "a.mcap", 30, controller=row))


@pytest.mark.parametrize("inputs", [None, ramp], ids=["integrator", "ramp"])
@pytest.mark.parametrize("seconds", [0.03, 0.1, 0.5])
def test_a_host_that_was_held_up_goes_on_from_what_the_mirror_holds(
    tmp_path: Path, seconds: float, inputs: Inputs | None
) -> None:
    """After the longer ones its queue has run empty, and it holds its safe input."""
    run = session(tmp_path, dict.fromkeys((7, 14, 21), lambda hub: hub.hold_up(seconds)), inputs=inputs)
    check(run)
    assert (run.report.steps_parked > 0) == (seconds > 0.05)


@pytest.mark.parametrize("inputs", [None, ramp], ids=["integrator", "ramp"])
@pytest.mark.parametrize("seconds", [0.02, 0.3, 4.0])
def test_a_mirror_that_was_gone_goes_from_its_safe_input_to_what_is_commanded(
    tmp_path: Path, seconds: float, inputs: Inputs | None
) -> None:
    """A closed loop changes what it is sent while it is still on its way there."""
    run = session(tmp_path, {12: lambda hub: hub.pull(seconds)}, inputs=inputs)
    check(run)
    assert (run.report.ports_vanished, run.report.rearmed) == (1, seconds > 2)
    assert run.report.steps_parked > 0


@pytest.mark.parametrize("inputs", [None, ramp], ids=["integrator", "ramp"])
def test_a_mirror_that_its_watchdog_has_parked_goes_from_there_when_it_is_re_armed(
    tmp_path: Path, inputs: Inputs | None
) -> None:
    rig = replace(RIG, mirror=replace(RIG.mirror, watchdog_s=0.3))
    run = session(tmp_path, {12: lambda hub: hub.hold_up(0.4)}, rig=rig, inputs=inputs)
    check(run)
    assert run.report.rearmed == 1


@pytest.mark.parametrize("inputs", [None, ramp], ids=["integrator", "ramp"])
@pytest.mark.parametrize("seed", range(4))
def test_on_a_bad_line_and_a_busy_machine_a_legal_session_never_ends_for_its_slew_limit(
    tmp_path: Path, seed: int, inputs: Inputs | None
) -> None:
    faults = "[simulation.faults]\ncommand_loss_rate = 0.1\npacket_loss_rate = 0.1\nstall_rate = 0.01\n"
    chance, rig = np.random.default_rng(seed), parse_rig(RIG.toml + faults)
    run = session(
        tmp_path, dict.fromkeys(range(30), lambda hub: hub.hold_up(chance.exponential(0.02))), rig=rig, inputs=inputs
    )
    assert run.error is None
    assert run.report.ended == "complete"
