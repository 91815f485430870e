"""filterpy as the engine: the same estimates, and really filterpy's."""

import dataclasses
import json

import filterpy.kalman
import numpy as np
import pytest

from aolink.errors import EstimatorError
from aolink.estimation import make_estimator
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.simulation.model import simulate


@pytest.mark.parametrize("name", ["o1", "o2", "o3"])
def test_filterpy_gives_our_estimates(rig, name):
    exposures = simulate(rig, 40, seed=3)
    exposures[20] = dataclasses.replace(exposures[20], mask=np.zeros((1, 40), bool))
    ours, theirs = make_estimator(rig, name), make_estimator(rig, name, engine="filterpy")
    for exposure in exposures:
        a, b = ours.step(exposure), theirs.step(exposure)
        assert (a.status, a.reason) == (b.status, b.reason)
        for field in dataclasses.fields(a):
            value = getattr(a, field.name)
            if isinstance(value, np.ndarray):
                np.testing.assert_allclose(value, getattr(b, field.name), atol=1e-9, rtol=0, err_msg=field.name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["o1", "o2", "o3"])
@pytest.mark.parametrize("rig_name", ["tip-tilt", "sh-8x8"])
def test_filterpy_gives_our_estimates_of_plants_that_move_whole_spots(rig_name, name):
    """Their measurements have the noise of each spot as a block of its own."""
    rig = load_rig(rig_name)
    ours, theirs = make_estimator(rig, name), make_estimator(rig, name, engine="filterpy")
    for exposure in simulate(rig, 3, seed=3):
        a, b = ours.step(exposure), theirs.step(exposure)
        for field in ("path", "path_sd", "end_state", "end_covariance", "innovation_covariance", "nis"):
            np.testing.assert_allclose(getattr(a, field), getattr(b, field), atol=1e-9, rtol=1e-9, err_msg=field)


@pytest.mark.parametrize("name", ["o1", "o2", "o3"])
@pytest.mark.parametrize("method", ["update", "predict"])
def test_it_is_filterpy_that_works(rig, name, method, monkeypatch):
    def fail(*args, **kwargs):
        raise NotImplementedError

    for kind in (filterpy.kalman.KalmanFilter, filterpy.kalman.ExtendedKalmanFilter):
        monkeypatch.setattr(kind, method, fail)
        monkeypatch.setattr(kind, "update_steadystate", fail, raising=False)
    (exposure,) = simulate(rig, 1)
    estimator = make_estimator(rig, name, engine="filterpy")
    with pytest.raises(NotImplementedError):
        estimator.step(exposure)
    make_estimator(rig, name).step(exposure)


def test_filterpy_does_one_axis_of_the_papers_filters(rig):
    with pytest.raises(EstimatorError, match="runs o1, o2, o3 on a plant of one axis"):
        make_estimator(rig, "moments", engine="filterpy")
    many = dataclasses.replace(rig, plant=dataclasses.replace(rig.plant, axes=2))
    with pytest.raises(EstimatorError, match="one axis"):
        make_estimator(many, "o1", engine="filterpy")


@pytest.mark.slow
def test_the_command_line_runs_it_and_says_where_it_cannot(aolink, recorded, tmp_path):
    by_filterpy = "o3:engine=filterpy"
    done = aolink("estimate", recorded.path, "-e", "o3", "-e", by_filterpy, "-o", "a.mcap", "--json")
    assert done.returncode == 0, done.stderr
    scores = json.loads(done.stdout)
    assert scores[by_filterpy]["path_rmse"] == pytest.approx(scores["o3"]["path_rmse"], abs=1e-9)
    ours, theirs = (Recording(tmp_path / "a.mcap").estimates(name) for name in ("o3", by_filterpy))
    assert any(a.path.tobytes() != b.path.tobytes() for a, b in zip(ours, theirs, strict=True))  # other roundings
    refused = aolink("estimate", recorded.path, "-e", "moments:engine=filterpy")
    assert refused.returncode != 0
    assert "engine 'filterpy' runs o1, o2, o3 on a plant of one axis, this is moments" in refused.stderr
