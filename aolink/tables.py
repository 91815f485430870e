"""What the command line prints: facts and tables."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table

from aolink.calibration.rig_text import written
from aolink.estimation import Estimate
from aolink.estimation.score import Consistency, Score, Scorer
from aolink.recording import schemas_pb2 as pb
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.session import Report

if TYPE_CHECKING:
    from aolink.calibrating import Calibrated
    from aolink.demo import DemoResult
    from aolink.estimation.exposure_scan import ExpectedError
    from aolink.recording.compare import TopicComparison
    from aolink.recording.deblur import Summary
    from aolink.rig import Rig
    from aolink.slopes import FrameSlopes

_LATENCY_STEPS = (
    ("exposure end to first byte", "exposure_end_ns", "first_byte_ns"),
    ("first byte to frame complete", "first_byte_ns", "complete_ns"),
    ("frame complete to estimated", "complete_ns", "estimated_ns"),
    ("estimated to next command sent", "estimated_ns", "command_sent_ns"),
    ("command sent to acknowledged", "command_sent_ns", "command_acknowledged_ns"),
    ("command sent to applied", "command_sent_ns", "command_applied_ns"),
)

_LOSSES = (
    "frames_lost", "frames_incomplete", "scenes_lost", "scenes_incomplete", "packets_missing", "packets_bad_crc",
    "packets_bad_framing", "packets_bad_payload", "chunks_refused", "steps_late", "steps_clipped", "steps_parked",
)  # fmt: skip
"""What a session counts of what went wrong."""


def score_all(recording: Recording, estimates: Mapping[str, Iterable[Estimate]]) -> dict[str, Score]:
    """Score estimates against the truth in their recording, by estimator; one exposure at a time is in memory."""
    names = list(estimates)
    if not names:
        return {}
    scorers = {name: Scorer() for name in names}
    for exposure, each in zip(recording.exposures(), zip(*estimates.values(), strict=True), strict=True):
        for name, estimate in zip(names, each, strict=True):
            scorers[name].add(exposure, estimate)
    return {name: scorer.result() for name, scorer in scorers.items()}


def recording_facts(recording: Recording) -> dict[str, Any]:
    """What `aolink info` says of a recording."""
    duration_s = (recording.end_ns - recording.start_ns) / 1e9
    return {
        "file": str(recording.path),
        "bytes": recording.path.stat().st_size,
        "complete": recording.complete,
        "damage": recording.damage,
        "duration_s": duration_s,
        "messages": dict(sorted(recording.counts.items())),
        "rates_per_s": {
            topic: round((count - 1) / duration_s, 3)
            for topic, count in sorted(recording.counts.items())
            if duration_s and count > 1
        },
        "gaps": _gaps(recording),
        "losses": _losses(recording),
        "damaged_parts": [loss.text() for loss in recording.losses],
        "truth": topics.TRUTH in recording.counts,
        "session": {name: _typed(name, value) for name, value in recording.metadata.items()},
        "estimators": recording.estimators,
    }


def _gaps(recording: Recording) -> dict[str, float]:
    """Where the camera's frames are further apart than their period: how often, and the longest, in fast steps."""
    period, last, gaps = recording.rig.timing.frame_period_steps, None, []
    for recorded in recording.messages(topics.EXPOSURE):
        first = recorded.message.first_step  # type: ignore[attr-defined]
        if last is not None and first - last != period:
            gaps.append(first - last - period)
        last = first
    return {"count": len(gaps), "longest_steps": max(gaps, default=0)}


def _losses(recording: Recording) -> dict[str, int]:
    """What was lost in the session, by cause; and in the file."""
    counted = {
        name: int(recording.metadata[name])
        for name in _LOSSES
        if recording.metadata.get(name, "0").isdigit() and int(recording.metadata.get(name, "0"))
    }
    if recording.losses:
        counted["parts_of_the_file"] = len(recording.losses)
    return counted


def _typed(name: str, value: str) -> Any:
    """A value of the metadata, which knows text only."""
    if name in ("note", "rig", "rig_digest", "camera", "mirror"):
        return value
    with contextlib.suppress(ValueError):
        return _without_nan(float(value) if not value.lstrip("-").isdigit() else int(value))
    return {"True": True, "False": False}.get(value, value)


