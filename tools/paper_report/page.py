"""The page: every printed number beside ours, the misprints, the claims that follow and those that do not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from bench_rows.loop_worth import Measured as ClosedLoops

from aolink.plant.lifting import lift
from aolink.plant.observability import observability
from aolink.rig import Rig
from paper_report import figures, numbers
from paper_report.blocks import Block, Heading, PageFigure, Points, Table, Text
from paper_report.ensemble import Cell, IntervalEstimate
from paper_report.judge import Row as JudgedRow
from paper_report.limit import Scene, against_o1_section, limit_section
from paper_report.loop import loop_section
from paper_report.made_films import MadeFilm, made_section
from paper_report.numbers import Effort, ErrorRow, FormRow, Mechanism, Norms, Remark1, Row, late_input_error, number
from paper_report.shake import ShakeRow, shake_section
from paper_report.spheres import Film, film_section
from paper_report.verdict import family_section


@dataclass(frozen=True, kw_only=True)
class Results:
    """All that was computed."""

    printed: Rig
    lively: Rig
    effort: Effort
    rows: list[Row]
    norms: list[Norms]
    """The first is the paper's own reading, the last the lively variant."""
    errors: list[ErrorRow]
    forms: dict[str, tuple[list[FormRow], IntervalEstimate]]
    """Errors by the rig's name: o3 under each printed form, and open loop."""
    remark_1: Remark1
    remark_2: numbers.Remark2
    mechanism: Mechanism
    shake: list[ShakeRow]
    limit: list[Scene]
    over_o1: list[tuple[str, dict[str, IntervalEstimate]]]
    film: list[Film]
    made: list[MadeFilm]
    family: list[JudgedRow]
    loops: list[ClosedLoops]
    cells: list[Cell]


FIGURES = {
    "figure-4.png": "Like figure 4: theta by o1 (solid) and o2 (dashed) against truth. The spot starts at"
    f" {figures.FIRST_THETA:g}, the filters believe 0 ± {figures.FIRST_THETA:g}. Grey: the centroids that o1 sees.",
    "figure-5.png": "Like figure 5: norm of the start state's error against the exposure's number, from the same wrong"
    " start; steady levels (of runs without it) on the right. Dotted: o1 with the gain that a Kalman filter would have"
    " at that time.",
    "figure-6.png": "Like figure 6: error of theta at the fast rate over a section of the run.",
    "figure-7.png": "Like figure 7: inside the exposure in which the input takes the spot farthest. Bands: two standard"
    " deviations by the filter, of the start state only: o1 and o3 leave the noise inside the exposure out. Below: the"
    " frame.",
    "remarks.png": "Left: how much of an undamped mode the centroids of 200 ms exposures show. Right: path RMSE of o1"
    " and o2 against open loop on the lively plant, with 95 % intervals.",
    "map.png": "RMSE of o3 over RMSE of o1 for path, start state and end state, ± half of the 95 % interval; bold where"
    " the interval leaves 1 out.",
    "limit.png": "Path RMSE of all estimators, and their distance from the sampler; dotted: where it costs 5 and 10 %.",
    "family.png": "Each scene a point, by the swings of its fastest mode in an exposure. Left: path RMSE over sampled's"
    " on the same exposures (over o1's where there is none of sampled)."
    " Right: coverage of 95 % intervals; dotted: the goal for each scene.",
}


def build(results: Results) -> list[Block]:
    """The whole page."""
    return [
        *_introduction(results), *_printed_numbers(results), *_figures(), *_steady_levels(results), *_errors(results),
        *_misprints(results), *_remarks(results), *_map(results), *shake_section(results.shake, results.effort),
        *limit_section(results.limit, results.effort, _picture("limit.png")),
        *against_o1_section(results.over_o1, results.effort), *family_section(results.family, _picture("family.png")),
        *film_section(results.film), *made_section(results.made, results.effort),
        *loop_section(results.loops),
    ]  # fmt: skip


def _picture(file: str) -> PageFigure:
    return PageFigure(file, FIGURES[file])


def _introduction(results: Results) -> list[Block]:
    effort = results.effort
    return [
        Heading("Mishra & Wen, section VI, run again", 1),
        Text(
            "The example of \"Extracting Dynamics from Blur\" in aolink's own simulation: C = [1 0], a slow known input"
            " that takes the spot to ±0.5, and misprints corrected unless said otherwise. o1 is the steady-state Kalman"
            " filter on the centroid y_1, o2 the extended one on the second moment y_2, o3 on both; open-loop predicts"
            " and never looks. Equation numbers are the paper's."
        ),
        Text(
            f"Each table is of {effort.runs} independent runs, the map of {effort.map_runs}; the first {effort.skip}"
            " exposures of a run are not scored. ± is one standard error and [ , ] a 95 % interval, both by bootstrap"
            " over runs; where estimators are compared, they saw the same frames. Seeds are fixed: the same version"
            " gives the same page."
        ),
    ]  # fmt: skip


