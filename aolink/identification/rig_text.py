"""Identified models in the text of a rig file: ``[[disturbance.model]]``, and the plant where it is new."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from typing import Any

import numpy as np

from aolink.identification.models import IdentifiedPlant, Process, ProcessSum, StateSpace
from aolink.rig import Rig, parse_rig
from aolink.rig.edit import with_tables, with_value

_COMMENT = "by `aolink identify`"
_MOVED = "by `aolink identify`: the models of the disturbance move the plant"


def identified_text(text: str, rig: Rig, models: Sequence[ProcessSum], *, plant: IdentifiedPlant | None = None) -> str:
    """The text of a rig file with the identified models as the whole disturbance: the plant's own noise is zero then.

    Parameters
    ----------
    text:
        The file's text, whatever its line ends, which ``rig`` was read from.
    models:
        The disturbance of each output of a copy of the plant, or one for all.
    plant:
        The plant, where it was identified; its own noise then stays in ``[plant]``.

    Raises
    ------
    RigError
        The file cannot hold the models.
    """
    step = rig.timing.fast_step_s
    if plant is not None:
        space, B = plant.state_space(step)
        own, noises = _matrices(space)
        noise_table = {"process_noise": np.diag(noises).tolist(), "initial_covariance": "stationary"}
        for key, value in ({"A": own.pop("A"), "B": _rows(B)} | own | noise_table).items():
            text = with_value(text, f"plant.{key}", value, may_be_new=True, comment=_COMMENT)
    else:
        written = tomllib.loads(rig.toml)["plant"]["process_noise"]
        text = with_value(
            text, "plant.process_noise", np.zeros_like(written, dtype=np.float64).tolist(), comment=_MOVED
        )
    tables = for_outputs([[as_table(process, step) for process in model.processes] for model in models])
    text = with_tables(text, "disturbance.model", tables, _COMMENT) if tables else text
    parse_rig(text)
    return text


def as_table(process: Process, step_s: float) -> dict[str, Any]:
    """A table of ``[[disturbance.model]]``, for a plant of one output."""
    if process.kind == "random-walk":
        return {"kind": "random-walk", "step_sd": _written(math.sqrt(process["intensity"] * step_s))}
    if process.kind == "ornstein-uhlenbeck":
        correlation = _written(process["correlation_s"])
        return {"kind": "ornstein-uhlenbeck", "correlation_s": correlation, "sd": _written(math.sqrt(process.variance))}
    if process.kind == "resonance":
        names = ("frequency_hz", "damping", "sd")
        return {"kind": "resonance"} | {name: _written(process[name]) for name in names}
    own, noises = _matrices(ProcessSum((process,)).state_space(step_s))
    return {"kind": "matrices", **own, "process_noise": noises}


def _matrices(space: StateSpace) -> tuple[dict[str, Any], list[float]]:
    """A, B_w and C of a process with independent noises, and the variances of these."""
    values, vectors = np.linalg.eigh(space.W)
    kept = values > values.max() * 1e-12
    return {"A": _rows(space.A), "B_w": _rows(vectors[:, kept]), "C": _rows(space.C)}, values[kept].tolist()


def for_outputs(tables: Sequence[Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Tables for a plant of several outputs, from those of each output: a mode is one output."""
    if len(tables) == 1:
        return list(tables[0])
    out = []
    for o, parts in enumerate(tables):
        own = [[1.0] if k == o else [0.0] for k in range(len(tables))]
        for part in parts:
            if part["kind"] == "matrices":
                own_rows = [row if k == o else [0.0] * len(row) for k in range(len(tables)) for row in part["C"]]
                out.append(part | {"C": own_rows})
            else:
                size = {name: [part[name]] for name in ("sd", "step_sd") if name in part}
                out.append(part | size | {"modes": own})
    return out


def _written(value: float) -> float:
    return float(f"{value:.6g}")


def _rows(matrix: np.ndarray[Any, np.dtype[np.float64]]) -> list[list[float]]:
    return [[float(value) for value in row] for row in matrix]