def facts(values: Mapping[str, Any]) -> Table:
    """Name and value, line by line."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    flat = {name: value for name, value in values.items() if name != "session"} | values["session"]
    for name, value in flat.items():
        if name in ("damage", "warnings") and not value:
            continue
        if isinstance(value, Mapping):
            value = ", ".join(f"{key} {count}" for key, count in value.items())
        elif isinstance(value, list):
            value = " ".join(value) or "none"
        table.add_row(name, escape(str(value)))
    return table


def scores(by_name: Mapping[str, Score]) -> Table:
    """RMSE against truth, NIS and NEES with their 95 % bounds; what is outside its bounds is marked."""
    counted = next((each.exposures for each in by_name.values()), 0)
    title = f"Estimates of {counted} exposures against the truth" if counted else "No truth in this recording: NIS only"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, caption_justify="left", pad_edge=False)
    table.add_column("estimator", no_wrap=True)
    columns: dict[str, Callable[[Score], str]] = {"NIS": lambda each: _consistency(each.nis)}
    if counted:
        columns = {
            "RMSE start": lambda each: f"{each.start_rmse:.4f}",
            "RMSE end": lambda each: f"{each.end_rmse:.4f}",
            "RMSE path": lambda each: f"{each.path_rmse:.4f}",
            **columns,
            "NEES start": lambda each: _consistency(each.start_nees),
            "NEES end": lambda each: _consistency(each.end_nees),
        }
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    for name, each in by_name.items():
        table.add_row(name, *(column(each) for column in columns.values()))
    table.caption = (
        "RMSE of states: norm over the states. ! outside the 95 % bounds of a consistent filter:\n" + _bounds(by_name)
    )
    return table


def _consistency(value: Consistency) -> str:
    return "-  " if math.isnan(value.mean) else f"{value.mean:.2f}{'  ' if value.inside else ' !'}"


def _bounds(by_name: Mapping[str, Score]) -> str:
    """NEES and NIS bounds; those of NIS depend on how many moments an estimator takes."""
    nis: dict[str, list[str]] = {}
    for name, each in by_name.items():
        if not math.isnan(each.nis.mean):
            nis.setdefault(f"{each.nis.low:.2f} to {each.nis.high:.2f}", []).append(name)
    parts = [f"NIS {bounds} for {', '.join(names)}" for bounds, names in nis.items()]
    nees = next((each.end_nees for each in by_name.values() if not math.isnan(each.end_nees.mean)), None)
    if nees:
        parts.insert(0, f"NEES {nees.low:.2f} to {nees.high:.2f}")
    return "; ".join(parts)


def scores_as_json(by_name: Mapping[str, Score]) -> dict[str, Any]:
    """The same for scripts; what is not known is null."""
    return {name: _without_nan(asdict(each)) for name, each in by_name.items()}


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_without_nan(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def session_as_json(report: Report) -> dict[str, Any]:
    """What `session` says, for scripts."""
    facts = asdict(replace(report, latencies=[]))
    del facts["latencies"]
    facts["latency_ms"] = {
        name: dict(zip(("p50", "p99"), values, strict=True))
        for name, since, until in _LATENCY_STEPS
        if (values := _latency_ms(report.latencies, since, until)[1:])
    }
    return dict(_without_nan(facts))


def session(report: Report) -> Table:
    """Frames, commands, link, clock and latencies of a session."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_row(
        "frames",
        f"{report.frames_received} received, of them {report.frames_incomplete} with chunks missing;"
        f" {report.frames_lost} lost whole",
    )
    table.add_row(
        "link",
        f"packets thrown away: {report.packets_bad_crc} for their checksum, {report.packets_bad_framing} for their"
        f" framing, {report.packets_bad_payload} for their content; {report.packets_duplicate} came twice;"
        f" {report.packets_missing} missing by their numbers",
    )
    table.add_row(
        "commands",
        f"{report.steps_commanded} steps commanded, {report.steps_applied} applied, {report.steps_late} late,"
        f" {report.steps_superseded} superseded, {report.steps_clipped} clipped, {report.steps_parked} parked;"
        f" {report.blocks_retransmitted} blocks sent again",
    )
    table.add_row(
        "clock",
        f"device minus host {report.clock_offset_ns / 1e9:.6f} s, {report.clock_frequency_ppm:+.2f} ppm,"
        f" standard deviation {report.clock_sigma_ns / 1e3:.0f} us",
    )
    if report.virtual_time:
        table.add_row("latency", "n/a on virtual time")
    for name, since, until in () if report.virtual_time else _LATENCY_STEPS:
        table.add_row("latency", f"{name}: {_percentiles(report.latencies, since, until)}")
    return table


