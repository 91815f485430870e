"""Reads a Rerun file back as NumPy arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

Entities = dict[str, dict[str, list[Any]]]
"""Entity -> column -> values."""


def read_rrd(path: Path) -> Entities:
    """Entity -> column -> values in order of logging; a component's are lists, a timeline's integers."""
    return _columns(RrdReader(path).stream())


def read_blueprint(path: Path) -> dict[str, dict[str, list[Any]]]:
    """The same of the layout in the file."""
    reader = RrdReader(path)
    (blueprint,) = reader.blueprints()
    return _columns(reader.stream(store=blueprint))


def scalars(entity: dict[str, list[Any]]) -> np.ndarray:
    """Values of a line, (rows, lines)."""
    return np.array(entity["Scalars:scalars"])


def _columns(chunks: Any) -> dict[str, dict[str, list[Any]]]:
    entities: dict[str, dict[str, list[Any]]] = {}
    for chunk in chunks:
        entity = entities.setdefault(chunk.entity_path, {})
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            values = column.cast("int64") if str(column.type).startswith(("timestamp", "duration")) else column
            entity.setdefault(name, []).extend(values.to_pylist())
    return entities
