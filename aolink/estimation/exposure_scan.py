"""The choice of the exposure time: the expected error of o1, from covariances alone, without a single frame.

Everything is linear: o1 multiplies a centroid's innovation by a constant gain, and the process noise moves the
centroid, the path and the end state together. So the true covariance of o1's error follows from a recursion of its
own, which includes what o1 itself leaves out: the process noise within the exposure.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from aolink.errors import EstimatorError
from aolink.estimation.frames.centroid_noise import centroid_covariance
from aolink.estimation.kalman.steady_gain import steady_gain
from aolink.estimation.model.exposure_model import exposure_model
from aolink.numerics.arrays import FloatArray
from aolink.numerics.covariance import psd_root
from aolink.plant.alike import MANY_STATES
from aolink.plant.lifting import lift
from aolink.rig import Rig

_MOST_OUTPUTS = 256
_LONGEST = 20_000


@dataclass(frozen=True, kw_only=True)
class ExpectedError:
    """Expected errors at one exposure time, in steady state; root mean squares over outputs and steps."""

    exposure_steps: int
    path_rms: float
    """Error of o1's path within an exposure, slope units."""
    end_rms: float
    """Error of the output one step after the exposure, slope units: what a controller acts on."""
    noise_rms: float
    """Standard deviation of the centroid by read-out and shot noise, slope units."""


def candidates(rig: Rig) -> list[int]:
    """Exposure times in fast steps, from a sixteenth of the rig's own to four times that."""
    own = rig.timing.exposure_steps
    steps = {max(1, round(own * 2 ** (k / 2))) for k in range(-8, 5)}
    return sorted(n for n in steps if n <= _LONGEST)


def with_exposure(rig: Rig, exposure_steps: int) -> Rig:
    """The rig with another exposure time: the same dead time, and light in proportion.

    A pixel's read-out noise stays the same in counts, so V, the noise of a density of unit mass, is divided by the
    square of the light's factor.
    """
    timing, sensor = rig.timing, rig.sensor
    light = exposure_steps / timing.exposure_steps
    dead = timing.frame_period_steps - timing.exposure_steps
    return replace(
        rig,
        timing=replace(timing, exposure_steps=exposure_steps, frame_period_steps=exposure_steps + dead),
        sensor=replace(
            sensor, noise_density=sensor.noise_density / light**2, photoelectrons=sensor.photoelectrons * light,
            counts_per_density=sensor.counts_per_density * light,
        ),
    )  # fmt: skip


def exposure_scan(rig: Rig, steps: Iterable[int] | None = None) -> list[ExpectedError]:
    """Expected errors of o1 over exposure times in fast steps, `candidates` where None.

    Raises `EstimatorError` where the plant has too many outputs or states, or an undamped mode that the centroid does
    not observe.
    """
    if rig.plant.n_outputs > _MOST_OUTPUTS:
        raise EstimatorError(f"an exposure scan takes {_MOST_OUTPUTS} outputs at most, {rig.name} has more")
    if rig.plant.n_states > MANY_STATES:
        raise EstimatorError(
            f"an exposure scan takes {MANY_STATES} states of one plant at most, {rig.name} has {rig.plant.n_states}:"
            " scan one with fewer actuators"
        )
    return [_expected(with_exposure(rig, n)) for n in (candidates(rig) if steps is None else steps)]


def best(errors: Iterable[ExpectedError]) -> ExpectedError:
    """The exposure time with the smallest path error."""
    return min(errors, key=lambda e: e.path_rms)


def _expected(rig: Rig) -> ExpectedError:
    """The expected errors over all copies of the plant; copies whose spots have the same light are computed once."""
    noises, counts = np.unique(centroid_covariance(rig), axis=0, return_counts=True)
    each = [_expected_of(rig, linalg.block_diag(*noise)) for noise in noises]
    squares = np.array([[e.path_rms**2, e.end_rms**2, e.noise_rms**2] for e in each])
    path, end, noise = np.sqrt(counts @ squares / counts.sum()).tolist()
    return ExpectedError(exposure_steps=rig.timing.exposure_steps, path_rms=path, end_rms=end, noise_rms=noise)


def _expected_of(rig: Rig, R: FloatArray) -> ExpectedError:
    plant, n = rig.plant, rig.timing.exposure_steps
    plant = replace(plant, delays=()) if plant.delays else plant
    model = exposure_model(plant, n)
    H, F = model.mean_row, model.transition
    K = steady_gain(model, model.process_noise, R)
    if K is None:
        raise EstimatorError(
            f"exposures of {n} fast steps do not observe an eigenmode that does not decay: o1 has no steady state;"
            " `aolink rig --check` says which eigenmode"
        )
    # Effect of a unit of noise in one step on the outputs k steps later, on the centroid and on the end state.
    root = plant.B_w @ psd_root(plant.process_noise)
    impulse = np.concatenate([np.zeros((plant.n_outputs, 1, root.shape[1])), model.state_rows[:, :-1] @ root], axis=1)
    on_centroid = np.cumsum(impulse, axis=1)[:, ::-1] / n  # (n_outputs, step of the noise, noises)
    on_end = np.empty((n, plant.n_states, root.shape[1]))
    on_end[-1] = root
    for j in range(n - 2, -1, -1):
        on_end[j] = plant.A @ on_end[j + 1]
    centroid_end = np.einsum("ojw,jsw->os", on_centroid, on_end)
    centroid_noise_path = np.einsum("ojw,pjw->op", on_centroid, on_centroid)
    keep = np.eye(plant.n_states) - K @ H
    scatter = K @ (R + centroid_noise_path) @ K.T
    over_gap, gap_noise = lift(plant, rig.timing.frame_period_steps - n)
    # e' = G (F keep e - F K (nu + v) + w) + gap noise, nu and w from the same noise.
    cross = F @ K @ centroid_end
    added = F @ scatter @ F.T + model.process_noise - cross - cross.T
    step = over_gap @ F @ keep
    before = linalg.solve_discrete_lyapunov(step, over_gap @ added @ over_gap.T + gap_noise)
    start = keep @ before @ keep.T + scatter
    end = F @ keep @ before @ keep.T @ F.T + added
    path = np.einsum("ois,st,oit->oi", model.state_rows, start, model.state_rows)
    path += np.cumsum((impulse**2).sum(axis=2), axis=1)
    gained = np.einsum("ois,sp->oip", model.state_rows, K)  # rows of the path for each centroid
    for o in range(plant.n_outputs):
        # cov(nu, noise path at i) = sum_j m_j h_(i-j).
        both = sum(
            np.stack([np.convolve(on_centroid[p, :, w], impulse[o, :, w])[:n] for p in range(plant.n_outputs)], axis=1)
            for w in range(root.shape[1])
        )
        path[o] -= 2 * (gained[o] * both).sum(axis=1)
    end_outputs = np.einsum("os,st,ot->o", plant.C, end, plant.C)
    return ExpectedError(
        exposure_steps=n,
        path_rms=math.sqrt(max(float(path.mean()), 0.0)),
        end_rms=math.sqrt(max(float(end_outputs.mean()), 0.0)),
        noise_rms=math.sqrt(float(np.diag(R).mean())),
    )
