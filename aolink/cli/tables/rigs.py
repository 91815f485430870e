"""Tables about a rig: measured values, and the errors to expect."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.table import Table

from aolink.cli.tables.json import without_nan

if TYPE_CHECKING:
    from aolink.estimation.exposure_scan import ExpectedError
    from aolink.jobs.calibrate import Calibrated
    from aolink.optics.slopes import FrameSlopes
    from aolink.rig import Rig


def calibration(result: Calibrated) -> Table:
    """Value in the file, measured value, standard deviation, and by how many of them the file is off."""
    counts = ", ".join(f"{n} {kind}" for kind, n in result.calibration.frames.items())
    table = Table(
        title=f"Calibration from frames: {counts}", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False,
        caption="\n".join(_calibration_facts(result)), caption_justify="left",
    )  # fmt: skip
    table.add_column("key", no_wrap=True)
    for name in ("in the file", "measured", "sd", "pull"):
        table.add_column(name, justify="right", no_wrap=True)
    for key, row in calibration_as_json(result)["values"].items():
        shown = (
            "-" if row["measured"] is None else row["written"],
            _number(row["sd"], ".2g"),
            _number(row["pull"], "+.1f"),
        )
        table.add_row(key, f"{row['file']:g}", *shown)
    return table


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _calibration_facts(result: Calibrated) -> list[str]:
    found = result.calibration
    lines = [
        "pull: the file's value less the measured one, in standard deviations",
        f"read noise {found.read_noise.value:.4g} counts (sd {found.read_noise.sd:.2g})",
    ]
    if found.gain is not None:
        lines[-1] += f", {found.gain.value:.4g} counts per photo-electron (sd {found.gain.sd:.2g})"
    if found.spot is not None:
        where = ", ".join(f"{x:.4g}" for x in found.spot.positions)
        verdict = "" if found.spot.gaussian else ": not a Gaussian"
        lines.append(
            f"spot at {where}; fit of the kernel: chi-square {found.spot.chi_square:.0f}"
            f" for {found.spot.freedom} degrees of freedom{verdict}"
        )
    if found.hot_pixels:
        numbers = ", ".join(map(str, found.hot_pixels))
        lines.append(f"hot or noisy pixels, left out, and written as sensor.defects: {numbers}")
    return lines


def calibration_as_json(result: Calibrated) -> dict[str, Any]:
    """The calibration as JSON, for scripts; unknown values are null."""
    from aolink.calibration.rig_text import written  # with scipy.stats, half of what `aolink info` took to start

    found, sensor = result.calibration, result.rig.sensor
    names = ("black_level", "noise_density", "counts_per_density", "photoelectrons")
    before = {f"sensor.{name}": getattr(sensor, name) for name in names} | {"sensor.kernel.sigma": sensor.kernel.sigma}
    values = {}
    for key, value in before.items():
        measured = found.values.get(key)
        values[key] = {
            "file": value,
            "measured": measured and measured.value,
            "written": measured and written(measured),
            "sd": measured and measured.sd,
            "pull": measured and (value - measured.value) / (measured.sd or math.nan),
        }
    spot = found.spot
    facts = {
        "values": values, "read_noise_counts": asdict(found.read_noise),
        "counts_per_photoelectron": found.gain and asdict(found.gain),
        "spot": spot and {**asdict(spot), "gaussian": spot.gaussian}, "frames": found.frames,
        "hot_pixels": found.hot_pixels, "notes": found.notes,
    }  # fmt: skip
    return dict(without_nan(facts))


def slopes_as_json(result: FrameSlopes) -> dict[str, Any]:
    """The results of `aolink slopes` for a frame, as JSON."""
    lattice, reference = result.lattice, result.reference
    return {
        "grid": reference.kind,
        "spots": len(lattice.spots),
        "reference_spots": len(reference.spots),
        "pitch_px": lattice.pitch,
        "reference_pitch_px": reference.pitch,
        "turn_deg": lattice.turn_deg,
        "shift_px": result.shift_px.tolist(),
        "displacement_rms_px": float(np.sqrt(np.nanmean(result.displacements_px**2))),
        "wavefront_rms": result.rms,
        "wavefront_peak_to_valley": result.peak_to_valley,
        "pieces": int(result.pieces.max()) + 1,
        "zernikes": {
            f"Z{index}": float(value)
            for index, value in zip(result.zernikes.indices, result.zernikes.coefficients, strict=True)
        },
        "wavefront_unit": "m" if result.in_metres else "px x pitch",
    }


def slopes(result: FrameSlopes) -> Table:
    """`slopes_as_json` for people."""
    said = slopes_as_json(result)
    unit, factor = ("nm", 1e9) if result.in_metres else ("px x pitch", 1.0)
    grid = Table.grid(padding=(0, 2))
    x, y = said["shift_px"]
    # Tilt is the shift, whose whole pitches are not known.
    modes = [(i, c * factor) for i, c in zip(result.zernikes.indices, result.zernikes.coefficients, strict=True)]
    zernikes = ", ".join(f"Z{i} {c:+.4g}" for i, c in modes if 3 < i < 12)
    pieces = said["pieces"]
    for name, value in (
        ("grid", said["grid"]),
        ("spots", f"{said['spots']}, the reference has {said['reference_spots']}"),
        ("pitch", f"{said['pitch_px']:.3f} px, the reference's {said['reference_pitch_px']:.3f} px"),
        ("grid turned by", f"{said['turn_deg']:.2f} degrees"),
        ("shift", f"{x:+.2f}, {y:+.2f} px along x and y, up to whole pitches"),
        ("displacements", f"{said['displacement_rms_px']:.3f} px rms, without the shift"),
        ("wavefront", f"{result.rms * factor:.4g} {unit} rms, {result.peak_to_valley * factor:.4g} peak to valley"),
        *(
            [("", f"in {pieces} pieces that do not touch: the steps between them are not known, each has mean zero")]
            if pieces > 1
            else []
        ),
        ("Zernike modes", f"{zernikes or 'too few spots'} {unit} rms (Noll's order)"),
    ):
        grid.add_row(name, value)
    return grid


def exposure_scan(rig: Rig, errors: Sequence[ExpectedError]) -> Table:
    """The table of `aolink rig --exposure-scan`; the rig's own exposure time is marked."""
    table = Table(box=box.SIMPLE_HEAD)
    for title in ("exposure steps", "s", "RMSE path", "RMSE output at end", "centroid noise"):
        table.add_column(title, justify="right")
    for each in errors:
        own = " *" if each.exposure_steps == rig.timing.exposure_steps else "  "
        seconds = f"{each.exposure_steps * rig.timing.fast_step_s:.4g}"
        values = (f"{x:.4f}" for x in (each.path_rms, each.end_rms, each.noise_rms))
        table.add_row(f"{each.exposure_steps}{own}", seconds, *values)
    return table