def _printed_numbers(results: Results) -> list[Block]:
    first = results.norms[0]
    levels = [
        Row(f"steady error norm of {name}", f"~{level}", f"state itself: rms {number(first.state_rms)},"
            f" mean {number(first.state_mean)}", f"rms {first.rms[name]}, mean {first.mean[name]}", verdict)
        for name, level, verdict in (
            ("o1", "0.07", "reproduced, by open loop too"), ("o3", "0.05", "not reproduced as a level of its own"))
    ]  # fmt: skip
    rows = [[r.quantity, r.printed, r.expected, r.measured or "—", r.verdict] for r in (*results.rows, *levels)]
    return [
        Heading("Every printed number beside ours"),
        Table(["quantity", "printed", "by the equations", "measured", "verdict"], rows),
    ]


def _figures() -> list[Block]:
    return [Heading("Figures 4 to 7"), *(_picture(f"figure-{n}.png") for n in (4, 5, 6, 7))]


def _time_constants_ms(rig: Rig) -> list[float]:
    return sorted(-1e3 * rig.timing.fast_step_s / math.log(abs(v)) for v in np.linalg.eigvals(rig.plant.A))


def _steady_levels(results: Results) -> list[Block]:
    first, fast = results.norms[0], _time_constants_ms(results.printed)[0]
    *readings, lively = results.norms
    best = min(readings, key=lambda n: n.gain.value)
    variances = np.diag(results.printed.plant.initial_covariance)
    windowed = ""
    if "moments" in first.rms:
        windowed = (
            " (The frames do hold something that goes below it: moments, in a window about the spot, has"
            f" {first.rms['moments']}, and a mean of {first.mean['moments']}.)"
        )
    head = ["reading", "state: rms (mean)"]
    names = list(first.rms)
    head += [f"{name}: rms (mean)" for name in names] + ["o3/o1 [95 %]"]
    rows = [
        [n.reading, f"{number(n.state_rms)} ({number(n.state_mean)})",
         *(f"{n.rms[name]} ({n.mean[name].value:#.3g})" for name in names), n.gain.interval]
        for n in results.norms
    ]  # fmt: skip
    return [
        Heading("Where 0.05 against 0.07 does and does not follow"),
        Text(
            f"About the mean that its input gives it, the plant's state has a norm of rms {number(first.state_rms)} at"
            " the printed noise, before anybody looks. Nearly all of it is x_2, which forgets within"
            f" {fast:.0f} ms and is therefore new in each exposure of 200 ms. Open loop has {first.rms['open-loop']},"
            f" o1 {first.rms['o1']}, o3 {first.rms['o3']}. So the level of 0.07 follows from plant and process noise"
            " alone; it says nothing about the camera."
            + windowed
        ),
        Text(
            f"A lower level for o3 does not follow: o3/o1 is {first.gain.interval} as printed, and the largest gain"
            f" under any reading below of what section VI leaves open is {best.gain.interval} ({best.reading}); even"
            f" the lively variant has {lively.gain.interval}. Two things look like the printed pair. The mean of the"
            " very norm whose rms is"
            f" {number(first.state_rms)} is {number(first.state_mean)}, for o1 to o3 and open loop alike. And from a"
            " wrong start (figure 5) a steady gain takes some fifteen exposures to come down where o3, whose gain"
            " varies, is quicker; but o1 with a gain that varies is just as quick, so that is no merit of y_2."
            " Whether either is what happened, the paper does not say."
        ),
        Text(
            "Where y_2 does pay is the path, off centre, with noise low against the motion: see the map. The norm hides"
            f" it, since the variance of x_2 in it is {variances[1] / variances[0]:.0f} times that of x_1."
        ),
        Table(head, rows),
    ]  # fmt: skip


def _errors(results: Results) -> list[Block]:
    names = list(results.errors[0].rmse)
    rows = [
        [f"{r.process_noise:g}", f"{r.noise_density:g}", f"{r.offset:g}", number(r.expected),
         *(str(r.rmse[n]) for n in names), r.gain.interval]
        for r in results.errors
    ]  # fmt: skip
    text = (
        "RMSE of theta at the fast rate inside the exposures, held at an offset without other input. A claim is worth"
        " something where open loop is far off."
    )
    if "moments" in names:
        text += (
            " moments, which is not the paper's, takes its moments in a window about the spot and models the noise"
            " inside the exposure: most of what o1 and o3 miss is not in the second moment but in the noise of pixels"
            " where the spot is not."
        )
    return [
        Heading("Errors of the path"),
        Text(text),
        Table(["W_f", "V", "offset", "open loop by the equations", *names, "o3/o1 [95 %]"], rows),
    ]


