"""Loops over axes, components and pixels, compiled by Numba, for line sensors, for spots, and for many spots of one
plant.

Whole-array calls for thousands of axes run through memory again and again; these loops keep one axis in the
processor's cache (rows `moments_of_many_axes`, `profile_of_many_axes` and `membrane_in_real_time` of
tools/bench). Tests compare the loops for pixels with a twin in NumPy, `tests/estimation/pixels/plain.py`, those of
moments with samples, those for many spots of one plant with the dense view of the same pixels, and the Kalman filter's
with `kalman.filter.BlurFilter`. They hold no lock, so axes are shared among threads; the result for one axis does not
depend on how many others there are, bit for bit.

Machine code is made by group, when an estimator that needs the group is first made, and kept beside the source or in
the user's cache, in a folder whose name follows from what the sources contain (`kept`).
``python -m aolink.estimation.compiled`` makes all groups at once.
"""

from __future__ import annotations

from aolink.estimation.compiled.kept import compile_once

GROUPS = {
    "o1 to o3 and moments": (("section-vi-lively", "o3"), ("section-vi-lively", "moments")),
    "larger plants": (("tip-tilt", "o3"),),
    "many spots": (("membrane-12x12", "moments"), ("membrane-12x12", "profile")),
    "profile": (("section-vi-lively", "profile"),),
}
"""What is compiled together: the rigs and estimators that use all of a group's loops when they are made."""
_COMPILE = """
from aolink.estimation import compiled, make_estimator
from aolink.rig import load_rig

compiled.compiles_itself = True
for rig, name in {pairs}:
    make_estimator(load_rig(rig), name)
"""
compiles_itself = False
"""Whether this is the process that compiles for all others."""


def make_ready(*groups: str) -> None:
    """Compile groups of loops in a process of their own, once for what the sources contain; all others load them.

    A process that compiles them for itself computes with other machine code than one that loads the kept code, so the
    last bits of estimates online and offline might differ. Where nothing can be kept, each process compiles for itself.
    """
    if not compiles_itself:
        compile_once(groups, lambda missing: _COMPILE.format(pairs=[pair for each in missing for pair in GROUPS[each]]))
