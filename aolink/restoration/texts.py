"""Tables of numbers as spreadsheets and loggers write them: PSFs, and logs of a motion."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

import numpy as np

from aolink.errors import RestorationError
from aolink.films.facts import Said, facts, meaning
from aolink.films.pictures import read_frame
from aolink.numerics.arrays import FloatArray

_EVEN = 1.2
"""A ground is even where a quarter of a PSF's values are not above it by more than this factor."""
_PEDESTAL = 0.05
"""Share of a PSF's sum in an even ground from which on it is one, and of its values that may be below that ground."""
_DECIMAL = re.compile(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?$")
_PIXELS = re.compile(r"([xy])[\W_]*(px|pix|pixels?)?\W*$")


def number_table(path: Path) -> tuple[list[str], FloatArray]:
    """The names of the columns, where the first row or a comment before it has them, and the numbers, (rows, columns).

    Between numbers are semicolons, tabs, commas or spaces; with decimal commas anything but commas. Raises ValueError
    where that cannot be told, or rows are not alike.
    """
    data = path.read_bytes()
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    said, head = list[str](), ""
    for line in data.decode("utf-16" if wide else "utf-8-sig").splitlines():
        row, _, comment = line.partition("#")
        if row.strip(" \t,;"):
            said.append(row.strip())
        elif not said and comment.strip():
            head = comment
    if said and not re.match(r"[-+.]?\d|[-+]?(nan|inf)", said[0], re.I):
        head = said.pop(0)
    text = "\n".join(said)
    between, point = next((each for each in (";", "\t") if each in text), ""), "."
    if not between and re.search(r"\S[^\S\n]+\S", text):
        between = r"\s+" if all(_DECIMAL.match(cell) for cell in text.split()) else r"[,\s]+"
    between = between or ","
    if between != "," and "," in text and "." not in text and not between.startswith("["):
        point = ","
    cells = [[cell for cell in re.split(between, row.strip(" \t,;")) if cell.strip()] for row in said]
    names = [each.strip(" \t\"'") for each in re.split(between if between != r"\s+" else r"[,;\s]+", head.strip())]
    told = head and len(names) == len(cells[0])
    whole = "." not in text and "," in text and point == "."
    odd = whole and any(re.match(r"0\d", cell.strip()) for row in cells for cell in row)
    if odd or (whole and between == "," and not told and len(cells) > 1 and {len(row) for row in cells} == {2}):
        raise ValueError("its commas may be decimal ones: write decimal points, or semicolons between the numbers")
    table = np.array([[float(cell.replace(point, ".")) for cell in row] for row in cells])
    return names if head else [], table


def read_log(path: Path) -> tuple[FloatArray, FloatArray]:
    """Times, s, (rows,), and places along x and y, pixels, (2, rows), of a log. Raises `RestorationError`."""
    try:
        names, table = number_table(path)
    except (OSError, ValueError) as error:
        raise RestorationError(f"{path} cannot be read as a log of time, x and y ({error})") from None
    if table.ndim != 2 or table.shape[1] < 2 or len(table) < 2 or not np.isfinite(table).all():
        raise RestorationError(f"{path} has a table of shape {table.shape}, expected rows of time, x and y")
    if names:
        which = {found[1]: k for k, name in enumerate(names) if (found := _PIXELS.match(name.lower()))}
        times = [k for k, name in enumerate(names) if meaning(name)[0] == "times"]
        known, notes = facts([Said(names[k], table[:, k]) for k in times[:1]], len(table))
        if len(names) != table.shape[1] or "times_ns" not in known or not which:
            raise RestorationError(
                f"{path} has the columns {', '.join(names)}{'; ' + notes[0] if notes else ''}: expected t (or time_ms,"
                " and the like), and x and y in pixels"
            )
        nothing = np.zeros(len(table))
        table = np.column_stack(
            [known["times_ns"] / 1e9, *(table[:, which[a]] if a in which else nothing for a in "xy")]
        )
    elif table.shape[1] > 3:
        raise RestorationError(f"{path} has {table.shape[1]} columns without names: name them in a first row, as t,x,y")
    if (steps := np.diff(table[:, 0])).min() <= 0:
        raise RestorationError(f"{path}: row {int(steps.argmin()) + 2} is not later than the one before")
    return table[:, 0], np.column_stack([table[:, 1:], np.zeros(len(table))])[:, :2].T


def read_psf(path: Path) -> tuple[FloatArray, tuple[str, ...]]:
    """A PSF as numbers, and notes on it: from text with commas or spaces, .npy, or a picture.

    One row is a PSF along the rows, (taps,), one column a PSF along the columns, (taps, 1). Raises `RestorationError`
    where the file cannot be read as a PSF.
    """
    try:
        if path.suffix.lower() in (".csv", ".txt", ".dat", ".tsv", ""):
            found = number_table(path)[1]
            found = found[0] if len(found) == 1 else found
        elif path.suffix == ".npy":
            found = np.load(path, allow_pickle=False)
            if found.dtype.kind not in "uif":
                raise ValueError(f"it holds {found.dtype}, expected numbers")
            found = found.astype(np.float64)
        else:
            found = read_frame(path, RestorationError)
    except (OSError, ValueError, EOFError) as error:
        raise RestorationError(
            f"{path} cannot be read as a PSF ({error}): give a picture, .npy, or rows of numbers"
        ) from error
    if found.size > 2 and np.isfinite(found).all() and found.sum() > 0:
        ground = float(np.quantile(found, _PEDESTAL))
        share = ground * found.size / found.sum()
        even = np.count_nonzero(found <= _EVEN * ground) > found.size / 4
        if share > _PEDESTAL and ground < found.max() / 5 and even:
            return np.maximum(found - ground, 0.0), (
                f"{share:.0%} of the PSF's sum is an even ground of {ground:.3g}, as of a camera's dark level, with"
                " which the picture would become worse: it is subtracted from the PSF",
            )
    return found, ()
