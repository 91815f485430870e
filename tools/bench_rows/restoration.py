"""Restoration's rows: PSNR and time, beside scikit-image and SCICO in the same run."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from skimage import color, data, transform
from skimage import restoration as peer

from aolink.numerics.arrays import FloatArray
from aolink.optics.sensor import Kernel
from aolink.restoration import METHODS, Psf, first_order, motion_psf, restore
from aolink.restoration.deblur import psnr
from aolink.restoration.markov import line_solver, make_solver
from aolink.restoration.shahin import smooth
from aolink.restoration.tv import total_variation
from aolink.rig import load_rig
from bench_rows.row import Effort, Row, median_s

PICTURES = ("camera", "astronaut", "brick", "coins", "text", "moon", "page")
FRESH = ("chelsea", "coffee", "rocket")
"""Other pictures than those of `PICTURES`."""
SHAKEN = ("camera", "chelsea", "coins")
KERNELS = Path(__file__).parents[2] / "tests" / "data" / "levin09_kernels.npz"
NOISE_SD = 0.01
KERNEL = Kernel(shape="gaussian", sigma=0.3)
_MARGIN, _PAD = 44, 40
_GOALS: dict[str, float] = {"smoother": 28.1, "gauss_markov": 28.8, "tv": 30.2, "pnp": 31.4}
"""Mean PSNR that each method has to reach on the seven pictures, dB."""
_LIMITS_MS = {"smoother": 15.0, "gauss_markov": 25.0, "tv": 200.0}
"""Most time that each may take at 512 x 512 on two threads, ms."""
_WEIGHTS = (5e-4, 1e-3, 2e-3)
"""Weights of SCICO's total variation, for a data term of half the squared residual."""
_PENALTIES = (0.01, 0.02, 0.05)
"""Penalties of SCICO's plug and play."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """A blurred picture and its scene."""

    image: FloatArray
    scene: FloatArray
    psf: Psf


def _centred(values: FloatArray) -> Psf:
    """The PSF with an odd number of taps about the origin, as the peers expect it."""
    values = np.concatenate([np.zeros(1 - len(values) % 2), values])
    return Psf(values=values, origin=(len(values) // 2,))


def paths() -> dict[str, FloatArray]:
    """Motions over an exposure, 20 pixels wide."""
    t, rig = np.linspace(0, 1, 200), load_rig("section-vi")
    damped = np.exp(-1.5 * t) * np.sin(3 * math.pi * t)
    state, response = np.array([0.0, 1.0]), np.empty(200)
    for k in range(200):
        response[k] = state[0]
        state = rig.plant.A @ state
    return {name: 20 * p / np.ptp(p) for name, p in (("damped sinusoid", damped), ("plant's response", response))}


def psfs() -> dict[str, Psf]:
    """PSFs that are uniform over 9, 15 and 31 pixels, and those of the two paths."""
    moved = {
        name: _centred(np.trim_zeros(motion_psf(path, None, KERNEL, 1.0).values)) for name, path in paths().items()
    }
    return {**{f"uniform {n}": _centred(np.full(n, 1 / n)) for n in (9, 15, 31)}, **moved}


def wide_scene(name: str, size: int = 256) -> FloatArray:
    """A picture ``size`` high, and wider by a margin, grey in [0, 1]."""
    image = getattr(data, name)() / 255.0
    if image.ndim == 3:
        image = color.rgb2gray(image[..., :3])
    rows, columns = image.shape
    scale = max(size / rows, (size + _MARGIN) / columns)
    shape = (math.ceil(rows * scale), math.ceil(columns * scale))
    image = transform.resize(image, shape, anti_aliasing=scale < 1)
    top, left = (shape[0] - size) // 2, (shape[1] - size - _MARGIN) // 2
    return np.asarray(image[top : top + size, left : left + size + _MARGIN])


def blurred(name: str, psf: Psf, size: int = 256) -> Case:
    """The picture of a scene that continues beyond the frame."""
    scene, (origin,), first = wide_scene(name, size), psf.origin, _MARGIN // 2
    image = np.zeros((size, size))
    for j, tap in enumerate(psf.values):
        start = first + origin - j
        image += tap * scene[:, start : start + size]
    image += NOISE_SD * np.random.default_rng(0).standard_normal(image.shape)
    return Case(image=image, scene=scene[:, first : first + size], psf=psf)


def cases(names: tuple[str, ...], effort: Effort) -> Iterator[Case]:
    """Every picture with every PSF; with less effort fewer and smaller ones."""
    motions = list(psfs().values())
    for psf in motions[: effort.of(len(motions))]:
        for name in names[: effort.of(len(names))]:
            yield blurred(name, psf, picture_size(effort))


def picture_size(effort: Effort, whole: int = 256) -> int:
    """Rows of a picture, enough for the widest motion."""
    return effort.of(whole, 96)


def _quality(name: str, pictures: tuple[str, ...], effort: Effort) -> float:
    """Mean PSNR of what a method makes of all pictures, dB; an empty name is the blurred picture."""
    work = PEERS.get(name) or (lambda case: restore(case.image, case.psf, method=name).image if name else case.image)
    return float(np.mean([psnr(work(case), case.scene) for case in cases(pictures, effort)]))


def _padded(image: FloatArray) -> FloatArray:
    return np.pad(image, _PAD, mode="reflect")


def _best(case: Case, made: list[FloatArray]) -> FloatArray:
    """The best of several, with the scene in hand, without what was padded."""
    return max((image[_PAD:-_PAD, _PAD:-_PAD] for image in made), key=lambda image: psnr(image, case.scene))


def wiener(case: Case) -> FloatArray:
    """Wiener's filter with the best of many balances."""
    wide, taps = _padded(case.image), case.psf.values[None]
    return _best(case, [peer.wiener(wide, taps, b, clip=False) for b in np.geomspace(1e-4, 3, 19)])


