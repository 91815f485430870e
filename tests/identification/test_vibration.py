"""Vibrations from means and covariances of the path: exact exposures of known lines, with noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from aolink.identification.vibration import Line, PathMoments, Vibration, find
from aolink.numerics.arrays import FloatArray

FINE = 400
NOISE = (0.02, 0.1)


def seen(
    *lines: tuple[float, complex, complex], rate: float = 50.0, share: float = 0.9, count: int = 120, seed: int = 0,
    walk: float = 0.0, growth: float = 0.0, axes: FloatArray | None = None, edge: bool = False,
) -> PathMoments:  # fmt: skip
    """What exposures show of a path, by sums over many instants; a constant of the kernel is in the covariances."""
    rng = np.random.default_rng(seed)
    exposure, starts = share / rate, np.arange(count) / rate
    t = starts[:, None] + (np.arange(FINE) + 0.5) / FINE * exposure
    tau = (t - t.mean()) / (t.max() - t.mean())
    path = np.zeros((count, FINE, 2))
    for hz, x, y in lines:
        path += (
            np.stack([(a * np.exp(2j * np.pi * hz * t)).real for a in (x, y)], axis=-1) * (1 + growth * tau)[..., None]
        )
    path += np.cumsum(rng.normal(size=(count * FINE, 2)) * walk / np.sqrt(FINE), axis=0).reshape(path.shape)
    Q = np.eye(2) if axes is None else axes
    path = path @ Q.T
    mean = path.mean(axis=1)
    away = path - mean[:, None]
    C = np.einsum("ksi,ksj->kij", away, away) / FINE
    mean = mean[:, None] + NOISE[0] * rng.normal(size=(count, 1, 2))
    spread = np.stack([C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]], axis=-1)[:, None] + 0.3
    spread = spread + NOISE[1] * rng.normal(size=spread.shape)
    mean_variance, spread_variance = np.full(mean.shape, NOISE[0] ** 2), np.full(spread.shape, NOISE[1] ** 2)
    if edge:
        mean_variance[..., 1] = spread_variance[..., 1:] = np.inf
    return PathMoments(
        times_s=starts + exposure / 2, exposure_s=exposure, rate_hz=rate, mean=mean, mean_variance=mean_variance,
        spread=spread, spread_variance=spread_variance, constant_sd=np.full((1, 3), 1.0), axes=Q[None],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("line", "more"),
    [
        ((73.1, 4.0, 1.5), {}),
        ((57.0, 4.9, 3.4), {"share": 0.8}),
        ((37.3, 3.0, 2j), {}),
        ((11.3, 3.0, 0.0), {"rate": 60.0, "share": 0.5}),
        ((137.3, 3.0, 1.0), {"rate": 50.0, "share": 0.9}),
        ((37.3, 3.0, 1.0), {"growth": 0.8}),
    ],
)
def test_one_line_is_found_with_its_ellipse(line: tuple[float, complex, complex], more: dict[str, Any]) -> None:
    moments = seen(line, **more)
    found = find(moments)
    (one,), ((part, *others),) = found.lines, found.sets
    assert not others
    assert abs(one.hz - line[0]) < 0.01
    assert part.low - 0.002 < line[0] < part.high + 0.002
    t = moments.times_s - moments.times_s.mean()
    truth = np.array(line[1:]) * np.exp(2j * np.pi * line[0] * moments.times_s.mean())
    assert np.abs(one.amplitude - truth).max() < 0.05 * np.abs(truth).max()
    assert found.mean_misfit == pytest.approx(1, abs=0.3)
    assert found.spread_misfit == pytest.approx(1, abs=0.3)
    np.testing.assert_allclose(found.constant, 0.3, atol=0.15)
    assert t.sum() == pytest.approx(0, abs=1e-9)


def test_two_lines_are_found_beside_each_other() -> None:
    found = find(seen((37.3, 3.0, 1.0), (11.2, 1.0, 2j)))
    assert [round(each.hz, 1) for each in found.lines] == [37.3, 11.2]
    assert all(len(each) == 1 for each in found.sets)


def test_frames_without_blur_name_all_aliases() -> None:
    found = find(seen((37.3, 3.0, 1.0), share=0.05))
    best = sorted(part.best for part in found.sets[0])
    assert {12.7, 37.3} <= {round(each, 1) for each in best}


@pytest.mark.parametrize(
    "moments",
    [
        seen((50.0, 3.0, 1.0), share=1.0), seen((100.0, 3.0, 1.0), share=0.6), seen(), seen(walk=0.5),
        seen(walk=2.0, seed=1),
    ],
    ids=["whole swings", "a multiple of the rate", "still", "a walk", "another walk"],
)  # fmt: skip
def test_where_nothing_tells_no_line_is_found(moments: PathMoments) -> None:
    assert not find(moments).lines


def test_a_line_stands_out_of_a_walk() -> None:
    found = find(seen((73.1, 2.0, 1.0), walk=0.5))
    assert any(abs(part.best - 73.1) < 0.1 for part in found.sets[0])


def test_an_edge_shows_the_motion_across_it() -> None:
    angle = 0.5
    axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    found = find(seen((37.3, 3.0, 0.0), axes=axes, edge=True))
    (line,) = found.lines
    assert abs(line.hz - 37.3) < 0.01
    assert line.ellipse[0] == pytest.approx(3 * np.cos(angle), rel=0.03)
    assert line.ellipse[2] == pytest.approx(angle, abs=0.01)


@pytest.mark.slow
def test_sets_hold_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(5)
    hits = 0
    for k in range(20):
        hz = float(rng.uniform(5, 120))
        found = find(seen((hz, 1.5, 0.7j), seed=k, count=80))
        hits += bool(found.sets) and any(part.low <= hz <= part.high for part in found.sets[0])
    assert hits >= 16


def test_moments_of_lines_are_those_of_sums_over_instants() -> None:
    lines = ((37.3, 3.0, 1.0), (11.2, 1.0, 2j))
    moments = seen(*lines, count=40)
    of = Vibration(moments)
    middle = float(moments.times_s.mean())
    made = [Line(hz, np.array([x, y]) * np.exp(2j * np.pi * hz * middle)) for hz, x, y in lines]
    mean = of.path_mean(made)
    assert np.abs(moments.mean[:, 0] - mean).max() < 5 * NOISE[0]
    assert np.abs(moments.spread[:, 0] - 0.3 - of.path_spread(made, mean)).max() < 5 * NOISE[1]
