"""The numbers that the page of a first session tells its reader to expect, with the simulated rig as the bench."""

from __future__ import annotations

import numpy as np
import pytest

from aolink import estimate, simulate
from aolink.estimation import Status
from tests.conftest import Session


def test_no_frame_is_lost_and_no_step_late_with_a_queue(recorded: Session) -> None:
    report = recorded.report
    assert (report.frames_lost, report.commands.late, report.commands.refused, report.commands.not_reported) == (
        0,
        0,
        0,
        0,
    )
    assert report.commands.applied > 0


@pytest.mark.parametrize(("name", "measurements"), [("o1", 1), ("o3", 2), ("moments", 4)])
def test_the_mean_nis_is_the_number_of_measurements_and_nothing_is_gated(name: str, measurements: int) -> None:
    """Over 300 exposures whose model is right, the third of them drawn afresh."""
    nis, status = [], []
    for seed in (1, 2, 3):
        found = estimate(simulate("section-vi-lively", n_exposures=100, seed=seed), name).estimates(name)
        nis += [each.nis.mean() for each in found]
        status += [each.status for each in found]
    assert np.mean(nis) == pytest.approx(measurements, rel=0.15)
    assert Status.GATED not in status