def richardson_lucy(case: Case) -> FloatArray:
    """Richardson-Lucy with the best of several numbers of iterations."""
    wide, taps = np.maximum(_padded(case.image), 1e-6), case.psf.values[None]
    return _best(case, [peer.richardson_lucy(wide, taps, n, clip=False) for n in (3, 6, 12, 25, 50, 100)])


PEERS: dict[str, Callable[[Case], FloatArray]] = {
    "Wiener, padded, oracle": wiener, "Richardson-Lucy, padded, oracle": richardson_lucy,
}  # fmt: skip


def restoration_quality(effort: Effort) -> list[Row]:
    """All methods on the seven pictures, and on three others, with noise and weights found by themselves."""
    rows = []
    for pictures in (PICTURES, FRESH):
        blur = _quality("", pictures, effort)
        others = {name: _quality(name, pictures, effort) for name in PEERS}
        best = max(others, key=lambda name: others[name])
        for method in METHODS:
            if method == "inverse" or (pictures is FRESH and method not in _GOALS):
                continue
            found = _quality(method, pictures, effort)
            goal = _GOALS.get(method, 0.0) if pictures is PICTURES else others[best]
            peers = f"{best} {others[best]:.2f}; blurred {blur:.2f}; goal {goal:.1f}"
            figure = f"restore {method}: mean PSNR, {len(pictures)} pictures x 5 motions"
            rows.append(Row(figure, f"{found:.2f} dB", peers, found / (goal or blur), 1))
    return rows


def restoration_time(effort: Effort) -> list[Row]:
    """The time with given weights; the Gauss-Markov solver of the PSF is made before."""
    size = picture_size(effort, 512)
    case = blurred("camera", psfs()["uniform 15"], size)
    image, psf, variance, weight = case.image, case.psf, NOISE_SD**2, 80.0
    solver = line_solver(psf, (size, size), weight * variance)

    def gauss_markov() -> None:
        solver.solve(solver.project(image[None]))

    def tv() -> None:
        total_variation(
            lambda kappa: make_solver(psf, (size, size), kappa, single=True), image[None], variance, weight
        )  # fmt: skip

    ours = {
        "smoother": lambda: smooth(image, psf.values, first_order(0.9, 0.05), variance),
        "gauss_markov": gauss_markov,
        "tv": tv,
    }
    positive = np.maximum(image, 1e-6)
    taps = psf.values[None]
    theirs = {
        "Wiener": lambda: peer.wiener(image, taps, 0.1, clip=False),
        "Richardson-Lucy 25": lambda: peer.richardson_lucy(positive, taps, num_iter=25, clip=False),
    }
    rows = []
    for method, work in ours.items():
        work()
        times = {name: median_s(work, effort.of(15), other) for name, other in theirs.items()}
        mine = 1e3 * min(t[0] for t in times.values())
        beside = ", ".join(f"{name} {1e3 * t[1]:.1f}" for name, t in times.items())
        limit = _LIMITS_MS[method]
        rows.append(Row(f"{method} at {size} x {size}{', solver made before' if method == 'gauss_markov' else ''}",
            f"{mine:.1f} ms", f"{limit:g} ms; {beside}", limit / mine, 1))  # fmt: skip
    return rows


