"""What there is to choose about an estimator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from aolink.estimation.frames.moments import Flux
from aolink.estimation.kalman.filter import Noise
from aolink.estimation.moments.windowed import Basis

Engine = Literal["aolink", "filterpy"]


@dataclass(frozen=True)
class Options:
    """Choices that the paper leaves open."""

    gain: str = "steady-state"
    """Of o1: "steady-state", or "time-varying", which a plant without a steady-state gain always gets."""
    process_noise: Noise = "lifted"
    """Noise that an exposure adds to the state: "lifted", or "printed" for the paper's B_w W B_w'."""
    flux: Flux = "known"
    """"known": the light of a frame sums to one; "measured": moments are divided by what it sums to."""
    gate: bool = True
    """Whether measurements that cannot be believed are left out."""
    engine: Engine = "aolink"
    """What o1 to o3 run on: "aolink", or "filterpy", for one axis."""
    orders: tuple[int, ...] = (0, 1, 2, 3)
    """Of `moments`: which functions of the basis; 0 is the light in the window."""
    basis: Basis = "monomial"
    """Of `moments`: "monomial", "legendre" or "fourier"."""
    particles: int = 3000
    """Of `sampled`."""
    seed: int = 0
    """Of `sampled`: the same one gives the same estimates, bit for bit."""
