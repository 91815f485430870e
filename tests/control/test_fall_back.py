"""A controller whose model does not pay leaves the mirror to another one, and takes it back when it does."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from aolink.control import FallBack, delay_steps, find_controller
from aolink.control.integrator import INTEGRATOR
from aolink.control.loop import centroids
from aolink.control.rival import Rival
from aolink.exposure import residual_rms
from aolink.jobs.closed_loop import Closed, closed_loop
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig, load_rig
from tests.control.rigs import DRIFT, VIBRATION, small_rig

STEPS = 40
"""Fast steps of an exposure."""


def played(folder: Path, slopes: FloatArray, *parts: str, **changes: str) -> Rig:
    """A small rig that believes in these parts of a model, while other slopes disturb it; changes as `small_rig`."""
    np.save(folder / "slopes.npy", slopes[:, None])
    path = folder / "played.toml"
    text = small_rig(*parts, **changes).toml
    path.write_text(text + '\n[disturbance]\nplant_noise = false\nrecorded = "slopes.npy"\n')
    return load_rig(path)


def vibration(frequency_hz: float, exposures: int, amplitude: float = 0.14) -> FloatArray:
    """A vibration, slope units at each fast step."""
    return np.asarray(amplitude * np.sin(2 * math.pi * frequency_hz * 0.001 * np.arange(exposures * STEPS) + 1))


def wandering(exposures: int, seed: int) -> FloatArray:
    """An Ornstein-Uhlenbeck process with a memory of 60 fast steps and a sd of 0.12, slope units at each fast step."""
    keep = math.exp(-1 / 60)
    pushes = np.random.default_rng(seed).standard_normal(exposures * STEPS)
    return np.asarray(signal.lfilter([0.12 * math.sqrt(1 - keep**2)], [1, -keep], pushes))


def run(rig: Rig, exposures: int, *, fall_back: bool = True, seed: int = 3) -> list[Closed]:
    rig = replace(rig, control=replace(rig.control, fall_back=fall_back))
    return list(closed_loop(rig, "lqg", "o1", exposures, seed=seed))


def acting(series: list[Closed]) -> list[str]:
    return [each.act.acting for each in series if each.act is not None]


def residual(series: list[Closed], first: int) -> float:
    return residual_rms(each.exposure for each in series[first:])


@pytest.mark.parametrize("slew", [0, 2])
def test_what_the_integrator_would_have_left_is_what_it_leaves(slew: float) -> None:
    """It is followed on exposures of a mirror that holds still; and really closes the loop, from the same seed."""
    rig = small_rig(DRIFT, mirror=f"slew_max_per_s = {slew}") if slew else small_rig(DRIFT)
    rival = Rival(rig, INTEGRATOR, delay_steps(rig), rig.mirror.park, np.zeros(1))
    would, does = [], []
    for still, closed in zip(
        closed_loop(rig, "", "", 40), closed_loop(rig, "integrator", "", 40), strict=True
    ):  # fmt: skip
        seen = centroids(rig, still.exposure)
        held = np.concatenate([still.exposure.lead_inputs, still.exposure.inputs])
        would.append(seen + rival.see(held, seen).mean(axis=1))
        does.append(centroids(rig, closed.exposure))
    assert np.std(does) < 0.7 * np.std([centroids(rig, each.exposure) for each in closed_loop(rig, "", "", 40)])
    # Noise of pixels, and a converter of 16 bits.
    np.testing.assert_allclose(would, does, atol=0.004)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_model_that_is_right_never_falls_back(seed: int) -> None:
    rig = small_rig(DRIFT, VIBRATION)
    watched, alone = run(rig, 90, seed=seed), run(rig, 90, fall_back=False, seed=seed)
    assert set(acting(watched)) == {"lqg"}
    for ours, theirs in zip(watched, alone, strict=True):
        assert np.array_equal(ours.exposure.inputs, theirs.exposure.inputs)


@pytest.mark.slow
def test_a_vibration_at_another_frequency_than_the_model_has_it_is_left_alone(tmp_path: Path) -> None:
    rig = played(tmp_path, vibration(10.5, 120), DRIFT, VIBRATION)
    series, alone = run(rig, 120), run(rig, 120, fall_back=False)
    which = acting(series)
    assert which[:20] == ["lqg"] * 20
    first = next(k for k, name in enumerate(which) if name != "lqg")
    assert first < 60
    assert "lqg" not in which[first:]
    act = series[first].act
    assert act is not None
    assert act.gained > 0.02
    open_rms = residual(list(closed_loop(rig, "", "", 120, seed=3)), 70)
    assert residual(series, 70) < 1.02 * open_rms < residual(alone, 70)


@pytest.mark.parametrize("seed", [5, 6])
def test_a_model_that_is_known_to_be_wrong_need_not_be_worse_beyond_chance(seed: int, tmp_path: Path) -> None:
    """The disturbance is faster than the model has it. What the others gain is significant after 137 exposures only."""
    rig = played(tmp_path, wandering(125, seed), DRIFT, VIBRATION)
    left = {}
    series = run(rig, 125, fall_back=False)
    for misfits in (True, False):
        judge = FallBack(rig, find_controller("lqg", rig), delay_steps(rig))
        gained = [judge.see(each.exposure, centroids(rig, each.exposure), misfits) for each in series]
        left[misfits] = [k for k, each in enumerate(gained) if each is not None]
    assert left[True][0] < 80
    assert not left[False]


@pytest.mark.slow
def test_a_controller_whose_model_fits_again_acts_again(tmp_path: Path) -> None:
    """The vibration is elsewhere for a while, and comes back to where the model has it."""
    slopes = np.concatenate([vibration(10.5, 70), vibration(15.0, 190)])
    rig = played(tmp_path, slopes, DRIFT, VIBRATION)
    which = acting(run(rig, 260))
    assert "lqg" not in which[60:70]
    assert which[-1] == "lqg"


def test_it_can_be_switched_off() -> None:
    assert small_rig(control="fall_back = false").control.fall_back is False
    assert small_rig().control.fall_back is True
