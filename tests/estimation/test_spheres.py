"""Blur that nobody here made: frames of diffusing spheres, averaged, against where a tracker saw them in each."""

import sys
from pathlib import Path

import numpy as np
import pytest

from aolink.estimation import run, smooth

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from paper_report.spheres import PATH_SD, centroids, spheres

from tests.kinds import truth_of

NAMES = ["o1", "moments", "profile"]


@pytest.mark.rare
@pytest.mark.parametrize("K", [8, pytest.param(12, marks=pytest.mark.slow), pytest.param(24, marks=pytest.mark.slow)])
def test_the_path_inside_an_exposure_is_found(K: int) -> None:
    """To half a pixel at K = 8, where a sphere goes by more than one (rms) from the exposure's start to its end.

    Spheres with another one beside them do not count.
    """
    rig, exposures, alone = spheres(K)
    scored = [k for k, each in enumerate(exposures) if k and each.truth is not None]
    true = np.array([truth_of(exposures[k]).path for k in scored])
    unit = 1 / rig.sensor.pixel_width

    def squares(paths: np.ndarray) -> np.ndarray:
        errors = ((paths - true) ** 2).mean(axis=2) * unit**2  # (exposures, axes)
        return np.where(alone[scored], errors, np.nan)

    estimates = run(rig, exposures, NAMES)
    found = {name: [each[k] for k in scored] for name, each in estimates.items()}
    errors = {name: squares(np.array([each.path for each in one])) for name, one in found.items()}
    errors["held"] = squares(centroids(rig, exposures)[0][scored])
    rmse = {name: np.sqrt(np.nanmean(each)) for name, each in errors.items()}
    picks = np.random.default_rng(0).integers(0, 12, (2000, 12))
    assert rmse["profile"] < 0.2 * np.sqrt(K)
    assert rmse["profile"] < rmse["moments"]
    for other in ("o1", "held"):  # paired over the twelve axes
        ours, theirs = (np.nanmean(errors[each], axis=0) for each in ("profile", other))
        assert np.quantile(np.sqrt(ours[picks].mean(axis=1) / theirs[picks].mean(axis=1)), 0.975) < 1
        assert rmse["profile"] < rmse[other]
    after = smooth(rig.plant, exposures, estimates["profile"])
    smoothed = squares(np.array([after[k].path for k in scored]))
    ours, theirs = (np.nanmean(each, axis=0) for each in (smoothed, squares(centroids(rig, exposures)[1][scored])))
    assert np.quantile(np.sqrt(ours[picks].mean(axis=1) / theirs[picks].mean(axis=1)), 0.975) < 1
    spread = np.hypot([each.path_sd for each in found["profile"]], PATH_SD)
    inside = np.abs(np.array([each.path for each in found["profile"]]) - true) <= 1.96 * spread
    assert 0.9 < inside.mean(axis=2)[alone[scored]].mean() < 0.98
