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


def _on_lines(name: str) -> Method:
    return Method(
        name=name, restore=partial(kalman_estimate, which=name), why_not=why_not_lines,
        parameters=("boundary", "scanner", "direction"),
    )  # fmt: skip


_OURS = {
    row.name: row
    for row in (
        Method(name="tv", restore=tv),
        Method(name="pnp", restore=pnp, why_not=why_not_pnp, parameters=("denoise",)),
        Method(name="gauss_markov", restore=gauss_markov),
        _on_lines("smoother"),
        _on_lines("lag"),
        Method(
            name="inverse", restore=inverse, why_not=why_not_inverse, parameters=("boundary", "scanner", "direction")
        ),
        _on_lines("filter"),
        _on_lines("predictor"),
    )
}


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
