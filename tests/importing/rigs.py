"""Rigs of a camera of 8 x 8 pixels, to which films are imported."""

from __future__ import annotations

from aolink.rig import Rig, load_rig, parse_rig


def small_rig(exposure_steps: int = 10, period_steps: int = 20, bit_depth: int = 16, offset: float = 0.0) -> Rig:
    """One spot whose two slopes have an input each; fast steps of 1 ms, at first 50 frames/s of 10 ms each."""
    text = load_rig("single-lenslet").toml
    for old, new in (
        ("window = [16, 16]", "window = [8, 8]"),
        ("exposure_steps = 200", f"exposure_steps = {exposure_steps}\nexposure_offset = {offset}"),
        ("[sensor]", f"frame_period_steps = {period_steps}\n[sensor]"),
        ("bit_depth = 12", f"bit_depth = {bit_depth}"),
    ):
        assert old in text
        text = text.replace(old, new, 1)
    return parse_rig(text)
