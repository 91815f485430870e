"""A report: one page of HTML about a recording, with everything in it."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from aolink.errors import ExportError
from aolink.estimation.score import score_table
from aolink.exporting.common import Progress, no_progress
from aolink.files import writing
from aolink.gathered import lacks
from aolink.plotting.devices import plot_latency, plot_losses
from aolink.plotting.exposure import draw_exposure, step_of
from aolink.plotting.overview import Overview, overview
from aolink.plotting.session import plot_errors, plot_nis
from aolink.plotting.style import new_figure, paper
from aolink.recording.account import STEPS, Commands
from aolink.recording.facts import Counted, recording_facts
from aolink.recording.reader import Recording
from aolink.recording.side_files import check_stands_alone
from aolink.units import duration, with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from aolink.exposure import Exposure

_DPI = 150
"""Resolution of the pictures in a figure, dots per inch."""
_SIZE_MM = (160.0, 66.0)
"""Width and height of a plot."""
_JUDGED = (
    "Error of the path against the truth, a running mean. NIS of each estimator; dashed: the bounds of 95 % of a"
    " consistent estimator's values."
)
_LOST = "What was lost, gated or skipped. When each step of the loop was done, and how long an estimate took (dashed)."
_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 75rem; margin: 0 auto;
  padding: 1rem; }
h1 { font-size: 1.5rem; margin: 0 0 .3rem; } h2 { font-size: 1.15rem; margin: 1.6rem 0 .4rem;
  border-bottom: 1px solid #ccc; } h3 { font-size: 1rem; margin: .6rem 0 .2rem; overflow-wrap: anywhere; }
.row { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(22rem, 100%), 1fr)); gap: 1rem; }
.row > * { min-width: 0; } .pairs { grid-template-columns: repeat(auto-fit, minmax(min(30rem, 100%), 1fr)); }
figure { margin: .4rem 0; break-inside: avoid; } img { width: 100%; height: auto; }
figcaption, .note { font-size: .875rem; color: #444; margin: .2rem 0; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: .875rem; }
th, td { text-align: left; padding: .15rem .55rem .15rem 0; vertical-align: top; border-bottom: 1px solid #eee; }
td.n, th.n { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
td.off { font-weight: 600; color: #a33000; } td { overflow-wrap: anywhere; }
pre { font-size: .75rem; white-space: pre-wrap; overflow-wrap: anywhere; }
@media print { body { font-size: 10pt; max-width: none; padding: 0; } h2 { break-after: avoid; }
  .row { grid-template-columns: repeat(auto-fit, minmax(8cm, 1fr)); } .scroll { overflow: visible; }
  th, td { padding-right: .3rem; font-size: 7pt; } tr { break-inside: avoid; } }
@page { margin: 15mm; }
"""


class Witness(Protocol):
    """What another instrument knows of a recording's motion (`aolink.jobs.witness`)."""

    @property
    def text(self) -> str: ...
    def seen(self, exposure: Exposure) -> Exposure: ...


def write_report(
    recording: Recording, path: str | Path, *, witness: Witness | None = None, overwrite: bool = False,
    progress: Progress = no_progress,
) -> Path:  # fmt: skip
    """Write a page of HTML about the content of a recording and the quality of its estimates.

    It has three figures: the most blurred exposure; errors with NIS; losses with latencies. Figures, style and all else
    are in the one file; it has no scripts and loads nothing. Where a recording lacks data, a sentence says so.

    Parameters
    ----------
    witness:
        Another instrument's account of the motion, which serves as the truth.
    overwrite:
        Whether a file of that name may be replaced.
    progress:
        Called with the number of exposures read.

    Raises
    ------
    RecordingError
        It is a side file.
    ExportError
        The file exists already or cannot be written, the frames are not those of the rig's sensor, or matplotlib is
        missing.
    """
    path, name, counted = Path(path), recording.path.name, Counted(recording)
    check_stands_alone(recording)
    with (
        paper(),
        writing(path, overwrite=overwrite, sources=recording.files, suffix=".html", error=ExportError) as partial,
    ):
        also = dict.fromkeys(recording.counts, counted.take)
        view = overview(recording, progress=progress, also=also, known=None if witness is None else witness.seen)
        found = score_table(view.scores)
        parts = [
            f"<h1>{escape(name)}</h1>", _note(f"A report by aolink {version('aolink')}."), "<h2>The session</h2>",
            facts_table(_facts(recording, recording_facts(recording, counted))),  # damage is known after all was read
            *map(_note, lacks(recording) if witness is None else [witness.text]), "<h2>The estimates</h2>",
            _table(["estimator", *found.heads], [[name, *cells] for name, cells in found.rows.items()]),
            *map(_note, found.notes), "<h2>Figures</h2>", '<div class="row pairs">',
            *_figures(recording, view, witness),
            f"</div><h2>Configuration</h2><pre>{escape(recording.rig.toml)}</pre>",
        ]  # fmt: skip
        partial.write_text(html_page(name, parts), encoding="utf-8")
    return path