def _percentiles(latencies: Sequence[pb.Latency], since: str, until: str) -> str:
    count, *percentiles = _latency_ms(latencies, since, until)
    if not percentiles:
        return "no sample"
    return f"p50 {percentiles[0]:.2f} ms, p99 {percentiles[1]:.2f} ms ({count:.0f} frames)"


def _latency_ms(latencies: Sequence[pb.Latency], since: str, until: str) -> list[float]:
    """Number of frames, median and 99th percentile; the number alone where it is zero."""
    values = [
        (getattr(each, until) - getattr(each, since)) / 1e6
        for each in latencies
        if getattr(each, until) and getattr(each, since)
    ]
    return [len(values), *map(float, np.percentile(values, [50, 99]))] if values else [0.0]


def deblurred(summary: Summary) -> dict[str, Any]:
    """What came of restored pictures; PSNRs are means over the scenes, None where the true scene is not known."""
    blurred, restored = summary.psnr_blurred, summary.psnr_restored
    return {
        "exposures": summary.exposures,
        "scenes_restored": summary.scenes,
        "missing": dict(summary.reasons),
        "psnr_blurred_db": float(np.mean(blurred)) if blurred else None,
        "psnr_restored_db": float(np.mean(restored)) if restored else None,
        "psnr_restored_least_db": min(restored) if restored else None,
    }


def deblurred_lines(summary: Summary, estimator: str, method: str) -> list[str]:
    """The same in words."""
    facts = deblurred(summary)
    scenes = f"{facts['scenes_restored']} scenes" if facts["scenes_restored"] else "spots"
    lines = [f"{scenes} of {facts['exposures']} exposures restored with the path of {estimator}, {method}"]
    if facts["psnr_blurred_db"] is not None:
        lines.append(
            f"PSNR of the scene: {facts['psnr_blurred_db']:.1f} dB as it came (its shift forgiven),"
            f" {facts['psnr_restored_db']:.1f} dB restored (at least {facts['psnr_restored_least_db']:.1f})"
        )
    return lines + [f"{count} not restored: {reason}" for reason, count in summary.reasons.items()]


def demo_summary(result: DemoResult, command: str) -> list[str]:
    """What came of the demo, and what to run next with ``command``."""
    if result.rrd is None:
        return [f"interrupted; what was recorded is in {result.recording}"]
    if result.differences:
        lines = [f"online and offline differ: {name}, {what}" for name, what in result.differences.items()]
    else:
        lines = ["online and offline estimates agree bit for bit"]
    if result.deblurred is not None:
        lines += deblurred_lines(result.deblurred, result.deblurred_by, "tv")
    lines.append("times     " + ", ".join(f"{name} {seconds:.1f} s" for name, seconds in result.seconds.items()))
    lines.append(f"recording {result.recording}")
    if result.deblurred_recording is not None:
        lines.append(f"deblurred {result.deblurred_recording}")
    lines.append(f"rerun     {result.rrd}")
    lines.append(f"picture   {result.picture}" if result.picture else f"picture   none: {result.no_picture}")
    lines.append(f"next      {command} view {result.deblurred_recording or result.recording}")
    lines.append(f"          {command} info {result.recording}")
    lines.append(f"          {command} estimate {result.recording} --estimator o3")
    return lines


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
        "pull: what the file says less what was measured, in standard deviations",
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
        lines.append(f"hot or noisy pixels, left out: {', '.join(map(str, found.hot_pixels))}")
    return lines


def calibration_as_json(result: Calibrated) -> dict[str, Any]:
    """The same for scripts; what is not known is null."""
    found, sensor = result.calibration, result.rig.sensor
    before = {
        "sensor.black_level": sensor.black_level,
        "sensor.noise_density": sensor.noise_density,
        "sensor.counts_per_density": sensor.counts_per_density,
        "sensor.photoelectrons": sensor.photoelectrons,
        "sensor.kernel.sigma": sensor.kernel.sigma,
    }
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
    return dict(
        _without_nan(
            {
                "values": values,
                "read_noise_counts": asdict(found.read_noise),
                "counts_per_photoelectron": found.gain and asdict(found.gain),
                "spot": spot and {**asdict(spot), "gaussian": spot.gaussian},
                "frames": found.frames,
                "hot_pixels": found.hot_pixels,
                "notes": found.notes,
            }
        )
    )


