"""Frames of Shack-Hartmann sensors, made without anything of aolink: spots on any lattice, by error functions."""

from __future__ import annotations

import numpy as np
from scipy.special import erf

ANGLES = {"square": np.pi / 2, "hexagonal": np.pi / 3}


def nodes_and_places(kind, pitch, turn_deg, side, radius, pupil="round"):
    """Nodes of a turned lattice in a pupil about a frame's middle, (n, 2), and where they are, pixels from it."""
    first, angle = np.deg2rad(turn_deg), ANGLES[kind]
    steps = pitch * np.array([[np.cos(a), np.sin(a)] for a in (first, first + angle)])
    reach = np.arange(-int(2 * radius / pitch) - 2, int(2 * radius / pitch) + 3)
    nodes = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    places = nodes @ steps
    x, y = places.T
    inside = np.hypot(x, y) < radius
    if pupil == "square":
        inside = np.maximum(abs(x), abs(y)) < radius
    elif pupil == "annular":
        inside &= np.hypot(x, y) > 0.4 * radius
    elif pupil == "wedge":
        inside &= ~((x > 0) & (y > 0) & (y < x))
    elif pupil == "halves":
        inside &= abs(x) > 0.6 * pitch
    return nodes[inside], places[inside]


def square_lattice(lit, pitch):
    """Positions of the lit lenslets of a square grid, (n, 2) as (x, y), row by row, and its pairs of neighbours."""
    positions = pitch * np.argwhere(lit)[:, ::-1].astype(float)
    distance = np.linalg.norm(positions[:, None] - positions, axis=-1)
    return positions, np.argwhere(np.triu(abs(distance - pitch) < 1e-9))


def spots_frame(side, places, sd, heights=1.0):
    """Gaussian spots integrated over pixels, (side, side); ``heights`` are about those of the brightest pixels."""
    edges = np.arange(side + 1) - 0.5
    masses = [np.diff(erf((edges - p[:, None]) / (sd * np.sqrt(2))) / 2, axis=1) for p in places.T]
    heights = np.broadcast_to(heights, len(places)) * 2 * np.pi * sd**2
    return (masses[1] * heights[:, None]).T @ masses[0]


def as_dtype(frame, dtype):
    """A frame with light of about one, in a camera's type: 8 or 16 bits, or from 0 to 1."""
    if dtype == "uint8":
        return np.clip(np.rint(frame * 150), 0, 255).astype(np.uint8)
    if dtype == "uint16":
        return np.clip(np.rint(frame * 30_000), 0, 65_535).astype(np.uint16)
    return np.clip(frame / 2, 0, 1).astype(dtype)
