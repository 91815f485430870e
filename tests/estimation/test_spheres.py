"""Blur that nobody here made: frames of diffusing spheres, averaged, against where a tracker saw them in each."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from judging.rows import Given
from judging.spheres import LENGTHS, rows


@pytest.mark.rare
@pytest.mark.parametrize("seed", range(len(LENGTHS)))
def test_the_path_inside_an_exposure_is_found(seed: int) -> None:
    """To half a pixel at 8 frames, where a sphere goes by more than one (rms) from the exposure's start to its end."""
    found = {row["what"]: row for row in rows(seed, Given(estimators=("o1", "moments", "profile"), runs=1))}
    paths = {what: np.array(row["path"]) for what, row in found.items()}
    assert math.sqrt(paths["profile"].mean()) < 0.21 * math.sqrt(LENGTHS[seed])
    picks = np.random.default_rng(0).integers(0, len(paths["profile"]), (2000, len(paths["profile"])))
    for ours, theirs in (("profile", "o1"), ("moments, smoothed", "centroid, held")):  # paired over the axes
        shares = np.sqrt(paths[ours][picks].mean(axis=1) / paths[theirs][picks].mean(axis=1))
        assert np.quantile(shares, 0.975) < 1
    for name in ("moments", "profile"):
        assert 0.9 < found[name]["inside"] < 0.985
