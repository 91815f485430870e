"""The restoration methods, one row each: those of aolink, and those of installed packages.

A package adds one with an entry point of the group ``aolink.restorations`` that names a `Method`. It is loaded at its
first use, so that a broken one does not stop the others.
"""

from __future__ import annotations

from functools import partial

from aolink.errors import RestorationError
from aolink.extensions import described, installed, loaded
from aolink.restoration.lines import inverse, kalman_estimate, why_not_inverse, why_not_lines
from aolink.restoration.method import Method
from aolink.restoration.plane import gauss_markov, pnp, tv, why_not_pnp

GROUP = "aolink.restorations"
DEFAULT_METHOD = "tv"
_KIND = "restoration method"


def _on_lines(name: str, summary: str) -> Method:
    return Method(
        name=name, summary=f"on lines: {summary}", restore=partial(kalman_estimate, which=name), why_not=why_not_lines,
        parameters=("boundary", "scanner", "direction"),
    )  # fmt: skip


_OWN = {
    row.name: row
    for row in (
        Method(
            name="inverse", summary="on lines: exact, for pictures without noise", restore=inverse,
            why_not=why_not_inverse, parameters=("boundary", "scanner", "direction"),
        ),
        _on_lines("predictor", "Kalman predictor, from the pixels before each"),
        _on_lines("filter", "Kalman filter, from the pixels up to each"),
        _on_lines("lag", "Kalman filter, a PSF's length behind"),
        _on_lines("smoother", "Kalman smoother, from all pixels of the line"),
        Method(name="gauss_markov", summary="linear, for smooth scenes", restore=gauss_markov),
        Method(name="tv", summary="total variation, keeps edges", restore=tv),
        Method(
            name="pnp", summary="plug and play with a denoiser, slow", restore=pnp, why_not=why_not_pnp,
            parameters=("denoise",),
        ),
    )
}  # fmt: skip


def method_names() -> tuple[str, ...]:
    """Names of all methods; nothing of other packages is loaded for it."""
    return (*_OWN, *(name for name in installed(GROUP) if name not in _OWN))


def find_method(name: str) -> Method:
    """The row of a name; aolink's own comes first.

    Raises
    ------
    RestorationError
        There is no such method, or the installed package that has it is broken.
    """
    if row := _OWN.get(name):
        return row
    if (point := installed(GROUP).get(name)) is None:
        raise RestorationError(f"method is {name!r}, expected one of {', '.join(method_names())}")
    row = loaded(point, _KIND, RestorationError)
    if not isinstance(row, Method) or row.name != name:
        raise RestorationError(
            f"{described(point, _KIND)} is {row!r}, expected an aolink.restoration.Method of that name"
        )
    return row


def check_parameters(row: Method, given: dict[str, object]) -> None:
    """Raise RestorationError for a parameter that a method does not take."""
    for name in given:
        if name not in row.parameters:
            takers = [each.name for each in _OWN.values() if name in each.parameters]
            what = f"belongs to {', '.join(takers)}" if takers else "is a parameter of no method of aolink"
            raise RestorationError(f"{row.name} takes no {name}, which {what}: leave it out")