def batch(rows: Sequence[Mapping[str, Any]]) -> Table:
    """What came of many recordings and models, a row each."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    columns = ("recording", "model", "estimator", "exposures", "path_rmse", "end_rmse", "nis", "end_nees", "not_ok")
    for name in columns:
        table.add_column(name, justify="left" if name in columns[:3] else "right", no_wrap=True)
    for row in rows:
        if row["error"]:
            table.add_row(Path(row["recording"]).name, escape(row["model"]), "failed")
            continue
        cells = [Path(row["recording"]).name if name == "recording" else row[name] for name in columns]
        table.add_row(*(escape(f"{cell:.4g}" if isinstance(cell, float) else str(cell or "")) for cell in cells))
    return table


def comparison(found: Mapping[str, TopicComparison]) -> Table:
    """Topic by topic: how many messages were compared, and what differs first."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("topic", "field"):
        table.add_column(name, no_wrap=True)
    for name in ("compared", "differ", "largest", "relative"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("first")
    for topic, each in found.items():
        if each.same:
            table.add_row(topic, "", str(each.compared), "0", "", "", "")
        for name, field in each.fields.items():
            frame = f"frame {field.first.frame_id}: " if field.first.frame_id is not None else ""
            sizes = (f"{field.largest:.2g}", f"{field.largest_relative:.2g}")
            table.add_row(
                topic, name, str(each.compared), str(field.messages), *sizes, escape(frame + field.first.text)
            )
        for count, what, first in (
            (each.missing, "missing", each.first_missing),
            (each.added, "added", each.first_added),
        ):
            if count:
                table.add_row(topic, what, str(each.compared), str(count), "", "", escape(first))
    return table


def comparison_as_json(found: Mapping[str, TopicComparison], *, same_rig: bool) -> dict[str, Any]:
    """The same for scripts; a difference without a size is null."""
    same = same_rig and all(each.same for each in found.values())
    return dict(_without_nan({"same": same, "same_rig": same_rig, "topics": {k: asdict(v) for k, v in found.items()}}))


def slopes_as_json(result: FrameSlopes) -> dict[str, Any]:
    """What `aolink slopes` says of a frame."""
    lattice, reference = result.lattice, result.reference
    return {
        "spots": len(lattice.spots),
        "reference_spots": len(reference.spots),
        "pitch_px": lattice.pitch,
        "reference_pitch_px": reference.pitch,
        "turn_deg": lattice.turn_deg,
        "shift_px": result.shift_px.tolist(),
        "displacement_rms_px": float(np.sqrt(np.nanmean(result.displacements_px**2))),
        "wavefront_rms": result.rms,
        "wavefront_peak_to_valley": result.peak_to_valley,
        "wavefront_unit": "m" if result.in_metres else "px x pitch",
    }


def slopes(result: FrameSlopes) -> Table:
    """`slopes_as_json` for people."""
    said = slopes_as_json(result)
    unit, factor = ("nm", 1e9) if result.in_metres else ("px x pitch", 1.0)
    grid = Table.grid(padding=(0, 2))
    x, y = said["shift_px"]
    for name, value in (
        ("spots", f"{said['spots']}, the reference has {said['reference_spots']}"),
        ("pitch", f"{said['pitch_px']:.3f} px, the reference's {said['reference_pitch_px']:.3f} px"),
        ("grid turned by", f"{said['turn_deg']:.2f} degrees"),
        ("shift", f"{x:+.2f}, {y:+.2f} px along x and y, up to whole pitches"),
        ("displacements", f"{said['displacement_rms_px']:.3f} px rms, without the shift"),
        ("wavefront", f"{result.rms * factor:.4g} {unit} rms, {result.peak_to_valley * factor:.4g} peak to valley"),
    ):
        grid.add_row(name, value)
    return grid


def exposure_scan(rig: Rig, errors: Sequence[ExpectedError]) -> Table:
    """What `aolink rig --exposure-scan` says; the rig's own exposure time is marked."""
    table = Table(box=box.SIMPLE_HEAD)
    for title in ("exposure steps", "s", "RMSE path", "RMSE output at end", "centroid noise"):
        table.add_column(title, justify="right")
    for each in errors:
        own = " *" if each.exposure_steps == rig.timing.exposure_steps else "  "
        seconds = f"{each.exposure_steps * rig.timing.fast_step_s:.4g}"
        values = (f"{x:.4f}" for x in (each.path_rms, each.end_rms, each.noise_rms))
        table.add_row(f"{each.exposure_steps}{own}", seconds, *values)
    return table
