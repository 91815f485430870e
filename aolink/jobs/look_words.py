"""What `aolink look` found, in words and as plain data."""

from __future__ import annotations

import math
from typing import Any

from aolink.identification import Identified
from aolink.jobs.look import Direction, Looked


def paragraph(looked: Looked) -> str:
    """What moves, how, and how well it is known, in a few sentences."""
    n = len(looked.spots.corners)
    what = f"{n} spots, each" if n > 1 else "One spot,"
    said = [f"{what} {looked.sd:.3g} pixels wide at rest (standard deviation)."]
    if n > 1:
        said.append("They move together." if looked.together else "Each moves on its own, all in the same way.")
    moving = [each for each in looked.directions if each.moves]
    for each in looked.directions:
        if each.found is None:
            said.append(f"Along {each.name} nothing moves by more than {_digits(each.least)} pixels rms.")
        else:
            said.append(f"Along {each.name}: {described(each, looked)}.")
    for each in moving:
        where = f" along {each.name}" if len(moving) > 1 else ""
        if each.blurred:
            better = each.held / each.known
            tells = (
                f"the blur tells {better:.2g} times more than the centroid here"
                if better > 1.2
                else ("the blur tells hardly more than the centroid here")
            )
            said.append(
                f"Inside an exposure the path{where} is known to {_digits(each.known)} pixels rms; the centroid alone"
                f" leaves {_digits(each.held)}: {tells}."
            )
    return " ".join(said)


def described(direction: Direction, looked: Looked) -> str:
    """The motion along one direction in words, with the sets of its frequencies."""
    assert direction.found is not None
    parts, sets = [], {each.name: each for each in direction.found.parameters}
    processes = direction.found.model.processes
    for number, process in enumerate(processes):
        if process.kind != "resonance":
            kind = "it walks at random" if process.kind == "random-walk" else "it wanders at random and returns within"
            parts.append(kind if process.kind == "random-walk" else f"{kind} {process['correlation_s']:.2g} s")
            continue
        names = [name for name in sets if name.endswith("frequency_hz")]
        one = sets[names[sum(each.kind == "resonance" for each in processes[:number])]]
        size = f", {_digits(direction.size)} pixels rms" if len(processes) == 1 else ""
        parts.append(f"it vibrates at {in_set(one)}{size}")
    alone = (
        ""
        if processes[0].kind == "resonance" and len(processes) == 1
        else f", {_digits(direction.size)} pixels rms in all"
    )
    return " and ".join(parts) + alone


def in_set(each: Identified, most: int = 4) -> str:
    """A frequency with its set in words; of many pieces the first ones."""
    finest = min((piece.high - piece.low for piece in each.pieces), default=0.0)
    digits = max(0, min(3, 1 - math.floor(math.log10(max(finest, 1e-3)))))
    if not each.pieces:
        return f"{each.best:.{digits}f} Hz, though no frequency explains both the width and the shape of the blur"
    own = next((piece for piece in each.pieces if piece.low <= each.best <= piece.high), each.pieces[0])
    others = [piece for piece in each.pieces if piece is not own]
    said = f"{each.best:.{digits}f} Hz [{own.low:.{digits}f}, {own.high:.{digits}f}]"
    if not others:
        return said
    named = ", ".join(f"{piece.best:.{digits}f}" for piece in others[:most])
    more = " and so on" if len(others) > most else ""
    return f"{said} or an alias of it ({named} Hz{more}), which these frames cannot tell from it"


def _digits(value: float) -> str:
    return f"{value:.2g}" if value < 1 else f"{value:.3g}"


def as_json(looked: Looked) -> dict[str, Any]:
    """The numbers of `paragraph`."""
    return {
        "spots": looked.spots.corners.tolist(), "window": int(looked.spots.light.shape[-1]), "kernel_sd": looked.sd,
        "rate_hz": looked.rate_hz, "exposure_s": looked.exposure_s, "together": looked.together,
        "blurred": looked.blurred, "moves": looked.moves,
        "directions": {each.name: _direction_as_json(each) for each in looked.directions},
        "assumed": list(looked.assumed), "unknown": looked.unknown or None, "doubts": list(looked.doubts),
    }  # fmt: skip


def _direction_as_json(each: Direction) -> dict[str, Any]:
    found = None if each.found is None else each.found.model.name
    parameters = (
        {}
        if each.found is None
        else {
            one.name: {"value": one.best, "set": [[piece.low, piece.high] for piece in one.pieces]}
            for one in each.found.parameters
        }
    )
    return {
        "moves": each.moves, "rms_pixels": each.size, "model": found, "parameters": parameters,
        "path_sd_pixels": None if math.isnan(each.known) else each.known,
        "centroid_sd_pixels": None if math.isnan(each.held) else each.held,
    }  # fmt: skip
