"""The job of `aolink identify`: it makes a rig file with a model of the disturbance from recordings of blurred
frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aolink import identification
from aolink.errors import IdentificationError
from aolink.identification import Maximum, ProcessSum, Readings, Space, Tried, identified, kinds_of, readings, tried
from aolink.numerics.arrays import FloatArray
from aolink.recording.reader import Recording
from aolink.recording.reestimate import check_has_exposures
from aolink.rig import Rig
from aolink.units import counted

_MOST_OUTPUTS = 24
"""The most outputs that a model is fitted to; from more outputs, as many are taken at equal distances."""
_APART = 2
"""Up to this many outputs of a copy of the plant have a model each; more outputs share one."""


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """The quantities to identify."""

    models: tuple[str, ...] = identification.CANDIDATES
    """Sums of kinds to choose from; a single one is taken without a choice."""
    plant: str | None = None
    """Kind of the plant, where it is fitted as well."""
    lowest_hz: float | None = None
    highest_hz: float | None = None


@dataclass(frozen=True, kw_only=True)
class IdentifiedModel:
    """The identified model of one output, or of all outputs that share it."""

    output: str
    model: ProcessSum
    """The disturbance, without the noise of a plant that was fitted."""
    plant: identification.IdentifiedPlant | None
    parameters: tuple[identification.Identified, ...]
    tried: tuple[Tried, ...]
    """The models that were tried; empty where one model was asked for."""
    log_likelihood: float
    exposures: int
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Result:
    """All outputs, and the text of the rig file that they make."""

    found: tuple[IdentifiedModel, ...]
    text: str


Tell = Callable[[str, int, int], None]
"""Called with the present task, how much of it is done, and how much there is."""


def identify(recordings: Sequence[Recording], rig: Rig | None, wanted: Wanted, tell: Tell | None = None) -> Result:
    """Identify models from recordings of one rig; ``rig``, if given, takes the place of their own.

    Raises
    ------
    IdentificationError
        The recordings are of several rigs, too short, without pixels, or without inputs to identify a plant from.
    RecordingError
        A recording cannot be read.
    """
    for name in wanted.models:
        kinds_of(name)
    first = rig or recordings[0].rig
    _check_plant(first, wanted)
    plant_known = wanted.plant is None
    seen: list[Readings] = []
    for number, recording in enumerate(recordings):
        check_has_exposures(recording)
        own = rig or recording.rig
        if (own.n_outputs, own.timing) != (first.n_outputs, first.timing):
            raise IdentificationError(
                f"{recording.path} is of another rig than {recordings[0].path}: timing and outputs must be the same"
            )
        exposures = list(recording.exposures())
        seen.append(readings(own, exposures, plant_known=plant_known))
        if tell:
            tell("recordings", number + 1, len(recordings))
    return from_readings(first, seen, wanted, tell)


def from_readings(
    rig: Rig, seen: Sequence[Readings], wanted: Wanted, tell: Tell | None = None, maxima: Sequence[Maximum] = ()
) -> Result:  # fmt: skip
    """Identify models as `identify` does, from the readings of each recording.

    ``maxima`` are those of the one model that is wanted, of a rig with one output to a copy, where they are known
    already.
    """
    _check_plant(rig, wanted)
    found = [_of_output(label, each, wanted, tell, maxima) for label, each in _by_output(rig, seen)]
    text = identification.identified_text(rig.toml, rig, [each.model for each in found], plant=found[0].plant)
    return Result(found=tuple(found), text=text)


def space_wanted(kinds: Sequence[str], seen: Sequence[Readings], wanted: Wanted) -> Space:
    """The parameters of a sum of kinds, and of all else that is wanted."""
    return identification.space_of(
        kinds, seen, lowest_hz=wanted.lowest_hz, highest_hz=wanted.highest_hz, plant=wanted.plant
    )


def _check_plant(rig: Rig, wanted: Wanted) -> None:
    """Raise IdentificationError for a rig whose plant cannot be identified, before any work."""
    if wanted.plant and 1 < rig.plant.n_outputs <= _APART:
        raise IdentificationError(
            "a plant is identified where one input moves one output of a copy of it: this rig's has"
            f" {counted(rig.plant.n_inputs, 'input')} and {counted(rig.plant.n_outputs, 'output')}; leave out --fit"
        )


def _by_output(rig: Rig, seen: Sequence[Readings]) -> list[tuple[str, list[Readings]]]:
    """The readings of each output of a copy of the plant, or of all where they are many."""
    per_copy = rig.plant.n_outputs
    if per_copy > _APART:
        return [("all outputs", [_some(each, list(range(rig.n_outputs))) for each in seen])]
    groups = [list(range(o, rig.n_outputs, per_copy)) for o in range(per_copy)]
    labels = ["x", "y"] if per_copy == 2 else ["the output" if rig.plant.axes == 1 else "each output"]
    return [(label, [_some(each, which) for each in seen]) for label, which in zip(labels, groups, strict=True)]


def _some(seen: Readings, which: Sequence[int]) -> Readings:
    """The readings of the outputs that a model is fitted to. Raises IdentificationError where none shows a spot."""
    seeing = [o for o in which if seen.usable[o].any()]
    if not seeing:
        raise IdentificationError("no exposure shows a spot of this output")
    at = np.unique(np.linspace(0, len(seeing) - 1, min(len(seeing), _MOST_OUTPUTS)).round().astype(int))
    return seen.of_outputs([seeing[k] for k in at])


def _of_output(
    output: str, seen: Sequence[Readings], wanted: Wanted, tell: Tell | None,
    known: Sequence[Maximum],
) -> IdentifiedModel:  # fmt: skip
    def space(kinds: Sequence[str]) -> Space:
        return space_wanted(kinds, seen, wanted)

    scored: list[Tried] = []
    if len(wanted.models) > 1:
        for number, name in enumerate(wanted.models):
            if tell:
                tell(f"models, {output}", number, len(wanted.models))
            scored.append(tried(name, space, seen))
        name = identification.chosen(scored).name
    else:
        name = wanted.models[0] if wanted.models else ""
    of = space(kinds_of(name) if name else ())
    if tell:
        tell(f"fit, {output}", 0, len(of.names) + 1)
    tops = list(known) or identification.maxima(of, seen)
    x = tops[0].x
    sets = identified(of, tops, seen, (lambda k: tell(f"fit, {output}", k + 1, len(of.names) + 1)) if tell else None)
    plant = of.fitted_plant(x)
    notes = [each.contradiction for each in sets if not each.pieces]
    for each in sets:
        if each.name.endswith("frequency_hz") and len(each.pieces) > 1:
            rest = ", ".join(f"{piece.best:.4g}" for piece in each.pieces if not piece.low <= each.best <= piece.high)
            notes.append(
                f"{each.name}: {rest} Hz explains the exposures nearly as well: the frames are too slow to tell"
            )
    return IdentifiedModel(
        output=output, model=_without_plant(of, x), plant=plant,
        parameters=sets, tried=tuple(scored), log_likelihood=tops[0].log_likelihood,
        exposures=sum(int(each.usable.any(axis=0).sum()) for each in seen), notes=tuple(notes),
    )  # fmt: skip


def _without_plant(of: Space, x: FloatArray) -> ProcessSum:
    """The disturbance, without the noise of a plant that is fitted."""
    whole = of.model(x)
    return replace(whole, processes=whole.processes[1 if of.plant else 0 :])
