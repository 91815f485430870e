"""Blur that nobody here made: frames of diffusing spheres, averaged, against where a tracker saw them in each."""

import sys
from pathlib import Path

import numpy as np
import pytest

from aolink.estimation import run

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from paper_report.spheres import HALF, spheres

NAMES = ["o1", "moments", "profile", "mixture"]


@pytest.mark.parametrize("K", [8, pytest.param(12, marks=pytest.mark.long), pytest.param(24, marks=pytest.mark.long)])
def test_the_path_inside_an_exposure_is_found(K):
    """To half a pixel at K = 8, where a sphere goes by more than one (rms) from the exposure's start to its end."""
    rig, exposures, paths = spheres(K)
    squares = {}
    for name, estimates in run(rig, exposures, NAMES).items():
        error = np.array([e.path - path for e, path in zip(estimates, paths, strict=True)])[1:]
        squares[name] = (error**2).mean(axis=2)  # (exposures, axes)
    rmse = {name: HALF * np.sqrt(each.mean()) for name, each in squares.items()}
    for name in ("profile", "mixture"):
        assert rmse[name] < 0.2 * np.sqrt(K)
        assert rmse[name] < rmse["moments"]
        # Paired over the twelve axes.
        ours, o1 = squares[name].mean(axis=0), squares["o1"].mean(axis=0)
        picks = np.random.default_rng(0).integers(0, 12, (2000, 12))
        assert np.quantile(np.sqrt(ours[picks].mean(axis=1) / o1[picks].mean(axis=1)), 0.95) <= 1.02
