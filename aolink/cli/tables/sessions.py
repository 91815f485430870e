"""Tables of the results of a session, of restored pictures and of the demo."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from aolink.cli.tables.json import without_nan
from aolink.estimation.registry import BASELINE_ESTIMATOR
from aolink.estimation.score import unused_lines
from aolink.recording import schemas_pb2 as pb

if TYPE_CHECKING:
    from aolink.jobs.demo import DemoResult
    from aolink.recording.deblur import RestoredCounts
    from aolink.session import EstimatorReport, Report
    from aolink.session.report import ControlReport

_LATENCY_STEPS = (
    ("exposure end to first byte", "exposure_end_ns", "first_byte_ns"),
    ("first byte to frame complete", "first_byte_ns", "complete_ns"),
    ("frame complete to estimated", "complete_ns", "estimated_ns"),
    ("estimated to next command sent", "estimated_ns", "command_sent_ns"),
    ("command sent to acknowledged", "command_sent_ns", "command_acknowledged_ns"),
    ("command sent to applied", "command_sent_ns", "command_applied_ns"),
)


def session_as_json(report: Report) -> dict[str, Any]:
    """The content of `session` as JSON, for scripts."""
    facts = asdict(replace(report, latencies=[], control=None))
    del facts["latencies"]
    if (control := report.control) is not None:
        facts["control"] = {"controller": control.controller, "estimator": control.estimator, **control.counts()}
    for each in facts["estimation"].values():
        took_ms = each.pop("took_ms")
        each["ms"] = dict(zip(("p50", "p99"), np.percentile(took_ms, [50, 99]), strict=True)) if took_ms else {}
    facts["latency_ms"] = {
        name: dict(zip(("p50", "p99"), values, strict=True))
        for name, since, until in _LATENCY_STEPS
        if (values := _latency_ms(report.latencies, since, until)[1:])
    }
    return dict(without_nan(facts))


def session(report: Report) -> Table:
    """Frames, commands, clock and latencies of a session; counts of what went wrong only where they are not zero."""
    table = Table(box=None, show_header=False, pad_edge=False)
    faults = report.connection_faults
    frames = (report.frames_incomplete, "with chunks missing"), (report.frames_lost, "lost whole")
    connections = (
        (faults["bad_crc"], "discarded for their checksum"), (faults["bad_framing"], "discarded for their framing"),
        (faults["bad_payload"], "discarded for their content"), (faults["duplicates"], "duplicates"),
        (faults["sequence_gaps"], "missing by their sequence numbers"),
    )  # fmt: skip
    steps = report.commands
    commands = (
        (steps.clipped, "of these clipped"), (steps.superseded, "superseded"), (steps.late, "late"),
        (steps.refused, "refused"), (steps.not_reported, "not reported"),
    )  # fmt: skip
    mirror = (
        (report.steps_parked, "steps of the session parked"), (report.rearmed, "times re-armed after its watchdog"),
        (report.blocks_retransmitted, "blocks sent again"), (report.reports_asked, "requests for missing reports"),
    )  # fmt: skip
    counts = {
        "frames": [f"{report.frames_received} received", *_counted(frames)],
        "connections": _counted(connections),
        "commands": [f"{steps.commanded} steps commanded", f"{steps.applied} applied", *_counted(commands)],
        "mirror": _counted(mirror),
    }  # fmt: skip
    for name, parts in counts.items():
        if parts:
            table.add_row(name, ", ".join(parts))
    for line in steps.lines():
        table.add_row("answers", line)
    if report.ports_vanished:
        gone = f"vanished {report.ports_vanished} times, and {report.away_s:.2f} s until all had returned"
        table.add_row("ports", gone)
    table.add_row(
        "clock",
        f"device minus host {report.clock_offset_ns / 1e9:.6f} s, {report.clock_frequency_ppm:+.2f} ppm,"
        f" standard deviation {report.clock_sigma_ns / 1e3:.0f} us",
    )
    for name, each in report.estimation.items():
        table.add_row("estimates", f"{name}: {_estimation(each)}")
    if report.control is not None:
        table.add_row("control", _control(report.control))
    for name, since, until in () if report.virtual_time else _LATENCY_STEPS:
        table.add_row("latency", f"{name}: {_percentiles(report.latencies, since, until)}")
    return table


def _counted(counts: Iterable[tuple[int, str]]) -> list[str]:
    return [f"{count} {what}" for count, what in counts if count]


def _control(report: ControlReport) -> str:
    served = f" with {report.estimator}" if report.estimator else ""
    text = f"{report.controller}{served}: {report.exposures} exposures taken, slopes {report.slope_rms:.4g} rms"
    if delay := report.counts().get("delay_ms"):
        text += f"; delay p50 {delay:.3g} ms, longest {report.counts()['longest_delay_ms']:.3g} ms"
    counts = (
        (report.late_exposures, "later than control.delay_s"), (report.open_exposures, "with the loop open"),
        (report.fall_back_exposures, "fallen back"),
        (report.clipped_steps, "steps changed by the limits"),
    )  # fmt: skip
    return ", ".join([text, *_counted(counts)])


def _estimation(report: EstimatorReport) -> str:
    text = f"{report.estimated} of {report.estimated + report.skipped} exposures"
    if report.skipped:
        text += f", {report.skipped} skipped" + (": it failed" if report.failed else " for want of time")
    if report.unmeasured:
        text += f", {report.unmeasured} without a measurement: `aolink info` says why"
    if report.took_ms:
        p50, p99 = np.percentile(report.took_ms, [50, 99])
        text += f"; one takes p50 {p50:.2f} ms, p99 {p99:.2f} ms"
    return text


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


def deblurred_lines(summary: RestoredCounts, estimator: str, method: str) -> list[str]:
    """The results for restored pictures, in words; PSNRs are means over the scenes."""
    scenes = f"{summary.scenes} scenes" if summary.scenes else f"spots in {summary.spots}"
    lines = [f"{scenes} of {summary.exposures} exposures restored with the path of {estimator}, {method}"]
    if summary.psnr_restored:
        lines.append(
            f"PSNR of the scene: {np.mean(summary.psnr_blurred):.1f} dB as recorded (shift removed),"
            f" {np.mean(summary.psnr_restored):.1f} dB restored (at least {min(summary.psnr_restored):.1f})"
        )
    if summary.expected_gains:
        lines += adds_error(method, float(np.mean(summary.expected_gains)))
    lines += unused_lines({estimator: summary.motion.result()})
    return lines + [f"{count} not restored: {reason}" for reason, count in summary.reasons.items()]


def adds_error(method: str, expected_gain_db: float) -> list[str]:
    """A line where a method expects to make a picture worse."""
    if not expected_gain_db < 0:
        return []
    return [
        f"{method} leaves more error than the blurred picture has, by its own model ({expected_gain_db:.1f} dB): take"
        " tv, gauss_markov or smoother"
    ]


def demo_summary(result: DemoResult, command: str) -> list[str]:
    """The results of the demo, what to run next with ``command``, and the sentence to remember."""
    if result.rrd is None:
        return [f"interrupted; what was recorded is in {result.recording}"]
    lines = [f"online and offline differ: {name}, {what}" for name, what in result.differences.items()]
    lines = lines or ["online and offline estimates agree bit for bit"]
    if result.deblurred is not None:
        lines += [f"{count} not restored: {reason}" for reason, count in result.deblurred.reasons.items()]
    picture = result.picture or f"none: {result.no_picture}"
    return [
        *lines, "times     " + ", ".join(f"{name} {seconds:.1f} s" for name, seconds in result.seconds.items()),
        f"picture   {picture}", f"next      {command} view {result.recording}",
        f"          {command} estimate {result.recording} --estimator profile", "", demo_sentence(result),
    ]  # fmt: skip


def demo_sentence(result: DemoResult) -> str:
    """How well the path is known and the scene restored, and what the closed loop leaves, in one sentence."""
    errors = {name: score.path_rmse for name, score in result.scores.items() if not math.isnan(score.path_rmse)}
    parts = [_path_known(errors)] if errors else []
    if result.residuals:
        left = ", ".join(f"{name} {value:.4g}" for name, value in result.residuals.items())
        parts.append(f"the slopes left are, rms, {left}")
    if result.deblurred is not None and result.deblurred.psnr_restored:
        before, after = np.mean(result.deblurred.psnr_blurred), np.mean(result.deblurred.psnr_restored)
        parts.append(
            f"the scene, restored with the path of the spot beside it, goes from {before:.1f} to {after:.1f} dB (PSNR)"
        )
    text = "; ".join(parts or ["the truth is not known here, and so no error either"])
    return f"{text[0].upper()}{text[1:]}."


def _path_known(errors: Mapping[str, float]) -> str:
    """The path's error by the estimator of the highest rank, beside that of the centroid."""
    best, centroid = list(errors)[-1], errors.get(BASELINE_ESTIMATOR)
    known = f"{errors[best]:#.3g}"
    if centroid is None or best == BASELINE_ESTIMATOR:
        return f"the path is known to {known} slope units by {best}"
    ratio = centroid / errors[best]
    times = "no better"
    if not 0.95 < ratio < 1.05:
        times = f"{ratio:.1f} times better" if ratio > 1 else f"{1 / ratio:.1f} times worse"
    said = f"the centroid ({BASELINE_ESTIMATOR}) gives the path to {centroid:#.3g} slope units"
    return f"with the rig file's plant {said}, the blur ({best}) to {known}, {times}"
