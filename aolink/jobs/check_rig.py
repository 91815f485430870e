"""The check of a rig file before anything runs on it: errors that cannot work, and values that are probably
mistakes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np

from aolink.devices.drivers import KINDS, NATIVE, check_driver, native_port
from aolink.devices.interfaces import Lacks, lacks_of
from aolink.errors import AolinkError
from aolink.estimation.assumptions import broken_assumptions, peak_snr
from aolink.estimation.frames.moments import least_significance, significance_scale, spot_significance
from aolink.numerics.arrays import FloatArray
from aolink.optics.kernel import exposure_density
from aolink.optics.sensor import Sensor
from aolink.plant.check import nominal_path
from aolink.plant.lifting import lift
from aolink.plant.observability import observability
from aolink.rig import Rig
from aolink.units import with_unit

_FASTEST_STEP_S, _SLOWEST_STEP_S = 1e-6, 0.05
"""A mirror that takes commands at more than 1 MHz or at less than 20 Hz is not a fast mirror on a serial line."""
_SHORTEST_EXPOSURE_S, _LONGEST_EXPOSURE_S = 20e-6, 30.0
_FASTEST_FRAMES_HZ = 2000.0
_MOST_DEAD = 0.95
"""Share of the time in which the camera does not expose."""
_ROWS_OF_SPOT, _MOST_SKEW = 4.0, 0.1
"""Standard deviations of a spot's light within which nearly all of it is, and the share of an exposure between the rows
there above which intervals are too narrow: coverage .95 without skew, .93 at .05, .92 at .1, .91 above."""
_FEWEST_STEPS = 4
"""An exposure of fewer fast steps has hardly any motion that the blur could show."""
_STEPS_IN_PERIOD = 8
"""Fast steps in one period of the drive below which a sine is no longer one."""
_LEAST_QUEUE_S = 0.02
"""Shortest queue without a finding, s: an operating system holds a program up for some milliseconds now and then."""
_LONGEST_WATCHDOG_S = 60.0
_COARSE = 0.05
"""Largest rounding by the converter without a finding, as a share of the drive's range."""
_ROUNDED = 101
"""Number of inputs along the drive's range that are rounded for this check."""
_LARGEST_DRIFT_PPM = 1000.0
"""Quartz clocks keep to 100 ppm."""
_LONGEST_LATENCY_S = 0.1
_GAINS = (1e-3, 1e3)
"""Least and largest counts per photo-electron of any camera."""
_STILL = 0.01
"""Motion inside an exposure, in kernel sds, below which the blur does not show it."""
_WINDOWS = 64
"""Exposures along the drive's path whose blur is checked."""
_DRAWS, _NEARLY_ALL = 400, 0.99
"""Noisy frames that are drawn, and the share of them that must show their spot."""


Severity = Literal["error", "warning", "info"]


@dataclass(frozen=True)
class Finding:
    """One finding of `check_rig`."""

    severity: Severity
    key: str
    """The rig file's key that it is about."""
    message: str


_error, _warning, _info = (partial(Finding, severity) for severity in get_args(Severity))


def check_rig(rig: Rig) -> list[Finding]:
    """The errors of a rig file, its probable mistakes, and the numbers that follow from it; errors first."""
    try:
        with np.errstate(all="ignore"):
            path, sd = nominal_path(_different_copies(rig))
            findings = [
                *_check_timing(rig), *_check_rows(rig), *_check_sensor(rig), *_check_signal(rig, path),
                *_check_motion(rig, path), *_check_field(rig, path, sd), *_check_mirror(rig), *_check_simulation(rig),
                *_check_observability(rig), *(_warning(*each) for each in broken_assumptions(rig)),
            ]  # fmt: skip
    except (ArithmeticError, ValueError) as error:  # a LinAlgError is a ValueError
        return [_error("rig", f"it has numbers that are too large or too small to compute with ({error})")]
    return sorted(findings, key=lambda finding: get_args(Severity).index(finding.severity))


