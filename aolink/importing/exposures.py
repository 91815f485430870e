"""A film becomes the frames of a rig: light to counts, times to fast steps, several frames to one exposure.

The result is the data that a session records for each exposure: a frame and the inputs of its fast steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.assembly import Assembler, Frame
from aolink.errors import ImportingError
from aolink.exposure import Exposure
from aolink.films.film import Film
from aolink.importing.brightness import brightness_of, change_of
from aolink.importing.defects import defects_note, find_defects
from aolink.importing.frames import (
    FilmAccount,
    FilmLight,
    FilmSettings,
    FrameTimes,
    ImportedExposure,
    counts_of,
    default_scale,
    frame_times,
    grouped,
    nonlinear_note,
    rig_frame,
)
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.camera import to_density
from aolink.optics.centroid import weighted_centroid
from aolink.optics.sensor import RegionSensor
from aolink.rig import Rig
from aolink.series import Series, in_memory
from aolink.units import counted
from aolink.wire.messages_pb2 import Applied

_FASTER = 0.75
"""Commands at a shorter distance than this part of a fast step are too many for the rig."""
_WEIGHT = 2.5
"""Standard deviation of the weight under which a spot's light is measured, in those of the kernel."""
_FEWEST = 10
"""Number of exposures from which on it can be seen that light fades."""


def imported(film: Film, rig: Rig, settings: FilmSettings, account: FilmAccount) -> Iterator[ImportedExposure]:
    """The exposures of a film, one after the other; ``account`` is filled in on the way.

    Raises `ImportingError` where the film does not fit the rig file.
    """
    times = frame_times(film, rig, settings)
    account.missing, account.left_out = max(0, times.missing - film.left_out), film.account
    account.frames = film.left_out
    account.notes = (*film.notes, *times.notes, *(() if settings.invert else film.saturation_notes))
    if film.start_ns is None and settings.start_ns is None:
        account.notes += ("when it was taken is not known: its times count from 1970 without --film start=DATE",)
    if film.nonlinear and settings.gamma == 1.0:
        account.notes += (nonlinear_note(film),)
    if rig.sensor.row_time_s is None and film.shape[0] > 1 and not film.slopes:
        account.notes += (
            "whether its rows were exposed one after the other is not known: give --film row_time=S, or 0",
        )
    if film.slopes:
        yield from _of_slopes(film, rig, settings, times, account)
        return
    if settings.scale is not None and settings.scale < 0:
        raise ImportingError(f"--film scale={settings.scale:g} must be above 0 for pictures; there is --film invert")
    light = FilmLight(film, settings)
    cut = _windows(film, rig, settings.places)
    of_spots = not isinstance(rig.sensor, RegionSensor)
    sd = math.sqrt(rig.sensor.kernel.variance) / rig.sensor.pixel_width
    defects = find_defects(film, light, sd) if of_spots else np.zeros(film.shape, np.bool_)
    if defects.any():
        account.notes += (defects_note(defects, of_rig=not settings.places),)
        light = FilmLight(film, settings, defects)
    offset = rig.sensor.black_level if settings.invert or settings.subtract_median else 0.0
    scale = settings.scale or default_scale(film, rig.sensor.full_scale)
    inputs = _Inputs(film, rig, settings, times)
    account.notes += inputs.notes
    groups = grouped(film, settings.frames_per_exposure, times.periods, lambda frame: cut(*light.of(frame)))
    shine = np.ones(film.count)
    if of_spots:
        shine = _brightness([_spot_light(offset + scale * group.mean, ~group.bad, rig) for group in groups])
    if len(shine) and (change := change_of(shine)):
        shown = f"from {shine[0]:.2f} to {shine[-1]:.2f} of the rig file's"
        account.notes += (
            f"the light of the spots {change} over the film, {shown}: exposures are scaled to the latter",
        )
    black = rig.sensor.black_level
    groups = grouped(film, settings.frames_per_exposure, times.periods, lambda frame: cut(*light.of(frame)))
    for group, bright in zip(groups, shine.tolist(), strict=of_spots):
        mean = group.mean
        if settings.scale is None and film.dtype.kind == "f" and mean.max() > 1.0:
            what = f"floating-point values up to {mean.max():.6g}, where 1.0 would be full scale"
            raise ImportingError(f"{film.name} has {what}: say with --film scale=COUNTS how many counts one is")
        counts = offset + scale * mean
        if bright != 1.0:
            counts = black + (counts - black) / bright
        pixels, mask = counts_of(counts, ~group.bad, rig, account)
        account.frames += settings.frames_per_exposure
        account.exposures += 1
        unknown = rig.sensor.row_time_s is None and film.inputs is not None  # only inputs have times of their own
        frame = rig_frame(group, times, rig, settings.frames_per_exposure, pixels, mask, unknown)
        yield ImportedExposure(frame=frame, inputs=inputs.until(frame.last_step + 1))


