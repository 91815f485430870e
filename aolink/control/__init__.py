"""Controllers: they give the mirror's inputs from exposures and estimates. The subpackage knows no time, files or
ports: `aolink.session.controlling` runs a loop in a session, `aolink.jobs.closed_loop` in memory.

An exposure ends at a fast step e, and the first step that a new command can reach is e + d. The inputs from e to
e + d - 1 are fixed, and the controller is given them. The page is `aolink/pages/close_a_loop.md`.
"""

from aolink.control.controller import Controller, ControllerRow, Seen
from aolink.control.fall_back import FallBack
from aolink.control.loop import Act, ControlLoop, State, delay_steps
from aolink.control.modes import MirrorModes, response_at_rest
from aolink.control.registry import controller_names, find_controller
from aolink.control.stability import Stability, check_stable, stability

__all__ = [
    "Act", "ControlLoop", "Controller", "ControllerRow", "FallBack", "MirrorModes", "Seen",
    "Stability", "State", "check_stable", "controller_names", "delay_steps", "find_controller", "response_at_rest",
    "stability",
]  # fmt: skip
