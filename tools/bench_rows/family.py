"""Rows about plants of the family: the goals over scenes drawn by seed."""

from __future__ import annotations

import tempfile
from pathlib import Path

from bench_rows.row import Effort, Row


def drawn_scenes(effort: Effort) -> list[Row]:
    """Each goal over the first reporting scenes: of `moments` over 200, of `profile` over 12 of these,
    beside `sampled` on 6."""
    from paper_report.judge import Plan, Size, judge_plan
    from paper_report.verdict import by_estimator, goals

    whole = effort.share == 1
    size = Size(pixel_runs=6) if whole else Size(runs=2, exposures=6, pixel_runs=1, limit_runs=1, particles=100)
    plan = Plan(scenes=effort.of(200), pixel_scenes=effort.of(12), limit_scenes=effort.of(6), size=size)
    with tempfile.TemporaryDirectory() as folder:
        found = goals(by_estimator(judge_plan(Path(folder) / "rows.jsonl", plan)))
    return [
        Row(f"family: {each.text}", each.measured, f"{each.scenes} scenes", float(each.held), 1.0) for each in found
    ]