def check_devices(rig: Rig) -> Iterator[Finding]:
    """Whether the drivers that the table [devices] names are there and take its keys; no device is opened."""
    for kind in KINDS:
        table = rig.devices.get(kind)
        if table is None:
            continue
        key = f"devices.{kind}"
        try:
            if table.driver == NATIVE:
                native_port(kind, table)
                continue
            said = rig.sensor.row_time_s is not None
            lacking = lacks_of(check_driver(kind, table, rig)[0])
            lacks = "; ".join(each for each in lacking if each != Lacks.ROWS or not said) or "nothing"
        except AolinkError as error:
            yield _error(key, str(error))
            continue
        yield _info(key, f"the driver {table.driver}; what its device lacks: {lacks}")
    if rig.devices and "mirror" not in rig.devices:
        yield _info("devices.mirror", "no mirror is named: without --mirror the camera is recorded alone")


def _check_timing(rig: Rig) -> Iterator[Finding]:
    timing, step_s = rig.timing, rig.timing.fast_step_s
    exposure_s, period_s = timing.exposure_steps * step_s, timing.frame_period_steps * step_s
    dead = 1 - timing.exposure_steps / timing.frame_period_steps
    yield _info(
        "timing",
        f"a fast step of {with_unit(step_s, 's')} ({with_unit(1 / step_s, 'Hz')}); exposures of {timing.exposure_steps}"
        f" steps, {with_unit(exposure_s, 's')}, one every {with_unit(period_s, 's')} ({with_unit(1 / period_s, 'Hz')}),"
        f" {f'{dead:.0%}' if dead else 'no'} dead time",
    )
    if not _FASTEST_STEP_S <= step_s <= _SLOWEST_STEP_S:
        yield _warning(
            "timing.fast_step_s",
            f"commands at {with_unit(1 / step_s, 'Hz')} are not what a fast mirror takes on a serial line"
            f" ({with_unit(1 / _SLOWEST_STEP_S, 'Hz')} to {with_unit(1 / _FASTEST_STEP_S, 'Hz')}): is it in seconds?",
        )
    if not _SHORTEST_EXPOSURE_S <= exposure_s <= _LONGEST_EXPOSURE_S:
        yield _warning(
            "timing.exposure_steps",
            f"an exposure of {timing.exposure_steps} steps of {with_unit(step_s, 's')} takes"
            f" {with_unit(exposure_s, 's')}: is that the camera's?",
        )
    elif period_s < 1 / _FASTEST_FRAMES_HZ:
        yield _warning(
            "timing.frame_period_steps",
            f"frames at {with_unit(1 / period_s, 'Hz')} are more than a host takes from a serial line",
        )
    if dead > _MOST_DEAD:
        yield _warning(
            "timing.frame_period_steps",
            f"the camera exposes for {1 - dead:.2g} of the time only, {timing.exposure_steps} of"
            f" {timing.frame_period_steps} fast steps",
        )
    if timing.exposure_steps < _FEWEST_STEPS:
        yield _warning(
            "timing.exposure_steps",
            f"{timing.exposure_steps} fast step(s) in an exposure hold no motion that the blur could show:"
            " the mirror should be many times as fast as the camera",
        )


def _check_rows(rig: Rig) -> Iterator[Finding]:
    """The camera's row time, and whether one interval does for all rows of a spot."""
    sensor, timing = rig.sensor, rig.timing
    if not sensor.row_time_s:
        return
    exposure_s = timing.exposure_steps * timing.fast_step_s
    rows = min(_ROWS_OF_SPOT * math.sqrt(sensor.kernel.variance) / sensor.pixel_width, sensor.profile.pixels)
    skew = abs(sensor.row_time_s) * rows / exposure_s
    yield _info(
        "sensor.row_time_s",
        f"the last row is exposed {with_unit(float(sensor.row_starts_s.max()), 's')} after the first; within a spot"
        f" that is {skew:.2g} of the exposure",
    )
    if skew > _MOST_SKEW:
        yield _warning(
            "sensor.row_time_s",
            f"the rows that see one spot are exposed up to {skew:.2g} of an exposure apart, and estimators take all to"
            f" be exposed with the middle one: above {_MOST_SKEW:g}, intervals are too narrow",
        )


