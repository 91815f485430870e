"""Restoration: the estimated path gives a picture without its blur. The subpackage is pure: no time, no ports,
and files in `films` only.

To add a method: a row in `registry`, a test in `tests/restoration/test_restore.py`, and a line in the list of
`aolink/pages/restore.md`. The command line, its help, the benchmark and the viewer read the row.
"""

from typing import TYPE_CHECKING, Any

from aolink.restoration.block_matching import block_matching
from aolink.restoration.deblur import RestoredPictures, deblur
from aolink.restoration.method import Blurred, Method, Restored
from aolink.restoration.plug_and_play import non_local_means
from aolink.restoration.psf import Psf, motion_psf, motion_psf_by_root
from aolink.restoration.registry import find_method, method_names
from aolink.restoration.restore import restore
from aolink.restoration.scanner import Scanner, first_order, from_correlation, measured_correlation
from aolink.restoration.shahin import largest_zero, stable_direction

if TYPE_CHECKING:
    METHODS: tuple[str, ...]
else:  # the type checker would accept any name

    def __getattr__(name: str) -> Any:
        """METHODS, the names of all methods; installed packages are searched only when it is used."""
        if name == "METHODS":
            return method_names()
        raise AttributeError(f"module 'aolink.restoration' has no attribute {name!r}")


__all__ = [
    "METHODS", "Blurred", "Method", "Psf", "Restored", "RestoredPictures", "Scanner", "block_matching", "deblur",
    "find_method", "first_order", "from_correlation", "largest_zero", "measured_correlation", "motion_psf",
    "motion_psf_by_root", "non_local_means", "restore", "stable_direction",
]  # fmt: skip
