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
from functools import lru_cache
from typing import Any

import numpy as np

from aolink.errors import EstimatorError
from aolink.estimation.compiled import make_ready
from aolink.estimation.estimator import Estimator
from aolink.estimation.frames.centroid_noise import centroid_covariance
from aolink.estimation.frames.frame_data import SpotWindows
from aolink.estimation.kalman.filter import BlurFilter, Filter, TwoStateFilter
from aolink.estimation.kalman.filterpy_engine import FilterpyMoments
from aolink.estimation.kalman.path_moments import Observation, PathMoments, SecondOrderMoments
from aolink.estimation.kalman.predict import added_noise
from aolink.estimation.kalman.steady_gain import steady_gain
from aolink.estimation.looks import LOOKS
from aolink.estimation.model.exposure_model import exposure_model
from aolink.estimation.moments.joint_moments import JointMoments
from aolink.estimation.moments.spots import WindowedSpots
from aolink.estimation.moments.windowed import WindowedMoments
from aolink.estimation.options import Engine, Options, checked_options, with_options
from aolink.estimation.pixels.joint_pixels import JointProfile
from aolink.extensions import names_with, row_named
from aolink.numerics.arrays import FloatArray
from aolink.optics.sensor import Sensor, SpotSensor
from aolink.plant.alike import MANY_STATES, alike_systems
from aolink.rig import Rig

GROUP = "aolink.estimators"
"""The entry points by which other packages add estimators."""
DEFAULT_ESTIMATOR = "o3"
BASELINE_ESTIMATOR = "o1"
"""The estimator that others are compared with: it takes the centroid of a blurred spot alone."""
# Spots of one copy of the plant, by `moments`.
_MOST_SPOTS = 128


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
    wanders: bool = False
    """Whether it follows a plant with ``plant.wandering``; it has to model the noise inside an exposure."""
    in_demo: Callable[[Rig], bool] = lambda rig: True
    """Whether it is fast enough on a rig for `aolink demo`."""


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
    row, chosen = estimator_row(name), checked_options(**options | with_options(name)[1])
    if reason := row.refusal(rig):
        raise EstimatorError(reason)
    if chosen.engine not in row.engines or (chosen.engine == "filterpy" and rig.plant.axes != 1):
        able = ", ".join(each.name for each in estimator_rows() if chosen.engine in each.engines)
        raise EstimatorError(
            f"engine {chosen.engine!r} runs {able} on a plant of one axis, this is {name} with"
            f" plant.axes = {rig.plant.axes}: use engine 'aolink'"
        )

    def made(rig: Rig) -> Estimator:
        # Code that the first exposure would load or compile is ready before the session.
        steps = rig.timing.exposure_steps
        exposure_model(rig.plant, steps, rig.timing.exposure_offset).response(np.ones((steps, rig.n_inputs)))
        return Estimator(rig, name, row.build(rig, chosen))

    if rig.plant.wandering is None or not row.wanders:
        return made(rig)
    from aolink.estimation.wandering import WanderingEstimator  # its imports take long

    return WanderingEstimator(rig, made)


def _blur_filter(rig: Rig, options: Options, observation: Observation[Any] | None) -> BlurFilter:
    return BlurFilter(rig.plant, observation, process_noise=options.process_noise, gate=options.gate)


def _open_loop(rig: Rig, options: Options) -> Filter:
    return _blur_filter(rig, options, None)


def _paper(*orders: int) -> Callable[[Rig, Options], Filter]:
    """The filters of Mishra & Wen with these moments."""

    def build(rig: Rig, options: Options) -> Filter:
        gain = _steady_gain(rig, options) if orders == (1,) and options.gain == "steady-state" else None
        if options.engine == "filterpy":
            theirs = FilterpyMoments(rig.plant, orders, gain, flux=options.flux)
            return BlurFilter(
                rig.plant, theirs, process_noise=options.process_noise, gate=options.gate, predictor=theirs.predict
            )
        if options.second_order and 2 in orders:
            if rig.plant.n_outputs > 2:
                raise EstimatorError(
                    f"second_order is for plants of one spot, {rig.name} has {rig.plant.n_outputs // 2}: use moments"
                )
            return _blur_filter(rig, options, SecondOrderMoments(rig.plant, orders, flux=options.flux))
        moments = PathMoments(rig.plant, orders, gain, flux=options.flux)
        if orders == (1, 2) and TwoStateFilter.suits(rig.plant):
            two = TwoStateFilter(rig.plant, moments, process_noise=options.process_noise, gate=options.gate)
            two.warm_up(exposure_model(rig.plant, rig.timing.exposure_steps, rig.timing.exposure_offset))
            return two
        return _blur_filter(rig, options, moments)

    return build


@lru_cache(maxsize=4)
def _steady_gain(rig: Rig, options: Options) -> FloatArray | None:
    """The steady-state gain of o1 by the noise in the rig file, one for all axes or one each; None if there is none."""
    model = exposure_model(rig.plant, rig.timing.exposure_steps, rig.timing.exposure_offset)
    Q = added_noise(model, options.process_noise)
    # Axes whose spots have the same light share a gain.
    noises, of_axis = np.unique(centroid_covariance(rig), axis=0, return_inverse=True)
    gains = [steady_gain(model, Q, noise) for noise in noises]
    if len(gains) == 1:
        return gains[0]
    known = [gain for gain in gains if gain is not None]
    return np.array(known)[of_axis] if len(known) == len(gains) else None


def _moments(rig: Rig, options: Options) -> Filter:
    if alike_systems(rig.plant) is not None:
        _warm_up(rig)
    return _blur_filter(rig, options, _windowed(rig, options))


