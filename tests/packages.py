"""Packages that are installed as far as their entry points go."""

from __future__ import annotations

from pathlib import Path


def package(folder: Path, name: str, points: str) -> Path:
    """Lay out in a folder of the module path what an installed package has, with the text of its entry points."""
    (info := folder / f"{name}-1.0.dist-info").mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(points)
    return folder
