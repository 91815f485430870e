"""A rig's disturbance as slopes at each fast step."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from aolink.errors import RigError
from aolink.limits import load_table
from aolink.numerics.arrays import FloatArray
from aolink.optics.turbulence import FrozenFlow
from aolink.optics.wavefront import lenslet_zernike_slopes
from aolink.rig import Rig

# Steps are made in blocks that begin at multiples of this, so that no bit depends on which steps are asked for.
_BLOCK = 64
# The shortest wave of turbulence, in lenslets: the mean slope over a lenslet hardly depends on shorter ones.
_SHORTEST = 0.5


class DisturbancePlayer:
    """Slopes that a rig's disturbance adds, at any fast step."""

    def __init__(self, rig: Rig, rng: np.random.Generator) -> None:
        assert rig.disturbance is not None
        disturbance = rig.disturbance
        self._step_s = rig.timing.fast_step_s
        self._still = np.zeros(rig.n_outputs)
        directions = np.tile(np.eye(2), (-(-rig.n_outputs // 2), 1))[: rig.n_outputs]
        self._vibrations = [
            (vibration.frequency_hz, rng.uniform(0, 2 * math.pi), directions @ vibration.amplitude)
            for vibration in disturbance.vibrations
        ]
        self._layers: list[tuple[FrozenFlow, FloatArray]] = []
        optics = rig.optics
        if optics is not None and len(disturbance.zernike_m):
            indices, metres = disturbance.zernike_m.T
            modes = lenslet_zernike_slopes(optics.lenslets, int(indices.max()))
            some = modes[optics.lit][..., indices.astype(int) - 2] @ metres
            self._still = some.reshape(-1) / optics.slope_unit_rad
        if optics is not None:
            lenslets = optics.seen(disturbance.pupil_m) if disturbance.layers else optics.lenslets
            for layer in disturbance.layers:
                flow = FrozenFlow(layer, rng, shortest_m=_SHORTEST * lenslets.pitch_m)
                waves = flow.slope_waves(lenslets)[optics.lit].reshape(rig.n_outputs, -1)
                # Re(w t) = Re w Re t - Im w Im t, as one real product.
                both = optics.slopes(np.concatenate([waves.real, -waves.imag], axis=1), disturbance.pupil_m)
                self._layers.append((flow, both))
        self._recorded = _recorded(rig, disturbance.recorded) if disturbance.recorded else None
        self._block = lru_cache(maxsize=4)(self._make)

    def slopes(self, first_step: int, n_steps: int) -> FloatArray:
        """Added slopes at the fast steps from ``first_step``, slope units, (n_steps, n_outputs)."""
        first, last = first_step // _BLOCK, (first_step + n_steps - 1) // _BLOCK
        blocks = np.concatenate([self._block(k) for k in range(first, last + 1)])
        return blocks[first_step - first * _BLOCK :][:n_steps]

    def _make(self, block: int) -> FloatArray:
        steps = np.arange(block * _BLOCK, (block + 1) * _BLOCK)
        times = self._step_s * steps.astype(np.float64)
        slopes = np.tile(self._still, (_BLOCK, 1))
        for frequency, phase, amplitude in self._vibrations:
            slopes += np.sin(2 * math.pi * frequency * times + phase)[:, None] * amplitude
        for flow, waves in self._layers:
            blown = flow.blown(times)
            slopes += (waves @ np.concatenate([blown.real, blown.imag])).T
        if self._recorded is not None:
            slopes += self._recorded[steps % len(self._recorded)]
        return slopes


def _recorded(rig: Rig, name: str) -> FloatArray:
    """Slopes from a .npy, .npz (its only array) or .csv file; a relative path starts at the rig file's folder."""
    path = rig.path_of(name, "disturbance.recorded")
    try:
        slopes = load_table(path)
    except OSError as error:
        raise RigError(f"disturbance.recorded: cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    except (ValueError, EOFError) as error:
        raise RigError(f"disturbance.recorded: {path} holds no numbers: {error}") from None
    if slopes.ndim != 2 or slopes.shape[1] != rig.n_outputs or not len(slopes) or not np.isfinite(slopes).all():
        raise RigError(
            f"disturbance.recorded: {path} has the shape {slopes.shape}, expected finite numbers, a row for each fast"
            f" step and {rig.n_outputs} columns, one a slope"
        )
    return slopes
