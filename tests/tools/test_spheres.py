"""What the film of spheres itself allows, as the page of identification has it."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.needs import needed

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture(scope="module")
def identification() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(TOOLS))
        yield importlib.import_module("bench_rows.identification")


def test_single_frames_of_the_film_are_late_by_its_compression(identification: Any) -> None:
    """A random walk has no covariance of steps two frames apart, steps of one size in each frame, and a mean square
    displacement that grows evenly."""
    lagged, key, growth = identification.compression()
    assert lagged.ratio > 4  # standard deviations
    assert key.ratio > 1.3
    assert growth.ratio > 4  # standard deviations


@pytest.fixture
def walk() -> Any:
    """Means over single frames of random walks that gain a variance of one in a frame, (6, 300, 2)."""
    random = np.random.default_rng(0)
    return np.cumsum(random.normal(size=(6, 300 * 8, 2)) / 8**0.5, axis=1).reshape(6, 300, 8, 2).mean(axis=2)


def test_a_random_walk_shows_no_compression(identification: Any, monkeypatch: pytest.MonkeyPatch, walk: Any) -> None:
    monkeypatch.setattr(identification.np, "load", lambda path: {"tracked_xy": walk})
    lagged, key, growth = identification.compression()
    assert lagged.ratio < 3
    assert key.ratio == pytest.approx(1, abs=0.2)
    assert abs(growth.ratio) < 3


@pytest.mark.parametrize("frames", [1, 4])
@pytest.mark.parametrize("noise", [0.2, None])
def test_pylake_finds_the_walks_intensity(identification: Any, walk: Any, frames: int, noise: float | None) -> None:
    needed("lumicks.pylake")
    tracks = walk.transpose(0, 2, 1).reshape(12, -1, frames).mean(axis=2)
    tracks = tracks + np.random.default_rng(1).normal(scale=0.2**0.5, size=tracks.shape)
    found = identification.by_pylake(tracks, frames, noise)
    sd = found.intensity.std() / len(found.intensity) ** 0.5
    assert abs(found.intensity.mean() - 1) < 3 * sd
    assert sd < 0.2
    if noise is None:
        assert abs(found.noise.mean() - 0.2) < 3 * found.noise.std() / len(found.noise) ** 0.5
    else:
        assert found.noise == pytest.approx(noise)


def test_pylake_takes_the_blur_of_frames_that_are_apart_for_shorter_than_their_distance(
    identification: Any, walk: Any
) -> None:
    """As if each were four frames long, it would find about 1.5 times the intensity."""
    needed("lumicks.pylake")
    tracks = walk.transpose(0, 2, 1).reshape(12, -1)
    found = np.mean([
        identification.by_pylake(tracks[:, start::4], 4, 1e-6, exposed=1).intensity for start in range(4)
    ], axis=0)  # fmt: skip
    sd = found.std() / len(found) ** 0.5
    assert abs(found.mean() - 1) < 3 * sd
    assert sd < 0.1


@pytest.mark.slow
def test_frames_that_are_apart_keep_their_distance(identification: Any) -> None:
    """The intensity of a random walk is that of the recording; without the empty slots it would be four times that."""
    log, seen, _ = identification._seen(30_002)
    assert log.kinds == ["random-walk"]
    truth = log.model.processes[0].values[0]
    for start in range(2):
        some = [identification.every(each, 4, start) for each in seen]
        assert sum(each.usable.sum() for each in some) == math.ceil((log.exposures - start) / 4)
        space = identification.space_of(
            log.kinds, some, log.rig.sensor.kernel.variance, with_noise=False, with_kernel=False
        )
        assert 0.5 < math.exp(identification.maxima(space, some)[0].x[0]) / truth < 2
