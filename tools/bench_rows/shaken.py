"""Pictures blurred by camera shake: PSNR and time beside SCICO, whose parameters are chosen with the truth."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from aolink.numerics.arrays import FloatArray
from aolink.restoration import Psf, restore
from aolink.restoration.deblur import psnr
from bench_rows.pictures import NOISE_SD, wide_scene
from bench_rows.row import Effort, PeerMissing, Row

Solve = Callable[["Shaken", float], FloatArray]

PICTURES = ("camera", "chelsea", "coins")
BORDERS = ("circular", "true")
KERNELS = Path(__file__).parents[2] / "tests" / "data" / "levin09_kernels.npz"
_WEIGHTS = (5e-4, 1e-3, 2e-3)
"""Weights of SCICO's total variation, for a data term of half the squared residual."""
_PENALTIES = (0.01, 0.02, 0.05)
"""Penalties of SCICO's plug and play."""
_SIZE = 256


@dataclass(frozen=True, kw_only=True, eq=False)
class Shaken:
    """A blurred picture and its scene."""

    image: FloatArray
    scene: FloatArray
    kernel: FloatArray
    circular: bool
    """Whether the scene is periodic, which both methods are then given."""

    @property
    def reach(self) -> int:
        return len(self.kernel) // 2


def cases(border: str, effort: Effort) -> Iterator[Shaken]:
    """All kernels and pictures; with less effort fewer and smaller ones."""
    kernels, size = np.load(KERNELS), effort.of(_SIZE, 64)
    names = sorted(kernels)
    for name in names[: effort.of(len(names))]:
        kernel = kernels[name]
        reach = len(kernel) // 2
        for picture in PICTURES[: effort.of(len(PICTURES))]:
            wide = wide_scene(picture, size + 2 * reach)[:, : size + 2 * reach]
            inside = (slice(reach, -reach), slice(reach, -reach))
            scene = wide[inside]
            image = ndimage.convolve(scene if border == "circular" else wide, kernel, mode="wrap")
            image = image if border == "circular" else image[inside]
            image = image + NOISE_SD * np.random.default_rng(0).standard_normal(image.shape)
            yield Shaken(image=image, scene=scene, kernel=kernel, circular=border == "circular")


def shaken(effort: Effort) -> list[Row]:
    """`tv` and `pnp`, which choose their weights, beside SCICO's TV and its PnP with six layers; processor times."""
    rows = []
    for border in BORDERS:
        some = list(cases(border, effort))
        for method, peer, parameters, factor in (("tv", _variation, _WEIGHTS, 10), ("pnp", _network, _PENALTIES, 1)):
            found = np.array([_both(case, method, peer, parameters) for case in some])
            ours, theirs, our_s, their_s = found.mean(axis=0)
            name = f"{method}, camera shake, {border} border, {len(some)} pictures"
            quality = f"{name}: mean PSNR", f"{ours:.2f} dB", f"SCICO {theirs:.2f} dB"
            seconds = f"{name}: time", f"{our_s:.2f} s", f"SCICO {their_s:.2f} s"
            rows += [Row(*quality, ours / theirs, 1), Row(*seconds, their_s / our_s, factor)]
    return rows


def _both(case: Shaken, method: str, peer: Solve, parameters: tuple[float, ...]) -> tuple[float, float, float, float]:
    """PSNRs and processor times, ours and the peer's at the best of its parameters."""
    mine, seconds = _timed(lambda: _ours(case, method))
    peer(case, parameters[0])  # the first call compiles
    best = max((psnr(*found), -s) for p in parameters for found, s in [_scored(case, peer, p)])
    return psnr(mine, case.scene), best[0], seconds, -best[1]


def _scored(case: Shaken, peer: Solve, parameter: float) -> tuple[tuple[FloatArray, FloatArray], float]:
    found, seconds = _timed(lambda: peer(case, parameter))
    return (found, case.scene), seconds


def _timed(work: Callable[[], FloatArray]) -> tuple[FloatArray, float]:
    start = time.process_time()
    return work(), time.process_time() - start


def _ours(case: Shaken, method: str) -> FloatArray:
    psf = Psf(values=case.kernel, origin=(case.reach, case.reach))
    # The picture of a periodic scene is known beyond the frame.
    pad = 2 * case.reach if case.circular else 0
    found = restore(np.pad(case.image, pad, mode="wrap"), psf, method=method).image
    return np.asarray(found[pad : len(found) - pad, pad : found.shape[1] - pad])


def _scico() -> Any:
    """SCICO on one thread. Raises PeerMissing with the command that installs it."""
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    try:
        import scico.functional
        import scico.linop
        import scico.loss
        import scico.numpy
        import scico.optimize.admm
    except ModuleNotFoundError:
        lock = "tools/locks/peers.txt"
        raise PeerMissing(f"SCICO is missing: .venv/bin/uv pip install -r {lock}") from None
    return scico


def _problem(case: Shaken) -> tuple[Any, Any, Any, dict[str, Any], tuple[slice, slice]]:
    """SCICO, its loss, a first scene, the linear steps, and where the frame lies in the scene."""
    scico, reach = _scico(), case.reach
    image, kernel = (scico.numpy.array(each.astype(np.float32)) for each in (case.image, case.kernel))
    pad = 0 if case.circular else reach
    shape = tuple(n + 2 * pad for n in case.image.shape)
    blur = scico.linop.CircularConvolve(h=kernel, input_shape=shape, h_center=scico.numpy.array([reach, reach]))
    admm = scico.optimize.admm
    if case.circular:
        step = admm.CircularConvolveSolver()
    else:
        blur = scico.linop.Crop([(pad, pad), (pad, pad)], shape) @ blur
        step = admm.LinearSubproblemSolver(cg_kwargs={"tol": 1e-3, "maxiter": 25})
    frame = (slice(pad, shape[0] - pad), slice(pad, shape[1] - pad))
    first = scico.numpy.pad(image, pad, mode="edge")
    return scico, scico.loss.SquaredL2Loss(y=image, A=blur), first, {"subproblem_solver": step}, frame


def _variation(case: Shaken, weight: float) -> FloatArray:
    scico, loss, first, step, frame = _problem(case)
    differences = scico.linop.FiniteDifference(first.shape, **({"circular": True} if case.circular else {"append": 0}))
    solver = scico.optimize.admm.ADMM(
        f=loss, g_list=[weight * scico.functional.L21Norm()], C_list=[differences],
        rho_list=[weight * (60 if case.circular else 20)], x0=first, maxiter=50, **step,
    )  # fmt: skip
    return np.asarray(solver.solve(), np.float64)[frame]


def _network(case: Shaken, penalty: float) -> FloatArray:
    scico, loss, first, step, frame = _problem(case)
    solver = scico.optimize.admm.ADMM(
        f=loss, g_list=[scico.functional.DnCNN("6L")], C_list=[scico.linop.Identity(first.shape)], rho_list=[penalty],
        x0=first, maxiter=12, **step,
    )  # fmt: skip
    return np.clip(np.asarray(solver.solve(), np.float64)[frame], 0, 1)
