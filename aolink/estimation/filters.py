"""The filters of aolink's own estimators, made for a rig: what the rows of the registry build."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from aolink.errors import EstimatorError
from aolink.estimation.frames.centroid_noise import centroid_covariance
from aolink.estimation.frames.frame_data import Profile, SpotWindows
from aolink.estimation.kalman.filter import BlurFilter, Filter, PathFilter
from aolink.estimation.kalman.filterpy_engine import FilterpyMoments
from aolink.estimation.kalman.path_moments import Observation, PathMoments
from aolink.estimation.kalman.region_moments import RegionMoments
from aolink.estimation.kalman.steady_gain import steady_gain
from aolink.estimation.model.exposure_model import exposure_model
from aolink.estimation.moments.joint_moments import JointMoments
from aolink.estimation.moments.windowed import WindowedMoments
from aolink.estimation.options import Options
from aolink.estimation.pixels.joint_pixels import JointProfile
from aolink.numerics.arrays import FloatArray
from aolink.optics.sensor import RegionSensor, SpotSensor
from aolink.plant.alike import alike_systems
from aolink.rig import Rig

_WARM: set[int] = set()
"""Directions of pixels for which the code of `profile` is loaded in this process."""


def _blur_filter(rig: Rig, options: Options, observation: Observation[Any] | None, **more: Any) -> BlurFilter:
    return BlurFilter(rig.plant, observation, gate=options.gate, **more)


def open_loop(rig: Rig, options: Options) -> Filter:
    return _blur_filter(rig, options, None)


def paper(rig: Rig, options: Options, *orders: int) -> Filter:
    """The filters of Mishra & Wen with these moments."""
    if isinstance(rig.sensor, RegionSensor):
        return _of_region(rig, options, *orders)
    gain = _steady_gain(rig) if orders == (1,) else None
    if options.engine == "filterpy":
        theirs = FilterpyMoments(rig.plant, orders, gain)
        return _blur_filter(rig, options, theirs, predictor=theirs.predict)
    second_order = options.second_order and 2 in orders
    observation = PathMoments(rig.plant, orders, gain, second_order=second_order)
    if PathFilter.suits(rig.plant):
        few = PathFilter(rig.plant, observation, gate=options.gate)
        few.warm_up(exposure_model(rig.plant, rig.window_steps, rig.timing.exposure_offset))
        return few
    if second_order:
        spots = rig.plant.n_outputs // 2
        raise EstimatorError(f"second_order is for plants of one spot, {rig.name} has {spots}: use moments")
    return _blur_filter(rig, options, observation)


def _of_region(rig: Rig, options: Options, *orders: int, models_noise: bool = False) -> Filter:
    assert isinstance(rig.sensor, RegionSensor)
    if 1 not in orders or options.engine != "aolink":
        raise EstimatorError("a region's path is estimated by o1, o3 and moments with aolink's own engine: use moments")
    return _blur_filter(rig, options, RegionMoments(rig.sensor.texture, orders, models_noise=models_noise))


@lru_cache(maxsize=4)
def _steady_gain(rig: Rig) -> FloatArray | None:
    """The steady-state gain of o1 by the noise in the rig file, one for all axes or one each; None if there is none."""
    model = exposure_model(rig.plant, rig.window_steps, rig.timing.exposure_offset)
    # Axes whose spots have the same light share a gain.
    noises, of_axis = np.unique(centroid_covariance(rig), axis=0, return_inverse=True)
    gains = [steady_gain(model, model.process_noise, noise) for noise in noises]
    if len(gains) == 1:
        return gains[0]
    known = [gain for gain in gains if gain is not None]
    return np.array(known)[of_axis] if len(known) == len(gains) else None


def moments(rig: Rig, options: Options) -> Filter:
    if isinstance(rig.sensor, RegionSensor):
        return _of_region(rig, options, 1, 2, models_noise=True)
    if rig.plant.n_outputs == 1:
        _warm_up_line(rig)
    if alike_systems(rig.plant) is not None:
        _warm_up(rig)
    return _blur_filter(rig, options, _windowed(rig))


def _windowed(rig: Rig) -> Observation[Any]:
    """Windowed moments of a line sensor, of spots, or of all spots of a plant with hundreds of states."""
    if alike_systems(rig.plant) is not None:
        return JointMoments(_spots(rig), rig.plant.n_outputs)
    return WindowedMoments(rig.sensor, rig.plant.n_outputs)


def _spots(rig: Rig) -> SpotSensor:
    """The sensor of a rig whose plant moves whole spots: `parse_rig` refuses a line there."""
    assert isinstance(rig.sensor, SpotSensor)
    return rig.sensor


def _warm_up(rig: Rig) -> None:
    """Estimate a dark exposure of many spots, so that what this loads is loaded before the session."""
    sensor, steps = _spots(rig), rig.window_steps
    model = exposure_model(rig.plant, steps, rig.timing.exposure_offset)
    shape = (rig.plant.axes, rig.plant.n_outputs // 2, *sensor.window)
    dark = SpotWindows(density=np.zeros(shape), mask=np.ones(shape, dtype=bool))
    for each in (JointMoments, JointProfile):
        blur_filter = BlurFilter(rig.plant, each(sensor, rig.plant.n_outputs))
        blur_filter.step(model, model.response(np.zeros((steps, rig.n_inputs))), dark)


def _warm_up_line(rig: Rig) -> None:
    """Estimate a dark exposure of one line, so that what this loads is loaded before the session."""
    plant, pixels = replace(rig.plant, axes=1), rig.sensor.profile.pixels
    model = exposure_model(plant, 2)
    dark = Profile(density=np.zeros((1, pixels)), mask=np.ones((1, pixels), dtype=bool))
    one = BlurFilter(plant, _windowed(rig))
    one.step(model, model.response(np.zeros((2, plant.n_inputs))), dark)


def profile(rig: Rig, options: Options) -> Filter:
    if alike_systems(rig.plant) is None:
        from aolink.estimation.pixels.likelihood import reduction
        from aolink.estimation.pixels.profile import ProfileFilter

        few = ProfileFilter(rig.plant, rig.sensor, gate=options.gate)
        if rig.sensor.directions not in _WARM:
            few.warm_up()
            _WARM.add(rig.sensor.directions)
        reduction(exposure_model(rig.plant, rig.window_steps, rig.timing.exposure_offset), rig.sensor)
        return few
    _warm_up(rig)
    return _blur_filter(rig, options, JointProfile(_spots(rig), rig.plant.n_outputs))
