"""Pictures from the files of any film."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import AolinkError, ImportingError
from aolink.films.film import Film, grey
from aolink.films.formats import open_film
from aolink.numerics.arrays import FloatArray


def read_film(path: str | Path, error: type[AolinkError]) -> Film:
    """The film of a file; raises ``error`` where it cannot be read."""
    try:
        return open_film(path)
    except ImportingError as problem:
        raise error(str(problem)) from None


def read_picture(path: str | Path, error: type[AolinkError]) -> NDArray[Any]:
    """The only picture in a file, (rows, columns) or (rows, columns, 2 to 4 channels), of its own type or, where pixels
    of it are undefined, with NaN there. Raises ``error``."""
    film = read_film(path, error)
    if film.count != 1:
        raise error(f"{path} holds {film.count} pictures, expected one: take the right one out of it")
    try:
        return next(film.pictures())
    except ImportingError as problem:
        raise error(str(problem)) from None


def read_frame(path: str | Path, error: type[AolinkError]) -> FloatArray:
    """The only picture in a file in grey, (rows, columns). Raises ``error``."""
    return np.asarray(grey(read_picture(path, error), path), dtype=np.float64)