def _misprints(results: Results) -> list[Block]:
    lively, forms = results.lively, {r.form: r for r in results.forms[results.lively.name][0]}
    by_key = {key: next(r for name, r in forms.items() if key in name) for key in _FORM_KEYS}
    cost = {key: f"o3's RMSE of theta becomes {r.ratio.interval} times as large" for key, r in by_key.items()}
    plant, D = results.printed.plant, results.printed.sensor.pixel_width
    _, Q = lift(plant, results.printed.timing.exposure_steps)
    factor = Q[1, 1] / (plant.B_w @ plant.process_noise @ plant.B_w.T)[1, 1]
    bias = results.printed.sensor.kernel.variance + D**2 / 12
    sigma = results.printed.sensor.kernel.sigma
    T_e = results.printed.timing.exposure_steps * results.printed.timing.fast_step_s
    items = [
        f"(20) takes H x̂ for the predicted y_2; h is quadratic, so H x̂ = 2 h(x̂) without input; {cost['H x']}.",
        f"The predictor's u(jN − i) is one step late, it should be u(jN − 1 − i): theta is off by"
        f" {late_input_error(lively, False):.1e} (rms) with the slow input and by {late_input_error(lively, True):.1e}"
        " with one that is drawn anew at each step; below what these runs can show.",
        "(12) to (15) leave out that the input moves the spot inside the exposure, by up to"
        f" {numbers.input_inside(lively):.3f} in its mean; {cost['no input']}.",
        f"(14) gives an exposure's moments as a function of the state at its start, (18) to (20) use them as if of the"
        f" state at its end; {cost['delay']}, the input inside left out as well.",
        f"(17) adds the noise of one fast step for a whole exposure: x_2 gets {factor:.1f} times as much, and x_1 gets"
        f" some; {cost['B_w W']}.",
        f"All of these together: {by_key['all as'].rmse} against {by_key['all corr'].rmse} corrected and"
        f" {results.forms[lively.name][1]} without looking.",
        f"(3) lacks the 1/T_e that (5) needs: its total light would be {T_e:g}, not 1.",
        f"The kernel's constant: (2πσ)^(−1/2) gives a mass of {number(math.sqrt(sigma / 2))}, 1/(σ√π) gives 1; in"
        f" two dimensions, (4), {number(sigma * math.sqrt(math.pi / 2))} for Σ = σI. Its variance is σ²/2 ="
        f" {sigma**2 / 2:.3g}, not σ².",
        f"Section V takes the kernel for a point, section VI does not: y_2 is then too large by {number(bias)}, against"
        " its noise's sd of 0.2 at V = 0.1 and 0.02 at V = 0.001. We take it out.",
        "(7) divides by the light, (9) to (11) do not. The light of a frame has sd √(2V) = "
        f"{math.sqrt(2 * results.printed.sensor.noise_density):.3f} at V = 0.1, so the ratio has no variance; and at"
        f" little noise its moments do have a cross-covariance, {_flux_cross(0.5):.3f} V for a spot at rest at 0.5.",
        "C is printed as [0.001 0], figure 4 has x_1 = θ. With the printed one the spot's own motion has sd"
        f" {1e-3 * math.sqrt(plant.initial_covariance[0, 0]):.1e}, less than a thousandth of a pixel.",
    ]  # fmt: skip
    rows = [
        [form, *(cell for name in results.forms for cell in _form_cells(results, name, form))]
        for form in (*forms, "open loop")
    ]
    head = ["o3 with", *(f"{name}: {what}" for name in results.forms for what in ("RMSE", "ratio [95 %]"))]
    return [
        Heading("Misprints, each with the number that shows it"),
        Points(items),
        Text(
            "RMSE of theta at the exposures' ends, o3 written out apart from the product, without a gate, under the"
            " slow input; the ratio is to the corrected form, paired. At the printed noise no form is far from open"
            " loop, which is why none of this shows in figures made there."
        ),
        Table(head, rows),
    ]


_FORM_KEYS = ("H x", "no input", "delay", "B_w W", "all as", "all corr")


def _flux_cross(position: float) -> float:
    """First-order covariance of y_1 and y_2 of (7) over V, for a point at rest: −y_1 I(2) + y_1 y_2 I(0)."""
    return -position * 2 / 3 + position**3 * 2


def _form_cells(results: Results, name: str, form: str) -> tuple[str, str]:
    rows, open_loop = results.forms[name]
    row = next((r for r in rows if r.form == form), None)
    return (str(row.rmse), row.ratio.interval) if row else (str(open_loop), "")


