"""What was identified, written into the text of a rig file as ``[[disturbance.model]]``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from aolink.identification.models import Process, ProcessSum


def as_tables(model: ProcessSum, step_s: float) -> list[dict[str, Any]]:
    """A table of ``[[disturbance.model]]`` for each process, for a plant of one output."""
    return [_as_table(process, step_s) for process in model.processes]


def _as_table(process: Process, step_s: float) -> dict[str, Any]:
    if process.kind == "random-walk":
        return {"kind": "random-walk", "step_sd": _written(math.sqrt(process["intensity"] * step_s))}
    if process.kind == "ornstein-uhlenbeck":
        correlation = _written(process["correlation_s"])
        return {"kind": "ornstein-uhlenbeck", "correlation_s": correlation, "sd": _written(math.sqrt(process.variance))}
    if process.kind == "resonance":
        names = ("frequency_hz", "damping", "sd")
        return {"kind": "resonance"} | {name: _written(process[name]) for name in names}
    space = ProcessSum((process,)).state_space(step_s)
    values, vectors = np.linalg.eigh(space.W)
    kept = values > values.max() * 1e-12
    return {
        "kind": "matrices",
        "A": _rows(space.A), "B_w": _rows(vectors[:, kept]), "C": _rows(space.C), "process_noise": values[kept].tolist(),
    }  # fmt: skip


def for_outputs(tables: Sequence[Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Tables for a plant of several outputs, from those of each output: a mode is one output."""
    if len(tables) == 1:
        return list(tables[0])
    out = []
    for o, parts in enumerate(tables):
        own = [[1.0] if k == o else [0.0] for k in range(len(tables))]
        for part in parts:
            if part["kind"] == "matrices":
                out.append(part | {"C": [row if k == o else [0.0] * len(row) for k in range(len(tables)) for row in part["C"]]})
            else:
                size = {name: [part[name]] for name in ("sd", "step_sd") if name in part}
                out.append(part | size | {"modes": own})
    return out


def _written(value: float) -> float:
    return float(f"{value:.6g}")


def _rows(matrix: np.ndarray[Any, np.dtype[np.float64]]) -> list[list[float]]:
    return [[float(value) for value in row] for row in matrix]
