"""Restoration's rows: PSNR and time, beside scikit-image in the same run."""

from __future__ import annotations

import numpy as np
from skimage import restoration as peer

from aolink.restoration import METHODS, first_order, motion_psf, restore
from aolink.restoration.deblur import psnr
from aolink.restoration.markov import line_solver, make_solver
from aolink.restoration.shahin import smooth
from aolink.restoration.tv import total_variation
from bench_rows import peers
from bench_rows.pictures import FRESH, KERNEL, NOISE_SD, PICTURES, blurred, cases, paths, picture_size, psfs, quality
from bench_rows.row import Effort, Row, median_s

# Mean PSNR that each method has to reach on the seven pictures, dB.
_GOALS: dict[str, float] = {"smoother": 28.1, "gauss_markov": 28.8, "tv": 30.2, "pnp": 31.4}
# Most time that each may take at 512 x 512 on two threads, ms.
_LIMITS_MS = {"smoother": 15.0, "gauss_markov": 25.0, "tv": 200.0}


def restoration_quality(effort: Effort) -> list[Row]:
    """All methods on the seven pictures with noise and weights found by themselves; three other pictures."""
    rows = []
    blur = quality([(c.image, c.scene) for c in cases(PICTURES, effort)])
    others = {name: quality([(f(c), c.scene) for c in cases(PICTURES, effort)]) for name, f in peers.PADDED.items()}
    filled = {name: quality([(f(c), c.scene) for c in cases(PICTURES, effort)]) for name, f in peers.FILLED.items()}
    for name, found in (others | filled).items():
        rows.append(Row(f"{name}: mean PSNR", str(found), f"blurred {blur}", found.whole / blur.whole, 0))
    best_name = max(others, key=lambda name: others[name].whole)
    best = others[best_name].whole
    for method in METHODS:
        if method == "inverse":
            continue
        found = quality([(restore(c.image, c.psf, method=method).image, c.scene) for c in cases(PICTURES, effort)])
        goal = _GOALS.get(method, 0.0)
        rows.append(Row(f"restore {method}: mean PSNR, 7 pictures x 5 motions", str(found),
            f"{best_name} {best:.1f}; goal {goal:g}" if goal else f"{best_name} {best:.1f}",
            found.whole / (goal or best), 1 if goal else 0))  # fmt: skip
    fresh = {n: quality([(f(c), c.scene) for c in cases(FRESH, effort)]).whole for n, f in peers.PADDED.items()}
    for method in _GOALS:
        found = quality([(restore(c.image, c.psf, method=method).image, c.scene) for c in cases(FRESH, effort)])
        # A linear method beside the linear ones, one that keeps edges beside all.
        same_kind = {n: v for n, v in fresh.items() if "Wiener" in n or method in ("tv", "pnp")}
        top = max(same_kind, key=lambda name: fresh[name])
        rows.append(Row(f"restore {method}: {', '.join(FRESH)}", str(found), f"{top} {fresh[top]:.2f} dB",
            found.whole / fresh[top], 1))  # fmt: skip
    return rows


def restoration_uncertainty(effort: Effort) -> list[Row]:
    """The motion's range is wrong by one standard deviation: restoration with this uncertainty given, against without
    it."""
    rows, path = [], paths()["damped sinusoid"]
    for share in (0.02, 0.05):
        given = motion_psf(path, share**2 * np.outer(path, path), KERNEL, 1.0)
        sure = motion_psf(path, None, KERNEL, 1.0)
        for noise_sd in (0.002, NOISE_SD):
            for method in ("smoother", "gauss_markov", "tv"):
                found = np.empty((0, 3))
                for sign in (-1, 1):
                    true = motion_psf((1 + sign * share) * path, None, KERNEL, 1.0)
                    for name in PICTURES[: effort.of(len(PICTURES))]:
                        case = blurred(name, true, picture_size(effort), noise_sd=noise_sd)
                        each = [
                            psnr(restore(case.image, p, method=method, noise_sd=noise_sd).image, case.scene)
                            for p in (given, sure, true)
                        ]
                        found = np.vstack([found, each])
                knowing, believing, exact = found.mean(axis=0)
                name = f"{method}, range off by {share:.0%}, noise {noise_sd:g}: range error stated"
                rows.append(Row(name, f"{knowing:.2f} dB",
                    f"not stated: {believing:.2f}; no error {exact:.2f}", knowing / believing, 1))  # fmt: skip
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