def _check_sensor(rig: Rig) -> Iterator[Finding]:
    sensor = rig.sensor
    low, high = sensor.field
    pixel, width = sensor.pixel_width, high - low
    narrow, wide = np.sqrt(np.linalg.eigvalsh(sensor.kernel.covariance)).tolist()
    spots = f" for each of {sensor.spots} spots" if sensor.directions == 2 else ""
    sds = f"{wide:.3g}" if narrow == wide else f"{narrow:.3g} to {wide:.3g}"
    in_pixels = f"{wide / pixel:.3g}" if narrow == wide else f"{narrow / pixel:.3g} to {wide / pixel:.3g}"
    yield _info(
        "sensor",
        f"{sensor.profile.pixels} pixels of {pixel:.4g} over the field [{low:.4g}, {high:.4g}] (slope units){spots};"
        f" the kernel's sd (sigma / sqrt 2) is {sds}, {in_pixels} pixels",
    )
    if 2 * wide > width:
        yield _error(
            "sensor.kernel.sigma",
            f"the kernel is wider than the field: its sd is {wide:.3g}, the field {width:g} wide, so most of a spot's"
            " light misses its pixels; sigma is in slope units, as sensor.field is",
        )
    elif 4 * wide > width:
        yield _warning(
            "sensor.kernel.sigma",
            f"two sd of the kernel to either side, {4 * wide:.3g}, are more than the field, {width:g}: every frame"
            " cuts the spot off",
        )
    noise = 5 * math.sqrt(sensor.noise_density / sensor.pixel_size) * sensor.counts_per_density
    if sensor.black_level < noise:
        yield _warning(
            "sensor.black_level",
            f"five sd of pixel noise are {noise:.4g} counts, more than the black level, {sensor.black_level:g}:"
            " clipped at zero, the noise biases every moment",
        )
    peak = sensor.peak_density * sensor.counts_per_density
    if sensor.black_level + peak + noise > sensor.full_scale:
        yield _warning(
            "sensor.counts_per_density",
            f"a resting spot and five sd of noise reach {sensor.black_level + peak + noise:.5g} counts,"
            f" the full scale is {sensor.full_scale}: lower counts_per_density",
        )
    gain = sensor.counts_per_density / sensor.pixel_size / sensor.photoelectrons if sensor.photoelectrons else 1.0
    if not _GAINS[0] <= gain <= _GAINS[1]:
        yield _warning(
            "sensor.photoelectrons",
            f"{sensor.photoelectrons:g} photo-electrons and counts_per_density = {sensor.counts_per_density:g} make"
            f" {gain:.3g} counts for each photo-electron: cameras have {_GAINS[0]:g} to {_GAINS[1]:g}",
        )


def _check_signal(rig: Rig, path: FloatArray) -> Iterator[Finding]:
    """Check the spot's signal to noise: at rest, and blurred as the drive moves it."""
    sensor, line = rig.sensor, rig.sensor.profile
    peak = sensor.peak_density
    snr = peak_snr(rig)
    middle = (sensor.field[0] + sensor.field[1]) / 2
    resting = exposure_density(line.kernel, line.edges, np.array([[middle]]))
    whole = float(spot_significance(line, resting)[0])
    steps = min(rig.timing.exposure_steps, path.shape[1])
    first = np.unique(np.linspace(0, path.shape[1] - steps, _WINDOWS).astype(np.intp))
    moved = path[int(np.ptp(path, axis=1).argmax())]
    blurred = exposure_density(line.kernel, line.edges, moved[first[:, None] + np.arange(steps)])
    significance, needed = spot_significance(line, blurred), float(least_significance(line))
    least = float(significance.min())
    counts = sensor.counts_per_density
    yield _info(
        "sensor.noise_density",
        f"signal to noise {snr:.3g} in the brightest pixel of a resting spot ({peak * counts:.5g} counts over"
        f" {peak * counts / snr:.4g}); the whole spot stands out by {whole:.3g} sd of noise, blurred by the drive by at"
        f" least {least:.3g}, and estimators ask for {needed:.3g}",
    )
    if peak * counts < 1:
        yield _error(
            "sensor.counts_per_density",
            f"the brightest pixel of a resting spot has {peak * counts:.2g} counts: the read-out rounds it away",
        )
    elif whole < 1:
        yield _error(
            "sensor.noise_density",
            f"the spot is lost in the noise: resting, it stands out by {whole:.2g} sd, less than the noise itself does",
        )
    elif (taken := _taken(line, blurred[significance.argmin()], needed)) < _NEARLY_ALL:
        yield _warning(
            "sensor.noise_density",
            f"blurred by the drive the spot stands out by {least:.2g} sd of noise only, estimators ask for"
            f" {needed:.2g}: about {100 * (1 - taken):.0f} % of such frames will be taken for frames without a spot",
        )


