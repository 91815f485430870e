"""Shahin's own example run again: a bright square, blurred along its rows, and restored by his filters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from aolink.numerics.arrays import FloatArray
from aolink.restoration import Psf, Scanner, first_order, largest_zero, restore
from paper_report.blocks import Block, Heading, PageFigure, Points, Table, Text, write_page

# Values that he does not print: the blur and the noise's variances.
BLUR = 5
NOISE_VARIANCES = (0.01, 0.1, 1.0)
SHOWN = 0.1
FACTORS = (0.1, 1.0, 10.0)
RUNS = 20

ALPHA = np.array([
    [0.996, 0, 0, 0, 0],
    [0, 0.983, 0.031, 0, 0],
    [0, -1.22, 0.97, 0, 0],
    [0, 0, 0, 0.926, 0.03],
    [0, 0, 0, -4.77, 0.913],
])  # fmt: skip
NOISE = np.array([
    [0.02, 0, 0, 0, 0],
    [0, 0.02, 0.12, 0, 0],
    [0, 0.12, 0.6, 0, 0],
    [0, 0, 0, 0.01, 0.07],
    [0, 0, 0, 0.07, 0.49],
])  # fmt: skip
GAMMA = np.array([1.0, 1, 0, 1, 0])
METHODS = ("predictor", "filter", "lag", "smoother")


def scene() -> FloatArray:
    """A scene of 32 x 32 pixels of -1 with a square of 12 x 12 of 6.1 in the middle."""
    image = np.full((32, 32), -1.0)
    image[10:22, 10:22] = 6.1
    return image


def psf() -> Psf:
    """A uniform PSF, causal like his: the first tap stands for no displacement."""
    return Psf(values=np.full(BLUR, 1 / BLUR), origin=(0,))


def degraded(noise_variance: float, seed: int) -> FloatArray:
    """The scene on its endless background, blurred and noisy."""
    padded = np.pad(scene(), ((0, 0), (BLUR - 1, 0)), constant_values=-1.0)
    image = np.lib.stride_tricks.sliding_window_view(padded, BLUR, axis=1).mean(axis=2)
    return np.asarray(image + math.sqrt(noise_variance) * np.random.default_rng(seed).standard_normal(image.shape))


def first_order_correlation() -> float:
    """Correlation of neighbours along a line: z in R(z, i) is a share of the line's 32 pixels."""
    return math.exp(-4.35 / 32)


def fifth_order() -> Scanner:
    """The printed raster model, its noise made positive semidefinite by leaving out the negative eigenvalue."""
    values, vectors = np.linalg.eigh(NOISE)
    return Scanner(alpha=ALPHA, noise=(vectors * np.maximum(values, 0)) @ vectors.T, gamma=GAMMA)


def isnr(blurred: FloatArray, restored: FloatArray, aligned: bool) -> float:
    """Improvement, dB; aligned compares with the blurred picture moved back by its PSF's centroid."""
    truth, shift = scene(), (BLUR - 1) // 2 if aligned else 0
    before = np.concatenate([blurred[:, shift:], np.full((32, shift), -1.0)], axis=1)
    return float(10 * np.log10(np.sum((before - truth) ** 2) / np.sum((restored - truth) ** 2)))


def restored(
    image: FloatArray, method: str, scanner: Scanner, noise_variance: float, raster: bool = False
) -> FloatArray:
    """The picture restored by rows, or as one line of 1024 pixels, which the fifth-order model describes."""
    lines = image.reshape(1, -1) if raster else image
    sd = math.sqrt(noise_variance)
    done = restore(lines, psf(), method=method, noise_sd=sd, scanner=scanner, boundary=-1.0)
    return np.asarray(done.image).reshape(image.shape)


@dataclass(frozen=True, kw_only=True)
class Gain:
    """Improvement of one method in one setting, mean over noises, dB."""

    model: str
    method: str
    noise_variance: float
    image_factor: float
    """Factor of the filter's image variance."""
    noise_factor: float
    """Factor of the filter's noise variance."""
    aligned: float
    unaligned: float


