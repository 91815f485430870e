"""What a filter says that it needs of a frame is what it gets."""

import numpy as np
import pytest

from aolink.estimation import Measurement, Needs, Profile, SpotWindows
from aolink.estimation.frames.measure import measure
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.kinds import spots_of


def test_a_plant_that_moves_whole_spots_gives_each_kind():
    rig = load_rig("tip-tilt")
    (exposure,) = simulate(rig, 1, seed=1)
    axes, n_outputs = rig.plant.axes, rig.plant.n_outputs
    moments, _ = measure(rig, exposure, Needs(what="moments", orders=(1,)))
    assert isinstance(moments, Measurement)
    assert moments.value.shape == (axes, n_outputs)
    windows, _ = measure(rig, exposure, Needs(what="windows"))
    assert isinstance(windows, SpotWindows)
    assert windows.density.shape == (axes, n_outputs // 2, *spots_of(rig).window)
    profile, _ = measure(rig, exposure, Needs(what="profile"))
    assert isinstance(profile, Profile)
    assert profile.density.shape == profile.mask.shape == (axes * n_outputs, rig.sensor.profile.pixels)
    assert measure(rig, exposure, None) == (None, "")


def test_a_line_that_lost_pixels_has_a_profile_for_who_can_do_without_them():
    rig = load_rig("section-vi-lively")
    (exposure,) = simulate(rig, 1, seed=1)
    exposure.mask[0, :3] = False
    for needs, gives in (
        (Needs(what="moments", orders=(1,)), False),
        (Needs(what="profile"), False),
        (Needs(what="profile", least_usable=0.5), True),
        (Needs(what="profile", least_usable=0.95), False),
    ):
        found, remark = measure(rig, exposure, needs)
        assert (found is not None) == gives
        assert "3 of 40 pixels are missing" in remark
        if isinstance(found, Profile):
            np.testing.assert_array_equal(found.mask, exposure.mask)


def test_moments_need_whole_spots():
    with pytest.raises(ValueError, match="moments need whole spots"):
        Needs(what="moments", orders=(1,), least_usable=0.5)
