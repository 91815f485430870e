"""The registry of estimators: one row for each, those of other packages with ours.

Another package adds one with an entry point in its pyproject.toml, whose name is the estimator's:

    [project.entry-points."aolink.estimators"]
    mine = "my_package.estimator:ROW"

It is loaded when that estimator is asked for, or all of them are listed.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from aolink.errors import EstimatorError
from aolink.extensions import names_with, row_named
from aolink.limits import check_room
from aolink.optics.sensor import RegionSensor
from aolink.plant.alike import MANY_STATES, alike_systems
from aolink.rig import Rig

if TYPE_CHECKING:
    from aolink.estimation.estimator import Estimator
    from aolink.estimation.kalman.filter import Filter
    from aolink.estimation.options import Engine, Options

GROUP = "aolink.estimators"
"""The entry points by which other packages add estimators."""
DEFAULT_ESTIMATOR = "moments"
"""The estimator where one is needed and none is named: also for a controller, as it takes milliseconds an exposure."""
BASELINE_ESTIMATOR = "o1"
"""The estimator that others are compared with: it takes the centroid of a blurred spot alone."""
# Spots of one copy of the plant, by `moments`.
_MOST_SPOTS = 128
_LOADED_BYTES = 384 << 20
"""Address space of the libraries and of the compiled code of an estimator. LLVM ends a process that lacks it."""


@dataclass(frozen=True, kw_only=True)
class EstimatorRow:
    """All that aolink needs to know about an estimator."""

    name: str
    rank: int
    """Rank in tables and plots, from the simplest estimator to the one that is shown first; aolink's own ranks are
    multiples of ten."""
    colour: tuple[int, int, int]
    """Red, green and blue, 0 to 255."""
    build: Callable[[Rig, Options], Filter]
    """A function that makes the filter for a rig; the filter states its needs of a frame and updates with them."""
    refusal: Callable[[Rig], str | None] = lambda rig: None
    """A function that gives the reason why it cannot work on a rig, and what to use instead; None where it can."""
    engines: tuple[Engine, ...] = ("aolink",)
    """Engines that it can run on."""
    loops: Callable[[Rig], tuple[str, ...]] = lambda rig: ()
    """The groups of compiled loops (`compiled.GROUPS`) that it needs on a rig, beside those that all need."""


def estimator_row(name: str) -> EstimatorRow:
    """The row of an estimator, whose name may have its options. Raises EstimatorError if there is none, or if the
    package that has it is broken."""
    return row_named(name.partition(":")[0], _OURS, GROUP, "estimator", EstimatorError)


def estimator_rows() -> tuple[EstimatorRow, ...]:
    """All rows by rank; with a warning for each that cannot be loaded."""
    rows = []
    for name in names_with(_OURS, GROUP):
        try:
            rows.append(estimator_row(name))
        except EstimatorError as error:
            warnings.warn(str(error), stacklevel=2)
    return tuple(sorted(rows, key=lambda row: (row.rank, row.name)))


def make_estimator(rig: Rig, name: str, **options: Any) -> Estimator:
    """An estimator by its name.

    Parameters
    ----------
    name:
        One of `ESTIMATOR_NAMES`; its options may follow, as in ``o3:second_order`` (`options.with_options`). The
        estimates bear the whole text as their estimator's name.
    options:
        Fields of `Options`; those in the name come first.

    Raises
    ------
    EstimatorError
        There is no such estimator or option, or it cannot work on this rig.
    """
    check_room(_LOADED_BYTES, "making an estimator", EstimatorError)
    # Not before: whoever wants no more of a row than its colour and rank waits for none of these.
    from aolink.estimation.compiled import make_ready
    from aolink.estimation.estimator import Estimator
    from aolink.estimation.model.exposure_model import exposure_model
    from aolink.estimation.options import checked_options, with_options

    row, chosen = estimator_row(name), checked_options(**options | with_options(name)[1])
    if reason := row.refusal(rig):
        raise EstimatorError(reason)
    if chosen.engine not in row.engines or (chosen.engine == "filterpy" and rig.plant.axes != 1):
        able = ", ".join(each.name for each in estimator_rows() if chosen.engine in each.engines)
        raise EstimatorError(
            f"engine {chosen.engine!r} runs {able} on a plant of one axis, this is {name} with"
            f" plant.axes = {rig.plant.axes}: use engine 'aolink'"
        )

    make_ready(*_shared_loops(rig), *row.loops(rig))

    # Code that the first exposure would load or compile is ready before the session.
    steps = rig.window_steps
    try:
        exposure_model(rig.plant, steps, rig.timing.exposure_offset).response(np.ones((steps, rig.n_inputs)))
        return Estimator(rig, name, row.build(rig, chosen))
    except (ArithmeticError, ValueError) as error:  # a LinAlgError is a ValueError
        raise EstimatorError(
            f"{name} cannot compute with this rig: {error}; are its numbers too large or too small?"
        ) from error


def _many_spots_refusal(rig: Rig, name: str = "moments") -> str | None:
    if rig.plant.n_outputs > 2 * _MOST_SPOTS and alike_systems(rig.plant) is None:
        return (
            f"{name} takes at most {_MOST_SPOTS} spots that one plant moves together (it compares every two of them),"
            f" {rig.name} has {rig.plant.n_outputs // 2}: use o3"
        )
    return None


def _pixels_refusal(rig: Rig) -> str | None:
    """Why profile cannot work on a rig; it has another form for many equal systems."""
    if isinstance(rig.sensor, RegionSensor):
        return f"profile takes the kernel of a spot, {rig.name} sees a region: use moments"
    if alike_systems(rig.plant) is not None:
        return None
    if rig.plant.n_states > MANY_STATES:
        return (
            f"profile takes at most {MANY_STATES} states of a plant that is not of equal systems side by side,"
            f" {rig.name} has {rig.plant.n_states}: use o3"
        )
    if reason := _many_spots_refusal(rig, "profile"):  # its widest Gaussian is found by windowed moments
        return reason
    if rig.sensor.spot_light is not None:
        return f"profile takes each spot to have all its light, {rig.name} has partly lit lenslets: use moments or o3"
    return None


def _shared_loops(rig: Rig) -> tuple[str, ...]:
    if alike_systems(rig.plant) is not None:
        return ("larger plants", "many spots")
    small = (rig.plant.n_states, rig.plant.n_inputs, rig.plant.n_outputs) == (2, 1, 1)
    return ("o1 to o3 and moments",) if small else ("o1 to o3 and moments", "larger plants")


def _pixels_loops(rig: Rig) -> tuple[str, ...]:
    return () if alike_systems(rig.plant) is not None else ("profile",)


def _built(maker: str, *orders: int) -> Callable[[Rig, Options], Filter]:
    """The function of that name in `aolink.estimation.filters`, which is loaded when it is called."""

    def build(rig: Rig, options: Options) -> Filter:
        from aolink.estimation import filters

        made: Filter = getattr(filters, maker)(rig, options, *orders)
        return made

    return build


_PAPER_ENGINES: tuple[Engine, ...] = ("aolink", "filterpy")
_OURS = {
    row.name: row
    for row in (
        EstimatorRow(name="open-loop", rank=0, colour=(204, 121, 167), build=_built("open_loop")),
        EstimatorRow(name="o1", rank=10, colour=(86, 180, 233), build=_built("paper", 1), engines=_PAPER_ENGINES),
        EstimatorRow(name="o2", rank=20, colour=(120, 130, 255), build=_built("paper", 2), engines=_PAPER_ENGINES),
        EstimatorRow(name="o3", rank=30, colour=(240, 110, 50), build=_built("paper", 1, 2), engines=_PAPER_ENGINES),
        EstimatorRow(
            name="moments", rank=40, colour=(0, 175, 125), build=_built("moments"), refusal=_many_spots_refusal,
        ),
        EstimatorRow(
            name="profile", rank=50, colour=(140, 210, 80), build=_built("profile"),
            refusal=_pixels_refusal, loops=_pixels_loops,
        ),
    )
}  # fmt: skip
