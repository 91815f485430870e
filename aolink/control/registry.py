"""The registry of controllers: one row for each, those of other packages with ours.

Another package adds one with an entry point in its pyproject.toml, whose name is the controller's:

    [project.entry-points."aolink.controllers"]
    mine = "my_package.controller:ROW"
"""

from __future__ import annotations

from aolink.control.checked import refusal
from aolink.control.controller import ControllerRow
from aolink.control.integrator import INTEGRATOR
from aolink.control.lqg import LQG
from aolink.errors import ControlError
from aolink.extensions import names_with, row_named
from aolink.rig import Rig

GROUP = "aolink.controllers"
_OURS = {
    row.name: row
    for row in (
        INTEGRATOR,
        ControllerRow(
            name="lqg", summary="predicts the estimator's state, and cancels it at the fast rate", build=LQG,
            believes_a_model=True,
        ),
    )
}  # fmt: skip


def controller_names() -> tuple[str, ...]:
    """Names of all controllers; nothing of other packages is loaded for it."""
    return names_with(_OURS, GROUP)


def find_controller(name: str, rig: Rig) -> ControllerRow:
    """The row of a name; aolink's own comes first.

    Raises
    ------
    ControlError
        There is no such controller, the installed package that has it is broken, or it cannot work on this rig.
    """
    row = row_named(name, _OURS, GROUP, "controller", ControlError)
    if reason := refusal(row, rig):
        raise ControlError(reason)
    return row