def models() -> dict[str, tuple[Scanner, bool]]:
    """Scanners by name, each with whether it is a raster's."""
    variance = float(scene().var())
    return {
        "first order, α = 0.873": (first_order(first_order_correlation(), variance), False),
        "just a delay, α = 0": (first_order(0.0, variance), False),
        "fifth order, raster": (fifth_order(), True),
    }


def gain(model: str, method: str, noise_variance: float, factors: tuple[float, float], runs: int) -> Gain:
    """The gain of a method over several noises."""
    scanner, raster = models()[model]
    scaled = Scanner(alpha=scanner.alpha, noise=factors[0] * scanner.noise, gamma=scanner.gamma)
    pairs = []
    for seed in range(runs):
        image = degraded(noise_variance, seed)
        found = restored(image, method, scaled, factors[1] * noise_variance, raster)
        pairs.append((isnr(image, found, True), isnr(image, found, False)))
    aligned, unaligned = np.mean(pairs, axis=0)
    return Gain(
        model=model, method=method, noise_variance=noise_variance, image_factor=factors[0], noise_factor=factors[1],
        aligned=float(aligned), unaligned=float(unaligned),
    )  # fmt: skip


def _draw(path: Path, pictures: list[tuple[str, FloatArray]], columns: int) -> None:
    rows = -(-len(pictures) // columns)
    figure = Figure(figsize=(2.5 * columns, 2.75 * rows), layout="constrained")
    for k, (title, image) in enumerate(pictures):
        ax = figure.add_subplot(rows, columns, k + 1)
        ax.imshow(image, cmap="gray", vmin=-2, vmax=7.1, interpolation="nearest")
        ax.set_title(title, fontsize=8)
        ax.set_axis_off()
    figure.savefig(path, dpi=110, metadata={"Software": "aolink tools/paper"})


def draw(out: Path) -> dict[str, str]:
    """Draw figures like his 1 to 7; gives the caption of each file."""
    first, fifth = (models()[name][0] for name in ("first order, α = 0.873", "fifth order, raster"))
    clean, noisy = degraded(0.0, 0), degraded(SHOWN, 0)
    back = [restore(clean, psf(), method="inverse", boundary=b).image for b in (-1.0, 0.0)]
    _draw(out / "shahin-1-3.png", [
        ("1: original", scene()), ("2: degraded", clean), ("3: exact inverse", back[0]),
        ("the same, its initial state zero", back[1]),
    ], 4)  # fmt: skip
    varied = [
        (f"image × {a:g}, noise × {b:g}", restored(noisy, "predictor",
            Scanner(alpha=first.alpha, noise=a * first.noise, gamma=first.gamma), b * SHOWN))
        for a, b in ((1, 1), (10, 1), (0.1, 1), (1, 10))
    ]  # fmt: skip
    best = [(f"{m}", restored(noisy, m, first, SHOWN)) for m in ("filter", "lag", "smoother")]
    _draw(out / "shahin-4-5.png", [("4: noisy and degraded", noisy), *((f"5: {t}", i) for t, i in varied), *best], 4)
    _draw(out / "shahin-6-7.png", [
        ("6: noisy and degraded", noisy), ("7: fifth order, predictor",
            restored(noisy, "predictor", fifth, SHOWN, True)),
        ("fifth order, lag", restored(noisy, "lag", fifth, SHOWN, True)),
        ("fifth order, smoother", restored(noisy, "smoother", fifth, SHOWN, True)),
    ], 4)  # fmt: skip
    return {
        "shahin-1-3.png": "Like figures 1 to 3. A uniform PSF has its zeros on the unit circle: with the initial state"
        " of the background the inverse is exact, with zero the error of the first pixels never decays.",
        "shahin-4-5.png": f"Like figures 4 and 5: noise of variance {SHOWN:g}, the one-step predictor of (13) with the"
        " first-order scanner, the variances that it is given varied as he does; then what else the same filter gives.",
        "shahin-6-7.png": "Like figures 6 and 7: the fifth-order scanner, along all lines one after the other.",
    }


def build(runs: int, captions: dict[str, str]) -> list[Block]:
    """The whole page."""
    scanner, printed = fifth_order(), Scanner(alpha=ALPHA, noise=NOISE, gamma=GAMMA)
    variance = float(scene().var())
    eigenvalues = np.linalg.eigvals(ALPHA)
    periods = sorted({round(2 * math.pi / abs(np.angle(v)), 1) for v in eigenvalues if v.imag > 0}, reverse=True)
    settings = product(models(), NOISE_VARIANCES, METHODS)
    table = [gain(model, method, noise, (1.0, 1.0), runs) for model, noise, method in settings]
    shown = [
        gain("first order, α = 0.873", method, SHOWN, (a, b), runs)
        for method in ("predictor", "smoother") for a in FACTORS for b in FACTORS
    ]  # fmt: skip
    flattery = float(np.mean([g.unaligned - g.aligned for g in table]))
    return [
        Heading("Shahin's example, run again", 1),
        Text(
            "\"Application of Kalman Filter in Digital Image Processing\": a square of 12 x 12 pixels of 6.1 on a"
            " background of -1, blurred along its rows. Blur and noise are not printed; ours are uniform over"
            f" {BLUR} pixels, and of variance {', '.join(f'{v:g}' for v in NOISE_VARIANCES)}. Gains are means over"
            f" {runs} noises."
        ),
        *(PageFigure(file, caption) for file, caption in captions.items()),
        Heading("Improvement"),
        Text(
            "ISNR in dB, against the blurred picture moved back by the PSF's centroid (aligned), and index for index"
            f" (unaligned), which flatters by {flattery:.1f} dB on average."
        ),
        Table(
            ["scanner", "noise variance", "method", "aligned", "unaligned"],
            [[g.model, f"{g.noise_variance:g}", g.method, f"{g.aligned:.1f}", f"{g.unaligned:.1f}"] for g in table],
        ),
        Text(f"The variances that the first-order filter is given, varied; the true noise has {SHOWN:g}."),
        Table(
            ["method", "image variance ×", "noise variance ×", "aligned"],
            [[g.method, f"{g.image_factor:g}", f"{g.noise_factor:g}", f"{g.aligned:.1f}"] for g in shown],
        ),
        Heading("What is printed, checked"),
        Points([
            f"The picture's mean is {scene().mean():.4f} and its variance {variance:.3f}: zero and 6.1, as he has it.",
            f"R(z, i): z is a share of the line, so a pixel has 4.35/32 = {4.35 / 32:.3f}, and neighbours correlate by"
            f" {first_order_correlation():.3f}.",
            f"The fifth-order model is of a raster, line after line: its eigenvalues have periods of {periods[0]:g} and"
            f" {periods[1]:g} pixels, and it remembers the line above. Run as one per row it would not be his.",
            f"The printed beta K beta' is no covariance: its smallest eigenvalue is {np.linalg.eigvalsh(NOISE)[0]:.4f}"
            " (a rounded 0.02). We leave that eigenvalue out.",
            f"gamma P gamma' is {printed.correlation(0)[0]:.2f} as printed,"
            f" {scanner.correlation(0)[0]:.2f} repaired, not 6.1.",
            "(12) lacks U(k) behind its (0, beta), and \"Y-bar\" is gamma. (13) is right once B K B' is read with the"
            " barred B and the picture in it is the noisy one; it gives a prediction one pixel ahead.",
            f"The uniform PSF's largest zero is {largest_zero(psf().values):.3f}, on the unit circle: his exact inverse"
            " is exact because he knows the initial state.",
        ]),
    ]  # fmt: skip


def make(out: Path, quick: bool) -> Path:
    """Figures and page in ``out``; the page's path."""
    return write_page(build(2 if quick else RUNS, draw(out)), out / "shahin.md")
