"""The check of a rig file before anything runs on it, for what no single key can say: values that cannot work together,
and those that spoil a session."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Literal, get_args

import numpy as np

from aolink.devices.drivers import KINDS, NATIVE, check_driver, native_port
from aolink.devices.interfaces import Lacks, lacks_of
from aolink.errors import AolinkError
from aolink.estimation.assumptions import broken_assumptions
from aolink.estimation.frames.moments import least_significance, significance_scale, spot_significance
from aolink.numerics.arrays import FloatArray
from aolink.optics.kernel import exposure_density
from aolink.optics.sensor import RegionSensor, Sensor
from aolink.plant.check import nominal_path
from aolink.plant.lifting import lift
from aolink.plant.observability import observability
from aolink.rig import Rig
from aolink.units import with_unit

_ROWS_OF_SPOT, _MOST_SKEW = 4.0, 0.1
"""Standard deviations of a spot's light within which nearly all of it is, and the share of an exposure between the rows
there above which intervals are too narrow: coverage .95 without skew, .93 at .05, .92 at .1, .91 above."""
_LEAST_QUEUE_S = 0.02
"""Shortest queue without a finding, s: an operating system holds a program up for some milliseconds now and then."""
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
    """The errors of a rig file, and what is probably a mistake in it; errors first."""
    try:
        with np.errstate(all="ignore"):
            path, sd = nominal_path(_different_copies(rig))
            of_spots = () if isinstance(rig.sensor, RegionSensor) else (_check_sensor(rig), _check_signal(rig, path))
            findings = [
                *_check_rows(rig), *chain(*of_spots), *_check_motion(rig, path),
                *_check_field(rig, path, sd), *_check_mirror(rig), *_check_observability(rig),
                *(_warning(*each) for each in broken_assumptions(rig)),
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
            lacking = lacks_of(check_driver(kind, table, rig)[0])
            lacks = "; ".join(each for each in lacking if each != Lacks.ROWS) or "nothing"
        except AolinkError as error:
            yield _error(key, str(error).removeprefix(f"{key}: "))
            continue
        yield _info(key, f"the driver {table.driver}; what its device lacks: {lacks}")
        if Lacks.ROWS in lacking and rig.sensor.row_time_s is None:
            yield _warning("sensor.row_time_s", f"is missing, and a camera of the driver {table.driver} {Lacks.ROWS}")
    if rig.devices and "mirror" not in rig.devices:
        yield _info("devices.mirror", "no mirror is named: without --mirror the camera is recorded alone")


def _check_rows(rig: Rig) -> Iterator[Finding]:
    """The camera's row time, and whether one interval does for all rows of a spot."""
    sensor, timing = rig.sensor, rig.timing
    if not sensor.row_time_s:
        return
    exposure_s = timing.exposure_steps * timing.fast_step_s
    rows = min(_ROWS_OF_SPOT * math.sqrt(sensor.kernel.variance) / sensor.pixel_width, sensor.profile.pixels)
    skew = abs(sensor.row_time_s) * rows / exposure_s
    if skew > _MOST_SKEW:
        yield _warning(
            "sensor.row_time_s",
            f"the rows that see one spot are exposed up to {skew:.2g} of an exposure apart, and estimators take all to"
            f" be exposed with the middle one: above {_MOST_SKEW:g}, intervals are too narrow",
        )


def _check_sensor(rig: Rig) -> Iterator[Finding]:
    sensor = rig.sensor
    width = sensor.field[1] - sensor.field[0]
    wide = math.sqrt(float(np.linalg.eigvalsh(sensor.kernel.covariance)[-1]))
    if 2 * wide > width:
        yield _error(
            "sensor.kernel.sigma",
            f"the kernel is wider than the field: its sd is {wide:.3g}, the field {width:g} wide, so most of a spot's"
            " light misses its pixels; sigma is in slope units, as sensor.field is",
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


def _check_signal(rig: Rig, path: FloatArray) -> Iterator[Finding]:
    """Check the spot's signal to noise: at rest, and blurred as the drive moves it."""
    sensor, line = rig.sensor, rig.sensor.profile
    middle = (sensor.field[0] + sensor.field[1]) / 2
    resting = exposure_density(line.kernel, line.edges, np.array([[middle]]))
    whole = float(spot_significance(line, resting)[0])
    steps = min(rig.timing.exposure_steps, path.shape[1])
    first = np.unique(np.linspace(0, path.shape[1] - steps, _WINDOWS).astype(np.intp))
    moved = path[int(np.ptp(path, axis=1).argmax())]
    blurred = exposure_density(line.kernel, line.edges, moved[first[:, None] + np.arange(steps)])
    significance, needed = spot_significance(line, blurred), float(least_significance(line))
    least = float(significance.min())
    peak = sensor.peak_density * sensor.counts_per_density
    if peak < 1:
        yield _error(
            "sensor.counts_per_density",
            f"the brightest pixel of a resting spot has {peak:.2g} counts: the read-out rounds it away",
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


def _check_observability(rig: Rig) -> Iterator[Finding]:
    report = observability(rig.plant, rig.timing.exposure_steps, rig.timing.fast_step_s)
    if not report.rank:
        yield _error("plant.C", "the camera sees no state of the plant")
        return
    for mode in report.unseen:
        if abs(mode.eigenvalue) >= 1 - 1e-9:
            yield _warning("plant.C", f"the outputs do not see all of {mode}; its estimate will never converge")
    for mode in report.lost_by_centroid:
        yield _warning(
            "timing.exposure_steps",
            f"the centroid over {rig.timing.exposure_steps} fast steps loses {mode}, wholly or in part;"
            " the blur may still show it, another exposure time would",
        )


def _different_copies(rig: Rig) -> Rig:
    """The rig with one of all copies of the plant that its drive moves alike: thousands of axes take no longer."""
    plant, drive = rig.plant, rig.drive
    each = np.stack([drive.amplitude, drive.offset]).reshape(2, plant.axes, plant.n_inputs).transpose(1, 0, 2)
    different = np.unique(each, axis=0)
    drive = replace(drive, amplitude=different[:, 0].ravel(), offset=different[:, 1].ravel())
    return replace(rig, plant=replace(plant, axes=len(different)), drive=drive)