def _taken(line: Sensor, density: FloatArray, needed: float) -> float:
    """The share of noisy frames of a density (pixels,) that show their spot: noise adds to the brightest stretch."""
    noise = np.random.default_rng(0).standard_normal((_DRAWS, line.pixels)) / significance_scale(line)
    return float((spot_significance(line, density + noise) >= needed).mean())


def _check_motion(rig: Rig, path: FloatArray) -> Iterator[Finding]:
    """Check how far the spot moves within an exposure and from one fast step to the next."""
    plant, steps, pixel = rig.plant, rig.timing.exposure_steps, rig.sensor.pixel_width
    kernel_sd = math.sqrt(rig.sensor.kernel.variance)
    inside = min(steps, path.shape[1])
    exposures = path.shape[1] // inside
    driven = float(np.ptp(path[:, : exposures * inside].reshape(len(path), exposures, inside), axis=2).max())
    stepped = float(np.abs(np.diff(path)).max(initial=0.0))
    noise = _wandered(rig, steps)
    yield _info(
        "plant",
        f"within an exposure the spot goes through {driven:.3g} ({driven / pixel:.2g} pixels) under the drive, and"
        f" noise carries it by {noise:.3g} ({noise / pixel:.2g} pixels, sd)",
    )
    jump = stepped + 2 * _wandered(rig, 1)
    if jump > 2 * kernel_sd + pixel:
        yield _warning(
            "timing.fast_step_s",
            f"the spot jumps by {jump:.3g} from one fast step to the next, more than its own width,"
            f" {2 * kernel_sd:.3g}: the model has no motion inside a fast step; make it shorter, or the drive slower",
        )
    if max(driven, noise) < _STILL * kernel_sd and not rig.disturbance:
        yield _warning(
            "plant.process_noise",
            f"within an exposure the spot moves by {max(driven, noise):.2g}, under {_STILL:.0%} of the kernel's sd:"
            " there is no blur to learn from",
        )
    if not (plant.process_noise.any() or plant.initial_covariance.any()):
        yield _warning(
            "plant.process_noise",
            "neither process noise nor doubt about the start: estimators trust their prediction and use no frame",
        )
    drive = rig.drive
    if drive.kind == "sine" and drive.amplitude.any() and drive.period_s < _STEPS_IN_PERIOD * rig.timing.fast_step_s:
        yield _warning(
            "drive.period_s",
            f"{drive.period_s:g} s are {drive.period_s / rig.timing.fast_step_s:.2g} fast steps: too few for a sine",
        )


def _wandered(rig: Rig, steps: int) -> float:
    """Standard deviation of the spot's motion by process noise in some fast steps, the largest of all outputs."""
    plant = rig.plant
    transition, noise = lift(plant, steps)
    change = transition - np.eye(plant.n_states)
    rows = plant.C @ change
    variances = ((rows @ plant.initial_covariance) * rows).sum(axis=1) + ((plant.C @ noise) * plant.C).sum(axis=1)
    return math.sqrt(max(0.0, float(variances.max())))


def _check_field(rig: Rig, path: FloatArray, sd: FloatArray) -> Iterator[Finding]:
    """Check whether the spot stays on the sensor, on its expected path and three standard deviations around it."""
    low, high = rig.sensor.field
    least, most = float(path.min()), float(path.max())
    key = "drive.amplitude" if rig.drive.kind == "sine" else "drive.offset"
    where = f"the spot goes from {least:.3g} to {most:.3g}"
    if least < low or most > high:
        yield _error(
            key,
            f"{where} under the drive, beyond sensor.field = [{low:g}, {high:g}]: lower {key} or widen sensor.field",
        )
        return
    plant = rig.plant
    wide = math.sqrt(max(0.0, float(np.diag(plant.C @ plant.initial_covariance @ plant.C.T).max())))
    if wide > high - low:
        yield _error(
            "plant.process_noise",
            f"noise carries the spot by {wide:.3g} (sd), more than the field is wide, {high - low:g}:"
            " it is hardly ever on the sensor; lower plant.process_noise, or widen sensor.field",
        )
        return
    reach_low, reach_high = float((path - 3 * sd[:, None]).min()), float((path + 3 * sd[:, None]).max())
    if reach_low < low or reach_high > high:
        yield _warning(
            "sensor.field",
            f"{where} under the drive, and process noise carries it from {reach_low:.3g} to {reach_high:.3g}"
            f" (three sd), beyond the field [{low:g}, {high:g}]: moments will be biased there",
        )