def shaken_cases(effort: Effort) -> Iterator[Case]:
    """All kernels and pictures, whose scenes go on beyond the frame; with less effort fewer and smaller ones."""
    kernels, size = np.load(KERNELS), effort.of(256, 64)
    names = sorted(kernels)
    for name in names[: effort.of(len(names))]:
        kernel = kernels[name]
        reach = len(kernel) // 2
        inside = (slice(reach, -reach), slice(reach, -reach))
        for picture in SHAKEN[: effort.of(len(SHAKEN))]:
            wide = wide_scene(picture, size + 2 * reach)[:, : size + 2 * reach]
            image = ndimage.convolve(wide, kernel)[inside]
            image = image + NOISE_SD * np.random.default_rng(0).standard_normal(image.shape)
            yield Case(image=image, scene=wide[inside], psf=Psf(values=kernel, origin=(reach, reach)))


def shaken(effort: Effort) -> list[Row]:
    """`tv` and `pnp`, which choose their weights, beside SCICO's TV and its PnP with six layers, whose parameters are
    chosen with the scene in hand; processor times."""
    rows, some = [], list(shaken_cases(effort))
    for method, theirs, parameters, factor in (("tv", _variation, _WEIGHTS, 10), ("pnp", _network, _PENALTIES, 1)):
        found = []
        for case in some:
            mine, seconds = _scored(case, lambda case: restore(case.image, case.psf, method=method).image)  # noqa: B023
            theirs(case, parameters[0])  # the first call compiles
            best = max(_scored(case, lambda case: theirs(case, each)) for each in parameters)  # noqa: B023
            found.append((mine, best[0], seconds, best[1]))
        psnr_ours, psnr_theirs, s_ours, s_theirs = np.mean(found, axis=0)
        name = f"{method}, camera shake, {len(some)} pictures"
        quality = f"{name}: mean PSNR", f"{psnr_ours:.2f} dB", f"SCICO {psnr_theirs:.2f} dB"
        spent = f"{name}: time", f"{s_ours:.2f} s", f"SCICO {s_theirs:.2f} s"
        rows += [Row(*quality, psnr_ours / psnr_theirs, 1), Row(*spent, s_theirs / s_ours, factor)]
    return rows


def _scored(case: Case, work: Callable[[Case], FloatArray]) -> tuple[float, float]:
    """PSNR, dB, and processor time, s."""
    start = time.process_time()
    image = work(case)
    return psnr(image, case.scene), time.process_time() - start


def _problem(case: Case) -> tuple[Any, dict[str, Any], tuple[slice, slice]]:
    """SCICO on one thread, what its ADMM is given whatever the prior is, and where the frame lies in the scene."""
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    import scico.functional
    import scico.linop
    import scico.loss
    import scico.numpy
    import scico.optimize.admm

    image, kernel = (scico.numpy.array(each.astype(np.float32)) for each in (case.image, case.psf.values))
    reach = len(kernel) // 2
    shape = tuple(n + 2 * reach for n in case.image.shape)
    blur = scico.linop.CircularConvolve(h=kernel, input_shape=shape, h_center=scico.numpy.array([reach, reach]))
    crop = scico.linop.Crop([(reach, reach), (reach, reach)], shape)
    common = {
        "f": scico.loss.SquaredL2Loss(y=image, A=crop @ blur), "x0": scico.numpy.pad(image, reach, mode="edge"),
        "subproblem_solver": scico.optimize.admm.LinearSubproblemSolver(cg_kwargs={"tol": 1e-3, "maxiter": 25}),
    }  # fmt: skip
    return scico, common, (slice(reach, -reach), slice(reach, -reach))


def _variation(case: Case, weight: float) -> FloatArray:
    scico, common, frame = _problem(case)
    solver = scico.optimize.admm.ADMM(
        g_list=[weight * scico.functional.L21Norm()], rho_list=[20 * weight], maxiter=50,
        C_list=[scico.linop.FiniteDifference(common["x0"].shape, append=0)], **common,
    )  # fmt: skip
    return np.asarray(solver.solve(), np.float64)[frame]


def _network(case: Case, penalty: float) -> FloatArray:
    scico, common, frame = _problem(case)
    solver = scico.optimize.admm.ADMM(
        g_list=[scico.functional.DnCNN("6L")], rho_list=[penalty], maxiter=12,
        C_list=[scico.linop.Identity(common["x0"].shape)], **common,
    )  # fmt: skip
    return np.clip(np.asarray(solver.solve(), np.float64)[frame], 0, 1)
