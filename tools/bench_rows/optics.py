"""Figures of synthesis, turbulence and wavefront reconstruction."""

from __future__ import annotations

import numpy as np

from bench_rows.row import Row, median_s


def frame_synthesis() -> Row:
    """Exposures of 30 x 30 spots on 16 x 16 pixels over 200 fast steps, against error functions at every step."""
    from aolink.optics.frame import spots_density
    from aolink.optics.kernel import pixel_mass
    from aolink.rig import Kernel

    kernel, edges = Kernel(shape="gaussian", sigma=0.1), np.linspace(-1, 1, 17)
    path = np.cumsum(0.01 * np.random.default_rng(1).standard_normal((900, 2, 200)), axis=2)

    def plain() -> None:
        x, y = (pixel_mass(kernel, edges, path[:, direction]) for direction in (0, 1))
        np.matmul(y.swapaxes(1, 2), x)

    ours, theirs = (1 / each for each in median_s(lambda: spots_density(kernel, edges, path), 15, plain))
    return Row("frames of 900 spots, 200 fast steps", f"{ours:.0f}/s", f"20/s; erf {theirs:.0f}/s", ours / 20, 1)


def diffraction_synthesis() -> Row:
    """Frames of 900 spots whose kernel is a lenslet's diffraction."""
    from aolink.optics.synthesis import Psi, spot_windows

    path = 7.5 + np.cumsum(np.random.default_rng(0).normal(0, 0.05, (900, 2, 200)), axis=2)
    psi = Psi(shape="sinc2", zero_px=2.0)
    spot_windows(psi, 16, path)
    ours = 1 / median_s(lambda: spot_windows(psi, 16, path), 5)[0]
    return Row("frames of 900 diffraction spots", f"{ours:.0f}/s", "20/s", ours / 20, 1)


def turbulence() -> Row:
    """Slopes of 30 x 30 lenslets in frozen flow: faster than a mirror's fast steps go by."""
    from aolink.optics.lenslets import Lenslets
    from aolink.optics.turbulence import FrozenFlow, Layer

    lenslets = Lenslets(grid=(30, 30), pitch_m=0.1, focal_length_m=1.0)
    flow = FrozenFlow(Layer(r0_m=0.15, wind_m_s=(8.0, 3.0)), np.random.default_rng(0), shortest_m=0.05)
    waves = flow.slope_waves(lenslets).reshape(1800, -1)
    both = np.concatenate([waves.real, -waves.imag], axis=1)

    def play() -> None:
        blown = flow.blown(np.arange(64) * 1e-3)
        both @ np.concatenate([blown.real, blown.imag])

    ours = 64 / median_s(play, 7)[0]
    return Row("turbulence, 1800 slopes", f"{ours / 1e3:.1f} k steps/s", "1 k steps/s", ours / 1e3, 1)


def zonal_wavefront() -> Row:
    """The wavefront over 50 x 50 lenslets from their slopes, against the dense pseudo-inverse."""
    from aolink.optics.wavefront import ZonalReconstructor

    reconstruct = ZonalReconstructor(np.ones((50, 50), dtype=bool), 1.0)
    slopes = np.random.default_rng(0).standard_normal((50, 50, 2))
    dense = np.random.default_rng(1).standard_normal((2500, 5000))  # its values do not matter to the time
    ours, theirs = median_s(lambda: reconstruct(slopes), 15, lambda: dense @ slopes.ravel())
    return Row("wavefront of 50x50 lenslets", f"{ours * 1e3:.2f} ms", f"dense {theirs * 1e3:.2f} ms", theirs / ours, 1)
