"""The closed loops of `tools/bench loop`: what disturbs them, pyRTC's predictors, the limit, the ratios."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray

from aolink.control import ControllerRow
from aolink.exposure import Exposure, residual_rms
from aolink.jobs.closed_loop import closed_loop
from aolink.rig import Rig, load_rig
from tests.needs import needed

if TYPE_CHECKING:
    from bench_rows.loop import Cell, DisturbanceRun

needed("pyrtc")
TOOLS = Path(__file__).parents[2] / "tools"
N = 50


@pytest.fixture(autouse=True)
def tools(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))


def played(cell: Cell, known: DisturbanceRun, folder: Path) -> Rig:
    """The cell's rig, which hardly any noise is in, with these slopes."""
    np.save(folder / "slopes.npy", known.slopes[:, None])
    table = '[disturbance]\nplant_noise = false\nrecorded = "slopes.npy"\n\n[simulation]'
    text = re.sub("noise_density = .*", "noise_density = 1e-10", cell.rig(known.model).toml)
    text = text.replace("[simulation]", table, 1)
    (folder / "rig.toml").write_text(text)
    return load_rig(folder / "rig.toml")


def series(rig: Rig, controller: str | ControllerRow, exposures: int = 30) -> list[Exposure]:
    return [each.exposure for each in closed_loop(rig, controller, "", exposures, seed=3)]


def test_a_vibration_has_the_sd_and_the_frequency_that_it_is_asked_for() -> None:
    from bench_rows.loop import vibration

    slopes = np.array([vibration(48.0, 0.1, 4000, seed).slopes for seed in range(40)])
    # Its energy is exponentially distributed from seed to seed, as it remembers it for longer than the run.
    assert np.sqrt(np.mean(slopes**2)) == pytest.approx(0.1, rel=4 * 0.5 / math.sqrt(40))
    spectrum = (np.abs(np.fft.rfft(slopes, axis=1)) ** 2).sum(axis=0)
    assert np.argmax(spectrum) / 4 == pytest.approx(48.0, abs=0.5)


@pytest.mark.slow
def test_turbulence_is_foretold_by_what_is_known_of_it() -> None:
    """The state holds the slopes, and its model foretells those that it was not fitted to better than the last one."""
    from bench_rows.loop import together, turbulence, vibration

    steps, past, ahead = 3000, 2000, 8
    known = together([turbulence(0.1, steps, past, 5), vibration(24.0, 0.1, steps, 5)])
    np.testing.assert_allclose(known.states @ known.C[0], known.slopes, atol=1e-12)
    foretold = (known.states @ (known.C @ np.linalg.matrix_power(known.A, ahead))[0])[past:-ahead]
    truth = known.slopes[past + ahead :]
    assert residual(foretold - truth) < 0.5 * residual(known.slopes[past:-ahead] - truth)


def residual(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_a_predictor_is_shown_the_disturbance_as_if_the_mirror_had_been_at_rest(tmp_path: Path) -> None:
    """What pyRTC's `persistence` was told last is the mean of the true slopes, while the mirror moves all the time."""
    from bench_rows.loop import Cell, Predicted, vibration
    from pyrtc.predictive import PersistencePredictor

    cell, known = Cell(False, 0.24), vibration(4.8, 0.1, 31 * N, 7)
    rig, made = played(cell, known, tmp_path), []

    def build(of: Rig) -> Predicted:
        made.append(Predicted(of, PersistencePredictor(1, horizon=1)))
        return made[-1]

    exposures = series(rig, ControllerRow(name="persistence", summary="", build=build, needs_state=False))
    last = known.slopes[29 * N : 30 * N].mean()
    assert abs(exposures[-1].inputs).max() > 0.02
    assert made[0].predictor.predict()[0] == pytest.approx(last, abs=1e-4)


def test_pyrtcs_predictors_cancel_a_slow_vibration_better_than_the_integrator(tmp_path: Path) -> None:
    from bench_rows.loop import PREDICTORS, Cell, predicted, vibration

    cell, known = Cell(False, 0.24), vibration(4.8, 0.1, 331 * N, 7)
    past = known.slopes[: 300 * N].reshape(-1, N).mean(axis=1)[:, None]
    rig = played(cell, replace(known, slopes=known.slopes[300 * N :]), tmp_path)
    integrator = residual_rms(series(rig, "integrator")[5:])
    for name in PREDICTORS:
        assert residual_rms(series(rig, predicted(name, past))[5:]) < 0.7 * integrator


def test_with_the_true_state_hardly_anything_is_left_of_a_vibration_that_does_not_change(tmp_path: Path) -> None:
    """What is left is what the vibration's own noise adds after each exposure's end: at most some per cent."""
    from bench_rows.loop import Cell, vibration, with_true_state

    cell, known = Cell(False, 2.4), vibration(48.0, 0.1, 31 * N, 7)
    rig = played(cell, known, tmp_path)
    left = residual_rms(series(rig, with_true_state(known))[5:])
    A, C = known.A, known.C
    pushed = known.states[1:] - known.states[:-1] @ A.T
    innovation = np.cov(pushed.T)
    # The inputs from 5 steps after an exposure's end to 5 after the next one's are of that end.
    ahead = [sum((C @ np.linalg.matrix_power(A, i) @ innovation @ np.linalg.matrix_power(A, i).T @ C.T).item()
                 for i in range(k)) for k in range(5, 5 + N)]  # fmt: skip
    assert left == pytest.approx(math.sqrt(np.mean(ahead)), rel=0.25)
    assert left < 0.4 * residual_rms(series(rig, "")[5:])