def _check_mirror(rig: Rig) -> Iterator[Finding]:
    mirror, step_s = rig.mirror, rig.timing.fast_step_s
    block_s, queue_s = mirror.block_steps * step_s, mirror.queue_steps * step_s
    yield _info(
        "mirror",
        f"commands in blocks of {mirror.block_steps} steps, {with_unit(block_s, 's')}; the device queues"
        f" {with_unit(queue_s, 's')} of them and parks {with_unit(mirror.watchdog_s, 's')} after the last message",
    )
    if queue_s < _LEAST_QUEUE_S:
        yield _warning(
            "mirror.queue_steps",
            f"a queue of {mirror.queue_steps} steps lasts {with_unit(queue_s, 's')}: a host that pauses for so long"
            " leaves the mirror without commands in real time",
        )
    if mirror.watchdog_s < 2 * block_s:
        yield _warning(
            "mirror.watchdog_s",
            f"the mirror parks after {with_unit(mirror.watchdog_s, 's')} without a message, but a block of commands"
            f" lasts {with_unit(block_s, 's')}: shorten mirror.block_steps, or lengthen the watchdog",
        )
    if mirror.watchdog_s > _LONGEST_WATCHDOG_S:
        yield _warning(
            "mirror.watchdog_s",
            f"when its host is gone the mirror goes on for {mirror.watchdog_s:g} s before it parks: is it in seconds?",
        )
    played = rig.drive.offset + np.linspace(-1, 1, _ROUNDED)[:, None] * rig.drive.amplitude
    rounding, span = float(np.abs(mirror.quantise(played) - played).max()), float(np.ptp(played, axis=0).max())
    if span and rounding > _COARSE * span:
        yield _warning(
            "mirror.dac_bits",
            f"{mirror.dac_bits} bits between mirror.input_min and mirror.input_max round the drive by up to"
            f" {rounding:.2g}, and it goes through {span:.2g} only",
        )


def _check_simulation(rig: Rig) -> Iterator[Finding]:
    simulation = rig.simulation
    if abs(simulation.clock_drift_ppm) > _LARGEST_DRIFT_PPM:
        yield _warning(
            "simulation.clock_drift_ppm", f"{simulation.clock_drift_ppm:g} ppm is a broken clock: quartz keeps to 100"
        )
    if simulation.latency_s > _LONGEST_LATENCY_S:
        yield _warning(
            "simulation.latency_s",
            f"{with_unit(simulation.latency_s, 's')} one way is no serial line: is it in seconds?",
        )


def _check_observability(rig: Rig) -> Iterator[Finding]:
    report = observability(rig.plant, rig.timing.exposure_steps, rig.timing.fast_step_s)
    if not report.rank:
        yield _error("plant.C", "the camera sees no state of the plant")
        return
    for mode in report.unseen:
        harm = "it decays by itself" if abs(mode.eigenvalue) < 1 - 1e-9 else "its estimate will never converge"
        yield _warning("plant.C", f"the outputs do not see all of {mode}; {harm}")
    for mode in report.lost_by_centroid:
        yield _warning(
            "timing.exposure_steps",
            f"the centroid over {rig.timing.exposure_steps} fast steps loses {mode}, wholly or in part;"
            " the blur may still show it, another exposure time would",
        )
    yield _info(
        "plant",
        f"the outputs show {report.rank} of the plant's {report.n_states} states, and the centroids of exposures alone"
        f" {report.centroid_rank}; o2 needs {report.o2_needs}",
    )


def _different_copies(rig: Rig) -> Rig:
    """The rig with one of all copies of the plant that its drive moves alike: thousands of axes take no longer."""
    plant, drive = rig.plant, rig.drive
    each = np.stack([drive.amplitude, drive.offset]).reshape(2, plant.axes, plant.n_inputs).transpose(1, 0, 2)
    different = np.unique(each, axis=0)
    drive = replace(drive, amplitude=different[:, 0].ravel(), offset=different[:, 1].ravel())
    return replace(rig, plant=replace(plant, axes=len(different)), drive=drive)
