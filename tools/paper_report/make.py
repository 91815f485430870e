"""The making of a folder with the figures, the page and the map's table."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import matplotlib as mpl

from aolink.rig import load_rig
from paper_report import figures, shahin
from paper_report import numbers as n
from paper_report.blocks import write_page
from paper_report.ensemble import Cell, map_cells
from paper_report.judge import RECORDED, judge_plan, read_rows
from paper_report.limit import against_o1, limit_table
from paper_report.loop import loop_cells
from paper_report.made_films import made_films
from paper_report.page import Results, build
from paper_report.shake import shake_table
from paper_report.spheres import film


@contextmanager
def _timed(what: str) -> Iterator[None]:
    start = time.monotonic()
    print(f"{what} ...", end=" ", file=sys.stderr, flush=True)
    yield
    print(f"{time.monotonic() - start:.1f} s", file=sys.stderr)


def make(out: Path, effort: n.Effort) -> list[Path]:
    """Make everything in ``out``; the pages' paths."""
    mpl.use("Agg")
    out.mkdir(parents=True, exist_ok=True)
    results = compute(effort, out)
    with _timed("figures"):
        draw(out, results)
    write_map(out / "map.csv", results.cells)
    page = write_page(build(results), out / "paper.md")
    with _timed("Shahin"):
        restored = shahin.make(out, effort is n.QUICK)
    return [page, restored]


def compute(effort: n.Effort, out: Path) -> Results:
    """All runs; the rows of the family of plants are kept in the folder, and are not made again."""
    printed, lively = load_rig("section-vi"), load_rig("section-vi-lively")
    with _timed("printed numbers"):
        rows = [*n.plant_rows(printed, effort), *n.noise_rows(printed, effort.noise_frames), *n.kernel_rows(printed)]
    with _timed("steady levels"):
        norms = n.norm_readings(printed, lively, effort)
    with _timed("errors"):
        errors = n.error_table(printed, effort)
    with _timed("misprints"):
        forms = {rig.name: n.form_table(rig, effort) for rig in (printed, lively)}
    with _timed("remarks"):
        first, second = n.remark_1(printed, effort.frequencies), n.remark_2(lively, effort)
    with _timed("shake"):
        shake = shake_table(printed, effort)
    with _timed("limit"):
        limit, over_o1 = limit_table(effort), against_o1(effort)
    with _timed("spheres"):
        spheres = film(effort)
    with _timed("made films"):
        made = made_films(effort)
    with _timed("closed loops"):
        loops = loop_cells(effort is n.QUICK)
    with _timed("family"):
        plan = effort.family
        family = read_rows(RECORDED) if plan is None else judge_plan(out / "family.jsonl", plan)
    with _timed("map"):
        mechanism = n.mechanism(lively, effort)
        cells = map_cells(
            printed, effort.offsets, effort.densities, effort.process_noises,
            runs=effort.map_runs, exposures=effort.exposures, skip=effort.skip,
        )  # fmt: skip
    return Results(
        printed=printed, lively=lively, effort=effort, rows=rows, norms=norms, errors=errors, forms=forms,
        remark_1=first, remark_2=second, mechanism=mechanism, shake=shake, limit=limit, over_o1=over_o1, film=spheres,
        made=made, family=family, loops=loops, cells=cells,
    )  # fmt: skip


def draw(out: Path, results: Results) -> None:
    """All figures."""
    scenes, dpi = figures.scenes(results.printed, results.lively), results.effort.dpi
    levels = [results.norms[0].rms, results.norms[-1].rms]
    figures.figure_4(out / "figure-4.png", scenes, dpi)
    figures.figure_5(out / "figure-5.png", scenes, results.effort, levels)
    figures.figure_6(out / "figure-6.png", scenes, dpi)
    figures.figure_7(out / "figure-7.png", scenes, dpi)
    figures.figure_remarks(out / "remarks.png", results.remark_1, results.remark_2, dpi)
    figures.figure_map(out / "map.png", results.cells, dpi)
    figures.figure_limit(out / "limit.png", results.limit, dpi)
    figures.figure_family(out / "family.png", results.family, dpi)


def write_map(path: Path, cells: Sequence[Cell]) -> None:
    """All points of the map."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        ratios = [f"{key}{end}" for key in ("path", "start", "end") for end in ("", "_low", "_high")]
        names = list(cells[0].rmse)
        writer.writerow(["offset", "V", "W_f", *ratios, *(f"path_rmse_{name}" for name in names)])
        for cell in cells:
            values = [getattr(r, end) for r in (cell.path, cell.start, cell.end) for end in ("value", "low", "high")]
            values += [cell.rmse[name].value for name in names]
            place = (cell.offset, cell.noise_density, cell.process_noise)
            writer.writerow([*(f"{x:g}" for x in place), *(f"{x:.5g}" for x in values)])
