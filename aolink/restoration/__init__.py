"""Restoration: from the estimated path to a picture without its blur. Pure: no time, no files, no ports."""

from aolink.restoration.inverse import largest_zero, stable_direction
from aolink.restoration.plug_and_play import non_local_means
from aolink.restoration.psf import Psf, motion_psf, motion_psf_by_root
from aolink.restoration.restore import METHODS, Method, Restored, checked_method, restore
from aolink.restoration.scanner import Scanner, first_order, from_correlation, measured_correlation

__all__ = [
    "METHODS",
    "Method",
    "Psf",
    "Restored",
    "Scanner",
    "checked_method",
    "first_order",
    "from_correlation",
    "largest_zero",
    "measured_correlation",
    "motion_psf",
    "motion_psf_by_root",
    "non_local_means",
    "restore",
    "stable_direction",
]
