"""Figures of synthesis, turbulence and wavefront reconstruction."""

from __future__ import annotations

import numpy as np

from aolink.estimation import make_estimator
from aolink.optics.frame import spots_density
from aolink.optics.kernel import pixel_mass
from aolink.optics.lenslets import Lenslets
from aolink.optics.sensor import Kernel
from aolink.optics.turbulence import FrozenFlow, Layer
from aolink.optics.wavefront import SpotReconstructor
from aolink.rig import load_rig, parse_rig
from aolink.simulation.model import simulate
from bench_rows.row import Effort, Row, median_s


def frame_synthesis(effort: Effort) -> Row:
    """Exposures of 30 x 30 spots on 16 x 16 pixels over 200 fast steps, against error functions at every step."""
    kernel, edges = Kernel(shape="gaussian", sigma=0.1), np.linspace(-1, 1, 17)
    path = np.cumsum(0.01 * np.random.default_rng(1).standard_normal((900, 2, 200)), axis=2)

    def plain() -> None:
        x, y = (pixel_mass(kernel, edges, path[:, direction]) for direction in (0, 1))
        np.matmul(y.swapaxes(1, 2), x)

    ours, theirs = (1 / each for each in median_s(lambda: spots_density(kernel, edges, path), effort.of(15), plain))
    return Row("frames of 900 spots, 200 fast steps", f"{ours:.0f}/s", f"20/s; erf {theirs:.0f}/s", ours / 20, 1)


def coupled_exposure(effort: Effort) -> Row:
    """An exposure of sh-30x30, one plant with 1800 slopes, with o1 and o3: measured, corrected, predicted."""
    rig = load_rig("sh-30x30")
    runs = effort.of(11)
    exposures = iter(simulate(rig, 1 + runs))
    estimators = [make_estimator(rig, name) for name in ("o1", "o3")]

    def step() -> None:
        exposure = next(exposures)
        for estimator in estimators:
            estimator.step(exposure)

    step()  # the exposure model is made once
    ours = median_s(step, runs)[0]
    return Row("o1 and o3 of one plant with 1800 slopes", f"{ours * 1e3:.0f} ms", "5 Hz: 200 ms", 0.2 / ours, 1)


def cost_against_lenslets(effort: Effort) -> Row:
    """Frames and o3 of 100 to 2500 spots: the cost of a spot among the fewest over that among the most."""

    def cost(side: int) -> float:
        rig = parse_rig(load_rig("sh-30x30").toml.replace("grid = [30, 30]", f"grid = [{side}, {side}]"))
        runs = effort.of(7)
        series, estimator = iter(simulate(rig, 1 + runs)), make_estimator(rig, "o3")

        def step() -> None:
            estimator.step(next(series))

        step()
        simulated = median_s(lambda: simulate(rig, 1), effort.of(3))[0]
        return (median_s(step, runs)[0] + simulated) / side**2

    few, many = cost(10), cost(50)
    figure = "cost against lenslets, 100 to 2500"
    return Row(figure, f"{many * 1e6:.0f} us a spot", f"{few * 1e6:.0f} us of 100", few / many, 0.7)


def turbulence(effort: Effort) -> Row:
    """Slopes of 30 x 30 lenslets in frozen flow: faster than a mirror's fast steps go by."""
    lenslets = Lenslets(grid=(30, 30), pitch_m=0.1, focal_length_m=1.0)
    flow = FrozenFlow(Layer(r0_m=0.15, wind_m_s=(8.0, 3.0)), np.random.default_rng(0), shortest_m=0.05)
    waves = flow.slope_waves(lenslets).reshape(1800, -1)
    both = np.concatenate([waves.real, -waves.imag], axis=1)

    def play() -> None:
        blown = flow.blown(1e-3 * np.arange(64, dtype=np.float64))
        both @ np.concatenate([blown.real, blown.imag])

    ours = 64 / median_s(play, effort.of(7))[0]
    return Row("turbulence, 1800 slopes", f"{ours / 1e3:.1f} k steps/s", "1 k steps/s", ours / 1e3, 1)


def zonal_wavefront(effort: Effort) -> Row:
    """The wavefront over 50 x 50 lenslets from their slopes, against the dense pseudo-inverse."""
    number = np.arange(2500).reshape(50, 50)
    pairs = ((number[:, :-1], number[:, 1:]), (number[:-1], number[1:]))
    edges = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])
    reconstruct = SpotReconstructor(np.argwhere(number >= 0)[:, ::-1].astype(np.float64), edges)
    slopes = np.random.default_rng(0).standard_normal((2500, 2))
    dense = np.random.default_rng(1).standard_normal((2500, 5000))  # its values do not matter to the time
    ours, theirs = median_s(lambda: reconstruct(slopes), effort.of(15), lambda: dense @ slopes.ravel())
    return Row("wavefront of 50x50 lenslets", f"{ours * 1e3:.2f} ms", f"dense {theirs * 1e3:.2f} ms", theirs / ours, 1)
