"""The restoration methods, one row each: those of aolink, and those of installed packages.

A package adds one with an entry point of the group ``aolink.restorations`` that names a `Method`. It is loaded at its
first use, so that a broken one does not stop the others.
"""

from __future__ import annotations

from functools import partial

from aolink.errors import RestorationError
from aolink.extensions import names_with, row_named
from aolink.restoration.method import Method
from aolink.restoration.plane import gauss_markov, pnp, tv, why_not_pnp
from aolink.restoration.shahin import inverse, kalman_estimate, why_not_inverse, why_not_lines

GROUP = "aolink.restorations"
DEFAULT_METHOD = "tv"


def _on_lines(name: str, summary: str) -> Method:
    return Method(
        name=name, summary=f"on lines: {summary}", restore=partial(kalman_estimate, which=name), why_not=why_not_lines,
        parameters=("boundary", "scanner", "direction"),
    )  # fmt: skip


_OURS = {
    row.name: row
    for row in (
        Method(name="tv", summary="total variation, keeps edges", restore=tv),
        Method(
            name="pnp", summary="plug and play with a denoiser: the best, and slow", restore=pnp, why_not=why_not_pnp,
            parameters=("denoise",),
        ),
        Method(name="gauss_markov", summary="linear, for smooth scenes", restore=gauss_markov),
        _on_lines("smoother", "Kalman smoother, from all pixels of the line"),
        _on_lines("lag", "Kalman filter, a PSF's length behind"),
        Method(
            name="inverse", summary="on lines: exact, for pictures without noise", restore=inverse,
            why_not=why_not_inverse, parameters=("boundary", "scanner", "direction"),
        ),
        _on_lines("filter", "Kalman filter, from the pixels up to each; rarely better than the blurred picture"),
        _on_lines("predictor", "Kalman predictor, from the pixels before each; hardly ever better"),
    )
}  # fmt: skip


def method_names() -> tuple[str, ...]:
    """Names of all methods; nothing of other packages is loaded for it."""
    return names_with(_OURS, GROUP)


def find_method(name: str) -> Method:
    """The row of a name; aolink's own comes first.

    Raises
    ------
    RestorationError
        There is no such method, or the installed package that has it is broken.
    """
    return row_named(name, _OURS, GROUP, "restoration method", RestorationError)


def check_parameters(row: Method, given: dict[str, object]) -> None:
    """Raise RestorationError for a parameter that a method does not take."""
    for name in given:
        if name not in row.parameters:
            takers = [each.name for each in _OURS.values() if name in each.parameters]
            what = f"belongs to {', '.join(takers)}" if takers else "is a parameter of no method of aolink"
            raise RestorationError(f"{row.name} takes no {name}, which {what}: leave it out")