def _windowed(rig: Rig, options: Options) -> Observation[Any]:
    """Windowed moments of a line sensor, of spots, or of all spots of a plant with hundreds of states."""
    orders, basis, flux, n_outputs = options.orders, options.basis, options.flux, rig.plant.n_outputs
    if n_outputs == 1:
        return WindowedMoments(rig.sensor.profile, orders, basis=basis, flux=flux)
    assert isinstance(rig.sensor, SpotSensor)
    if alike_systems(rig.plant) is not None:
        return JointMoments(rig.sensor, n_outputs, orders, basis=basis, flux=flux)
    return WindowedSpots(rig.sensor, n_outputs // 2, orders, basis=basis, flux=flux)


def _moments_refusal(rig: Rig) -> str | None:
    if rig.plant.n_outputs > 2 * _MOST_SPOTS and alike_systems(rig.plant) is None:
        return (
            f"moments takes at most {_MOST_SPOTS} spots that one plant moves together (it compares every two of them),"
            f" {rig.name} has {rig.plant.n_outputs // 2}: use o3"
        )
    return None


def _warm_up(rig: Rig) -> None:
    """Estimate a dark exposure of many spots, so that the code for this is loaded before the session."""
    assert isinstance(rig.sensor, SpotSensor)
    steps = rig.timing.exposure_steps
    model = exposure_model(rig.plant, steps, rig.timing.exposure_offset)
    shape = (rig.plant.axes, rig.plant.n_outputs // 2, *rig.sensor.window)
    dark = SpotWindows(density=np.zeros(shape), mask=np.ones(shape, dtype=bool))
    make_ready()
    for each in (JointMoments, JointProfile):
        blur_filter = BlurFilter(rig.plant, each(rig.sensor, rig.plant.n_outputs))
        blur_filter.step(model, model.response(np.zeros((steps, rig.n_inputs))), dark)


def _profile(rig: Rig, options: Options) -> Filter:
    if alike_systems(rig.plant) is None:
        from aolink.estimation.pixels.updates import PROFILE

        return _of_pixels(rig, options, PROFILE.within(options.tempered))
    assert isinstance(rig.sensor, SpotSensor)
    _warm_up(rig)
    return _blur_filter(rig, options, JointProfile(rig.sensor, rig.plant.n_outputs))


def _mixture(rig: Rig, options: Options) -> Filter:
    from aolink.estimation.pixels.updates import MIXTURE

    return _of_pixels(rig, options, MIXTURE.within(options.tempered))


def _sampled(rig: Rig, options: Options) -> Filter:
    from aolink.estimation.pixels.sampled import TemperedUpdater

    return _of_pixels(rig, options, TemperedUpdater(options.particles, options.seed))


def _of_pixels(rig: Rig, options: Options, updates: Any) -> Filter:
    """The filters that use every pixel; their compiled code is loaded when the first one is made."""
    from aolink.estimation.pixels.filter import MixtureFilter
    from aolink.estimation.pixels.updates import MIXTURE

    pixels = MixtureFilter(rig.plant, rig.sensor, updates, gate=options.gate)
    # mixture compiles at once what profile would compile at the first posterior of several modes.
    make_ready()
    pixels.warm_up(MIXTURE)
    updates.reduction(exposure_model(rig.plant, rig.timing.exposure_steps, rig.timing.exposure_offset), rig.sensor)
    return pixels


def _pixels_refusal(name: str) -> Callable[[Rig], str | None]:
    """Why a filter that uses every pixel cannot work on a rig; profile has another form for many equal systems."""

    def refusal(rig: Rig) -> str | None:
        if name == "profile" and alike_systems(rig.plant) is not None:
            return None
        if rig.plant.n_states > MANY_STATES:
            alike = " that does not consist of equal systems side by side" if name == "profile" else ""
            return (
                f"{name} follows the posterior's modes for at most {MANY_STATES} states of one plant, {rig.name} has"
                f" {rig.plant.n_states}{alike}: use {'o3' if alike else 'profile or moments'}"
            )
        if isinstance(rig.sensor, SpotSensor) and rig.sensor.spot_light is not None:
            return (
                f"{name} takes each spot to have the whole light, but {rig.name} has partly lit lenslets:"
                " use moments or o3"
            )
        return None

    return refusal


def _is_line(rig: Rig) -> bool:
    """Whether the sensor is a line: for spots on a plane the filters that use every pixel are too slow for a demo."""
    return isinstance(rig.sensor, Sensor)


def _row(name: str, **rest: Any) -> EstimatorRow:
    return EstimatorRow(name=name, **LOOKS[name]._asdict(), **rest)


_PAPER_ENGINES: tuple[Engine, ...] = ("aolink", "filterpy")
_OURS = {
    row.name: row
    for row in (
        _row("open-loop", build=_open_loop),
        _row("o1", build=_paper(1), engines=_PAPER_ENGINES),
        _row("o2", build=_paper(2), engines=_PAPER_ENGINES),
        _row("o3", build=_paper(1, 2), engines=_PAPER_ENGINES),
        _row("moments", build=_moments, refusal=_moments_refusal, wanders=True),
        _row("profile", build=_profile, refusal=_pixels_refusal("profile"), wanders=True, in_demo=_is_line),
        _row("mixture", build=_mixture, refusal=_pixels_refusal("mixture"), wanders=True, in_demo=_is_line),
        _row("sampled", build=_sampled, refusal=_pixels_refusal("sampled"), wanders=True, in_demo=lambda rig: False),
    )
}