def _windows(
    film: Film, rig: Rig, places: tuple[tuple[float, float], ...]
) -> Callable[[FloatArray, BoolArray], tuple[FloatArray, BoolArray]]:
    """What makes a frame of the rig's sensor of the light and the bad pixels of a film's frame: the windows about
    ``places``, one for each spot; without places the frame itself."""
    sensor, (height, width) = rig.sensor, film.shape
    if not places:
        if film.shape != sensor.shape:
            own = f"the rig file {rig.name} {' x '.join(map(str, sensor.shape))}: change its [sensor], or give --at X,Y"
            raise ImportingError(f"{film.name} has frames of {height} x {width} pixels, {own}")
        return lambda *frame: frame
    if len(places) != sensor.spots:
        raise ImportingError(f"--at gives {len(places)} places, the rig file {rig.name} has {sensor.spots} spots")
    if sensor.row_starts_s.any():
        raise ImportingError("with --at the rows of the sensor are not the film's: leave out row_time")
    rows, columns = (pixels // windows for pixels, windows in zip(sensor.shape, sensor.grid, strict=True))
    cuts = []
    for x, y in places:
        left, top = (math.floor(at - (side - 1) / 2 + 0.5) for at, side in ((x, columns), (y, rows)))
        if not (0 <= left <= width - columns and 0 <= top <= height - rows):
            window = f"window of {columns} x {rows} pixels about --at {x:g},{y:g}"
            raise ImportingError(f"{film.name}: the {window} is not inside its pictures of {width} x {height} pixels")
        cuts.append(np.s_[top : top + rows, left : left + columns])

    def cut(light: FloatArray, bad: BoolArray) -> tuple[FloatArray, BoolArray]:
        frame, wrong = np.full(sensor.shape, np.median(light)), np.zeros(sensor.shape, dtype=np.bool_)
        for spot, window in enumerate(cuts):
            frame[sensor.window_of(spot)], wrong[sensor.window_of(spot)] = light[window], bad[window]
        return frame, wrong

    return cut


def _spot_light(counts: FloatArray, usable: NDArray[np.bool_], rig: Rig) -> FloatArray:
    """Light of each spot of an exposure over that which the rig file gives it, (spots, 2): under a weight about the
    spot, which changes with its blur, and in its whole window, which has more noise.

    It is zero where it is not known: a pixel of the window cannot be used, or the spot is at its border.
    """
    sensor, found = rig.sensor, np.zeros((rig.sensor.spots, 2))
    sd = _WEIGHT * math.sqrt(sensor.kernel.variance) / sensor.pixel_width
    for spot in range(sensor.spots):
        at = sensor.window_of(spot)
        window = to_density(sensor, counts[at]) * sensor.pixel_size / sensor.light_of(spot * sensor.directions)
        ((x, y),) = weighted_centroid(window[None], sd)
        rows, columns = window.shape
        border = min(x, columns - 1 - x, *((y, rows - 1 - y) if rows > 1 else ()))
        if usable[at].all() and border >= sd:  # False where it is NaN
            weight = np.exp(-(((np.arange(rows)[:, None] - y) ** 2 + (np.arange(columns) - x) ** 2) / (2 * sd**2)))
            found[spot] = np.sum(window * weight), window.sum()
    return found


def _brightness(light: list[FloatArray]) -> FloatArray:
    """Light of the spots in each exposure, over that of the rig file, (exposures,); one everywhere if it does not
    change."""
    if len(light) < _FEWEST:
        return np.ones(len(light))
    found = np.array(light)
    known: BoolArray = np.asarray((found > 0).all(axis=2))
    if np.count_nonzero(np.any(known, axis=1)) < _FEWEST:
        return np.ones(len(light))
    found[~known] = np.nan
    steadier = np.argmin(np.nanstd(found, axis=(0, 1)) / np.nanmean(found, axis=(0, 1)))
    curve = brightness_of(np.nan_to_num(found[:, :, steadier]))
    if change_of(curve) is None:
        return curve
    return np.asarray(curve * found[known, 1].sum() / (known * curve[:, None]).sum())


def _of_slopes(
    film: Film, rig: Rig, settings: FilmSettings, times: FrameTimes, account: FilmAccount
) -> Iterator[ImportedExposure]:
    """The exposures of a film without pictures: all of their pixels are missing."""
    if settings.places or settings.invert or settings.subtract_median or settings.gamma != 1.0:
        raise ImportingError(f"{film.name} has slopes: --at, and --film invert, background and gamma, need pictures")
    if film.shape[1] != rig.n_outputs:
        own = f"the rig file {rig.name} {rig.n_outputs}: change its [plant] and [sensor]"
        raise ImportingError(f"{film.name} has {film.shape[1]} slopes in each frame, {own}")
    pixels, mask = np.zeros(rig.sensor.shape, np.uint16), np.zeros(rig.sensor.shape, np.bool_)
    inputs = _Inputs(film, rig, settings, times)
    account.notes += inputs.notes
    for group in grouped(
        film, settings.frames_per_exposure, times.periods, lambda frame: (frame.astype(np.float64), ~mask)
    ):
        slopes = group.mean[0] * (settings.scale or 1.0)
        account.frames += settings.frames_per_exposure
        account.exposures += 1
        frame = rig_frame(group, times, rig, settings.frames_per_exposure, pixels, mask)
        yield ImportedExposure(frame=replace(frame, slopes=slopes), inputs=inputs.until(frame.last_step + 1))


def film_series(film: Film, rig: Rig, settings: FilmSettings) -> Series:
    """The exposures of a film in memory. Raises `ImportingError` as `imported`."""
    assembler, made = Assembler(rig), list[Exposure]()
    for each in imported(film, rig, settings, FilmAccount()):
        first = each.frame.last_step + 1 - len(each.inputs)
        applied = Applied(first_step=first, n_steps=len(each.inputs), u=each.inputs.ravel())
        made += [*assembler.add_frame(each.frame), *assembler.add_applied(applied)]
    return in_memory(rig, made + assembler.flush())


class _Inputs:
    """The inputs that the mirror held; its parked input where the film has none."""

    def __init__(self, film: Film, rig: Rig, settings: FilmSettings, times: FrameTimes) -> None:
        self._rows, self._park, self._next = film.inputs, rig.mirror.park, 0
        self.notes: tuple[str, ...] = ()
        """Notes for the user about steps whose inputs are not known."""
        if film.inputs is None:
            return
        if film.inputs.shape[1] != rig.n_inputs:
            own = f"the rig file {rig.name} {rig.n_inputs}: change its [plant]"
            raise ImportingError(f"{film.name} has {film.inputs.shape[1]} inputs in each step, {own}")
        timing, K = rig.timing, settings.frames_per_exposure
        firsts = times.periods * (timing.frame_period_steps // K)  # first step of each frame
        end = int(firsts[-1]) + (timing.exposure_steps if K == 1 else 1)
        if film.input_times_ns is not None:
            self._rows, self.notes = self._at_times(film, firsts, times, rig, end)
        elif len(film.inputs) == film.count:  # one for each frame, held until the next
            steps = np.diff(firsts, append=firsts[-1] + timing.frame_period_steps // K)
            self._rows = np.repeat(film.inputs, steps, axis=0)
        elif len(film.inputs) < end:
            wanted = f"give one for each of its {film.count} frames, or one for each of its {end} fast steps"
            raise ImportingError(f"{film.name} has inputs of {len(film.inputs)} steps: {wanted}")

    def _at_times(
        self, film: Film, firsts: NDArray[np.int64], times: FrameTimes, rig: Rig, end: int
    ) -> tuple[FloatArray, tuple[str, ...]]:
        """The rows in the steps 0 .. end - 1, each from the step nearest to its time until that of the next row.

        The clock of the frames says which step a time is in, so that a rig file's rate that is not quite theirs does
        not move commands against pictures.
        """
        assert film.inputs is not None
        assert film.input_times_ns is not None
        rows, times_ns, name = film.inputs, film.input_times_ns, film.name
        starts = times.starts_ns - times.starts_ns[0]
        step_ns = starts[-1] / firsts[-1] if firsts[-1] else rig.timing.fast_step_ns
        at = np.interp(times_ns, starts, firsts)
        at += (np.minimum(times_ns, 0) + np.maximum(times_ns - starts[-1], 0)) / step_ns
        first = np.rint(at).astype(np.int64)
        period = float(np.median(np.diff(times_ns))) / 1e9 if len(rows) > 1 else np.inf
        if period < _FASTER * rig.timing.fast_step_s:
            own = f"the rig file {rig.name} a fast step every {rig.timing.fast_step_s:.6g} s: change timing.fast_step_s"
            raise ImportingError(f"{name} has a command every {period:.6g} s, {own}")
        held = np.searchsorted(first, np.arange(end), side="right") - 1
        known = np.where((held >= 0)[:, None], rows[np.maximum(held, 0)], self._park)
        early, late = int(np.count_nonzero(first < 0)), int(np.count_nonzero(first >= end))
        unknown = int(np.count_nonzero(held < 0))
        notes = []
        if early or late:
            notes.append(f"{counted(early, 'command')} before the first exposure and {late} after the last left out")
        if replaced := int(np.count_nonzero(np.diff(first) < 1)):
            notes.append(f"{counted(replaced, 'command')} left out: the next one came in the same fast step")
        if unknown:
            notes.append(
                f"the first command comes {counted(unknown, 'fast step')} after the first exposure: parked until then"
            )
        return known, tuple(notes)

    def until(self, end: int) -> FloatArray:
        """Inputs of the steps from the end of the last call on, (steps, n_inputs)."""
        steps = np.arange(self._next, end)
        self._next = end
        if self._rows is None:
            return np.tile(self._park, (len(steps), 1))
        return np.asarray(self._rows[steps])


def exposures(
    frames: NDArray[Any], rig: Rig, inputs: NDArray[Any] | None = None, start_steps: Sequence[int] | None = None
) -> Series:
    """Exposures of frames in memory, as `aolink.exposures` gives them."""
    values = np.asarray(frames)
    if values.ndim != 3 or values.dtype.kind not in "biuf" or values.shape[1:] != rig.sensor.shape or not len(values):
        rows, columns = rig.sensor.shape
        wanted = f"expected counts of the rig {rig.name} of shape (frames, {rows}, {columns})"
        raise ImportingError(f"the frames are {values.dtype} of shape {values.shape}, {wanted}")
    full = rig.sensor.full_scale
    if not np.isfinite(values).all() or values.min() < 0 or values.max() > full or (values != np.rint(values)).any():
        raise ImportingError(f"frames are counts of the rig's camera: whole numbers from 0 to {full}")
    count, timing = len(values), rig.timing
    starts = np.arange(count) * timing.frame_period_steps if start_steps is None else np.asarray(start_steps)
    if (
        starts.shape != (count,) or starts.dtype.kind not in "iu" or starts[0] < 0
        or (np.diff(starts.astype(np.int64)) < timing.exposure_steps).any()
    ):  # fmt: skip
        apart = f"each at least {timing.exposure_steps} (one exposure) after the one before"
        raise ImportingError(f"start_steps must be {count} fast steps, from 0 on, {apart}")
    end = int(starts[-1]) + rig.timing.exposure_steps
    held = np.tile(rig.mirror.park, (end, 1)) if inputs is None else np.asarray(inputs)
    if held.dtype.kind not in "iuf":
        raise ImportingError(f"inputs must be numbers, found {held.dtype}")
    held = held.astype(np.float64, copy=False)
    if held.ndim != 2 or held.shape[1] != rig.n_inputs or len(held) < end:
        raise ImportingError(f"inputs must be ({end} fast steps or more, {rig.n_inputs}), found {held.shape}")
    if not np.isfinite(held).all():
        raise ImportingError("inputs must be finite numbers")
    assembler, made = Assembler(rig), list[Exposure]()
    mask = np.ones(rig.sensor.shape, dtype=np.bool_)
    step = 0
    for k, start in enumerate(starts.tolist()):
        until = start + rig.timing.exposure_steps
        applied = Applied(first_step=step, n_steps=until - step, u=held[step:until].ravel())
        step = until
        frame = Frame(
            frame_id=k + 1, first_step=start, last_step=until - 1, pixels=values[k].astype(np.uint16), mask=mask,
            chunks_lost=0, frames_lost_before=0, device_start_ns=start * rig.timing.fast_step_ns,
            device_end_ns=until * rig.timing.fast_step_ns, host_first_byte_ns=0, host_receive_ns=0,
            exposure_offset_ns=rig.timing.exposure_offset_ns,
        )  # fmt: skip
        made += [*assembler.add_frame(frame), *assembler.add_applied(applied)]
    return in_memory(rig, made + assembler.flush())