def _remarks(results: Results) -> list[Block]:
    rig, ranks = results.printed, results.remark_1.ranks
    report = observability(rig.plant, rig.timing.exposure_steps, rig.timing.fast_step_s)
    slow = _time_constants_ms(rig)[1] / 1e3
    radius = max(abs(np.linalg.eigvals(lift(rig.plant, rig.timing.exposure_steps)[0])))
    o2 = results.remark_2.o2
    rows = [[f"{f:g} Hz, undamped", *(f"{r} of 2" for r in seen)] for f, seen in ranks.items()]
    rows.append(["section VI's plant", f"{report.rank} of 2", f"{report.centroid_rank} of 2", "2 of 2"])
    return [
        Heading("Remarks 1 and 2"),
        Text(
            "Remark 1, that centroids keep a plant observable, is not true as stated. An undamped mode of 10 Hz goes"
            " round a whole number of times in 200 ms: its centroid is zero, and the second moment shows its amplitude"
            " but never its phase. At 12.5 Hz A^N = −I, so that every centroid is the same number with the sign turned,"
            " and one state of two is lost; y_2 gives it back to first order. Section VI's own plant is fine: two real"
            f" modes, the slower of {slow:.2g} s."
        ),
        Table(["plant", "seen at the fast rate", "by centroids", "by y_1 and y_2, to first order"], rows),
        Text(
            f"Remark 2 asks for ρ(A^N) < 1, which holds ({radius:.3f}), and for the observability of remark 1. What it"
            " does not give is an o2 that works: at zero state and input H = 0, and x and −x look alike, so the"
            " estimate stays what the prediction was. On the lively plant o2's path error over open loop's is"
            f" {o2[0].interval} on centre and {o2[-1].interval} at {results.remark_2.offsets[-1]:g}: an offset, or an"
            " input that takes the spot off centre, is what makes it work."
        ),
        _picture("remarks.png"),
    ]


def _map(results: Results) -> list[Block]:
    cells, m = results.cells, results.mechanism
    best, worst = min(cells, key=lambda c: c.path.value), max(cells, key=lambda c: c.path.value)
    cross = math.sqrt((2 / 5) / (2 / 3)) / 2
    return [
        Heading("The map o3/o1"),
        Text(
            "What y_2 is good for is mostly not the blur. Off centre, at θ_0, it is close to θ_0² + 2 θ_0 (θ − θ_0),"
            " averaged over the exposure: a second reading of the position, with noise √(2V/5)/(2 θ_0) that has nothing"
            f" to do with y_1's √(2V/3). It is even the better of the two beyond θ_0 = {cross:.2f}. Together they are"
            " worth a V of 1 + 4 θ_0² (2/3)/(2/5) times less. This can be checked: at"
            f" {m.offset:g} with V = {m.noise_density:g} o3's path error is"
            f" {m.o3} (o1: {m.o1}), and o1's on centre with V = {m.equivalent:.4g} is {m.o1_equivalent}. On centre the"
            " second reading vanishes and only the true blur is left, worth a few per cent where the motion is large"
            " against the noise."
        ),
        Text(
            "The path gains most, since it is the position over the exposure that both moments read. The start state's"
            " norm gains little and the end state's hardly at all, because both are ruled by x_2; the end state's x_2"
            " was made by the last milliseconds' noise, of which an average over 200 ms knows next to nothing. As long"
            " as the spot's motion is small against its offset, only V/W_f and the offset matter. At W_f = 10 and 0.5"
            " the spot comes near the edge of the field now and then, which spoils o1's and o3's moments alike and"
            " shows where V is least."
        ),
        Text(
            f"Least: {best.path.interval} at {_place(best)}; most: {worst.path.interval} at {_place(worst)}. All"
            " values, with their intervals, are in map.csv."
        ),
        _picture("map.png"),
        _map_table(cells),
    ]  # fmt: skip


def _place(cell: Cell) -> str:
    return f"offset {cell.offset:g}, V = {cell.noise_density:g}, W_f = {cell.process_noise:g}"


def _map_table(cells: Sequence[Cell]) -> Table:
    """The path's ratio at every offset; the other two at the largest."""
    offsets = sorted({c.offset for c in cells})
    places = sorted({(c.process_noise, c.noise_density) for c in cells}, key=lambda p: (p[0], -p[1]))
    by_place = {(c.process_noise, c.noise_density, c.offset): c for c in cells}
    last = offsets[-1]
    head = ["W_f", "V", *(f"path, {x:g}" for x in offsets), f"start, {last:g}", f"end, {last:g}"]
    rows = [
        [f"{W:g}", f"{V:g}", *(by_place[W, V, x].path.interval for x in offsets),
         by_place[W, V, last].start.interval, by_place[W, V, last].end.interval]
        for W, V in places
    ]  # fmt: skip
    return Table(head, rows)