def _facts(recording: Recording, facts: Mapping[str, Any]) -> dict[str, str]:
    session = facts["session"]
    return {
        "recorded": (facts["start_utc"] or "").replace("T", " ").replace("+00:00", " UTC"),
        "duration": duration(facts["duration_s"]),
        "size": with_unit(facts["bytes"], "B"),
        **recording.facts(),
        "gaps": f"{facts['gaps']['count']}, the longest {facts['gaps']['longest_steps']} fast steps",
        "steps": _counts({name: facts["commands"][name] for name in STEPS}) or "no counts of commanded steps",
        "answers": "; ".join(Commands.of(facts["commands"]).lines()),
        "losses": _counts(facts["losses"]) or "none counted",
        "damage": facts["damage"],
        **{key: str(session[key]) for key in ("note", "camera", "mirror", "seed") if session.get(key)},
    }


def _figures(recording: Recording, view: Overview, witness: Witness | None) -> list[str]:
    if not len(view):
        return [_note("It holds no exposure: there is nothing to draw.")]
    number, (width, height) = view.most_blurred, _SIZE_MM
    step = step_of(recording, number)
    step.exposure = step.exposure if witness is None else witness.seen(step.exposure)
    reasons = (f"; {name}: {e.status.name.lower()} ({e.reason})" for name, e in step.estimates.items() if e.reason)
    caption = f"Exposure {number} (frame {step.exposure.frame_id}), the most blurred{''.join(reasons)}"
    figure = new_figure(width, height * (1.45 if recording.rig.sensor.directions == 2 else 1.0))
    draw_exposure(recording.rig, step, figure)
    return [
        picture_in_page(figure, caption),
        _over_session(view, _JUDGED, [p for p, there in ((plot_errors, view.errors), (plot_nis, view.nis)) if there]),
        _over_session(view, _LOST, [plot_losses, *([plot_latency] if view.timings else [])]),
    ]


def _over_session(view: Overview, caption: str, plots: Sequence[Callable[[Overview, Axes], Axes]]) -> str:
    """A figure of plots below each other; nothing without plots."""
    if not plots:
        return ""
    figure = new_figure(_SIZE_MM[0], _SIZE_MM[1] * len(plots))
    for plot, axes in zip(plots, np.ravel(figure.subplots(len(plots), 1, sharex=True)), strict=True):
        plot(view, axes)
        axes.label_outer()
    return picture_in_page(figure, caption)


def html_page(title: str, parts: Sequence[str]) -> str:
    """A page of parts that are HTML, with everything in it."""
    body = "\n".join(parts)
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style>"
    )
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of texts and numbers; numbers stand out where they end with an exclamation mark."""

    def line(tag: str, cells: Sequence[str]) -> str:
        kinds = ["" if k == 0 else f' class="n{" off" * t.endswith("!")}"' for k, t in enumerate(cells)]
        return "".join(f"<{tag}{kind}>{escape(text)}</{tag}>" for kind, text in zip(kinds, cells, strict=True))

    body = "".join(f"<tr>{line('td', row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{line("th", heads)}</tr></thead><tbody>{body}</tbody></table></div>'


def facts_table(rows: Mapping[str, str]) -> str:
    """A table of names and texts."""
    body = "".join(f"<tr><th>{escape(key)}</th><td>{escape(text)}</td></tr>" for key, text in rows.items() if text)
    return f'<div class="scroll"><table><tbody>{body}</tbody></table></div>'


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in counts.items() if count)


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>' if text else ""


def picture_in_page(figure: Figure, caption: str) -> str:
    """A figure inside the page."""
    file = io.BytesIO()
    figure.savefig(file, format="svg", dpi=_DPI, metadata={"Date": None})
    data = base64.b64encode(file.getvalue()).decode()
    text = escape(caption)
    return f'<figure><img alt="{text}" src="data:image/svg+xml;base64,{data}"><figcaption>{text}</figcaption></figure>'
