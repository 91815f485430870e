"""A report: one page of HTML with everything in it, of one recording, of two side by side, or of many."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aolink.errors import AolinkError, ExportError
from aolink.estimation.score import score_table
from aolink.files import writing
from aolink.gathered import has_pupil, lacks
from aolink.plotting.devices import incidents, plot_latency, plot_losses
from aolink.plotting.exposure import draw_exposure, step_of
from aolink.plotting.overview import Overview, overview
from aolink.plotting.pupil import plot_pupil
from aolink.plotting.scene import plot_scene
from aolink.plotting.session import plot_blur, plot_errors, plot_nis
from aolink.plotting.style import TimeUnit, new_figure, paper
from aolink.recording import topics
from aolink.recording.answers import Answers
from aolink.recording.facts import Counted, recording_facts
from aolink.recording.reader import Recording
from aolink.series import Step
from aolink.units import duration, with_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SIDE_BY_SIDE = 3
"""Up to this many recordings stand beside each other with all their figures; for more there is a table, and one figure
of each."""
_DPI = 150
"""Resolution of the pictures in a figure, dots per inch."""
_WIDE, _NARROW = (160.0, 66.0), (110.0, 66.0)
"""Width and height of figures, mm."""
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


def write_report(
    recordings: Sequence[Recording], path: str | Path, *, unit: TimeUnit = "s", overwrite: bool = False,
    progress: Callable[[str, int], None] | None = None,
) -> Path:  # fmt: skip
    """Write a page of HTML about the content of recordings and the quality of their estimates.

    Figures, style and all else are in the one file; it has no scripts and loads nothing. Where a recording lacks data,
    or cannot be read, a sentence says so. Up to three recordings stand side by side with all their figures; for more
    there is a table, and for each one figure of the session.

    Parameters
    ----------
    unit:
        The unit of time axes.
    overwrite:
        Whether a file of that name may be replaced.
    progress:
        Called with the name of the recording that is read, and the number of its exposures read so far.

    Raises
    ------
    ExportError
        There is no recording, the file exists already or cannot be written, or matplotlib is missing.
    """
    path = Path(path)
    if not recordings:
        raise ExportError("a report needs a recording")
    sources = [each for recording in recordings for each in recording.files]
    with paper(), writing(path, overwrite=overwrite, sources=sources, suffix=path.suffix, error=ExportError) as partial:
        sessions = [_Session(each, unit, progress or (lambda name, done: None)) for each in recordings]
        partial.write_text(_page(sessions), encoding="utf-8")
    return path


class _Session:
    """One recording, as parts of a page."""

    def __init__(self, recording: Recording, unit: TimeUnit, progress: Callable[[str, int], None]) -> None:
        self.recording, self.unit = recording, unit
        self.name = recording.path.name
        self.view: Overview | None = None
        self.problem, counted = "", Counted(recording)
        try:
            also = dict.fromkeys(recording.counts, counted.see)
            self.view = overview(recording, progress=lambda done: progress(self.name, done), also=also)
        except (AolinkError, ValueError, ArithmeticError) as error:
            self.problem = str(error)
        # Damage is known after all of it was read.
        self.facts = recording_facts(recording, None if self.view is None else counted)

    def drawn(self, size: tuple[float, float], caption: str, draw: Callable[[Overview, Figure], object]) -> str:
        """A figure with its caption; where it cannot be drawn, the reason."""
        if self.view is None:
            return _note(self.problem)
        try:
            figure = new_figure(*size)
            draw(self.view, figure)
            return picture_in_page(figure, caption)
        except AolinkError as error:
            return _note(str(error))

    def what_it_was(self) -> str:
        """The session's facts."""
        facts = self.facts
        rows = {
            "recorded": (facts["start_utc"] or "").replace("T", " ").replace("+00:00", " UTC"),
            "duration": duration(facts["duration_s"]),
            "size": with_unit(facts["bytes"], "B"),
            **self.recording.facts(),
            "gaps": f"{facts['gaps']['count']}, the longest {facts['gaps']['longest_steps']} fast steps",
            "steps": _counts(facts["commands"]) or "no counts of commanded steps",
            "answers": "; ".join(Answers.of(facts["answers"]).lines()),
            "losses": _counts(facts["losses"]) or "none counted",
            "damage": facts["damage"],
        }
        session = facts["session"]
        rows |= {key: str(session[key]) for key in ("note", "camera", "mirror", "seed") if session.get(key)}
        return facts_table(rows)

    def lacks(self) -> list[str]:
        """Sentences about the data that the recording lacks."""
        empty = self.view is not None and not len(self.view)
        return (["It holds no exposure: there is nothing to draw."] if empty else []) + lacks(self.recording)

    def scores(self) -> str:
        """The table of scores, which `aolink estimate` prints too."""
        if self.view is None or not self.view.scores:
            return _note(self.problem or "No estimates.")
        found = score_table(self.view.scores)
        rows = [[name, *cells] for name, cells in found.rows.items()]
        return _table(["estimator", *found.heads], rows) + "".join(map(_note, found.notes))

    def exposures(self) -> str:
        """The most telling exposures."""
        if self.view is None:
            return _note(self.problem)
        parts = []
        for number, why in self.view.telling().items():
            step = step_of(self.recording, number)
            status = "; ".join(
                f"{name}: {each.status.name.lower()} ({each.reason})"
                for name, each in step.estimates.items() if each.reason
            )  # fmt: skip
            caption = f"Exposure {number} (frame {step.exposure.frame_id}): {why}. {status}"
            size = (_WIDE[0], _WIDE[1] * (1.45 if self.recording.rig.sensor.directions == 2 else 1.0))
            parts.append(self.drawn(size, caption, partial(self._draw_exposure, step)))
        return "".join(parts) or _note("No exposure.")

    def _draw_exposure(self, step: Step, _: Overview, figure: Figure) -> None:
        draw_exposure(self.recording.rig, step, figure, unit=self.unit)

    def scene(self) -> str:
        """The picture of the first exposure that was restored; without one, of the one that is blurred most."""
        number = next(iter(self.view.telling()), 0) if self.view is not None else 0
        frames = self.view.frame_ids.tolist() if self.view is not None else []
        for each in self.recording.restored():
            if (each.scene is not None or each.spots is not None) and each.frame_id in frames:
                number = frames.index(each.frame_id)
                break
        caption = f"The picture of exposure {number}."
        return self.drawn(_WIDE, caption, lambda _, figure: plot_scene(self.recording, number, figure))

    def over_session(self, title: str) -> str:
        """One of the figures `_OVER_SESSION`."""
        if title == "Losses" and self.view is not None and not incidents(self.view):
            return _note("No frame was lost or incomplete, no exposure was gated or skipped.")
        caption, plot = _OVER_SESSION[title]
        return self.drawn(_NARROW, caption, lambda view, figure: plot(view, figure.subplots(), unit=self.unit))

    def pupil(self) -> str:
        """Maps over the lenslets."""
        return self.drawn(
            (_WIDE[0], 95.0), "Over the pupil, as means over exposures spread over the session.",
            lambda _, figure: plot_pupil(self.recording, figure),
        )  # fmt: skip


_OVER_SESSION: dict[str, tuple[str, Callable[..., Any]]] = {
    "Blur and paths": ("The camera's blur, and the positions of the spot.", plot_blur),
    "Consistency": ("NIS of each estimator; dashed: the bounds of 95 % of a consistent estimator's values.", plot_nis),
    "Errors": ("Error of the path against the truth, a running mean.", plot_errors),
    "Losses": ("What was lost, gated or skipped, and when.", plot_losses),
    "Latencies": ("When each step of the loop was done, and how long an estimate took (dashed).", plot_latency),
}
"""Captions of the figures over the session and the functions that draw them, by their titles."""


def _page(sessions: Sequence[_Session]) -> str:
    many = len(sessions) > _SIDE_BY_SIDE
    title = ", ".join(each.name for each in sessions[:_SIDE_BY_SIDE])
    title += f" and {len(sessions) - 3} more" if many else ""
    parts = [f"<h1>{escape(title)}</h1>", _note(f"A report by aolink {version('aolink')}.")]
    if len(sessions) > 1:
        parts += ["<h2>Beside each other</h2>", _comparison(sessions)]
    if many:
        parts.append("<h2>Each of them</h2>")
        for each in sessions:
            figures = _row([each.over_session("Blur and paths"), each.scores()])
            parts += [f"<h3>{escape(each.name)}</h3>", *map(_note, each.lacks()), figures]
    else:
        parts.extend(_sections(sessions))
    return html_page(title, parts)


def html_page(title: str, parts: Sequence[str]) -> str:
    """A page of parts that are HTML, with everything in it."""
    body = "\n".join(parts)
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style>"
    )
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def _sections(sessions: Sequence[_Session]) -> Iterable[str]:
    """All sections of a few sessions, each section side by side."""
    one = len(sessions) == 1

    def beside(title: str, give: Callable[[_Session], str]) -> str:
        return f"<h2>{title}</h2>" + _row(
            [("" if one else f"<h3>{escape(each.name)}</h3>") + give(each) for each in sessions]
        )

    yield beside("The session", lambda each: each.what_it_was() + "".join(map(_note, each.lacks())))
    yield beside("The estimates", _Session.scores)
    yield beside("Inside the most telling exposures", _Session.exposures)
    if one:
        figures = [sessions[0].over_session(title) for title in _OVER_SESSION]
        yield "<h2>Over the session</h2>" + _row(figures, "row pairs")
    else:
        for title in _OVER_SESSION:
            yield beside(title, partial(_Session.over_session, title=title))
    if any(has_pupil(each.recording.rig) for each in sessions):
        yield beside("Over the pupil", _Session.pupil)
    if any(each.recording.rig.scene is not None or topics.RESTORATION in each.recording.counts for each in sessions):
        yield beside("Before and after", _Session.scene)
    yield beside("Configuration", lambda each: f"<pre>{escape(each.recording.rig.toml)}</pre>")


def _comparison(sessions: Sequence[_Session]) -> str:
    """A row for each recording and estimator."""
    wanted = ("RMSE path", "RMSE end", "NIS", "NEES end", "gated")
    rows = []
    for each in sessions:
        found = score_table(each.view.scores if each.view is not None else {}, wanted)
        for name, cells in (found.rows or {"none": []}).items():
            of = dict(zip(found.heads, cells, strict=bool(cells)))
            begin = [each.name, each.recording.rig.name, str(len(each.recording)), name]
            rows.append([*begin, *(of.get(head, "") for head in wanted)])
    return _table(("recording", "rig", "exposures", "estimator", *wanted), rows, text_columns=(0, 1, 3))


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], *, text_columns: Sequence[int] = (0,)) -> str:
    """A table; cells outside of the columns of texts are numbers, which stand out where they end with an exclamation
    mark."""

    def line(tag: str, cells: Sequence[str]) -> str:
        kinds = ["" if k in text_columns else f' class="n{" off" * t.endswith("!")}"' for k, t in enumerate(cells)]
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


def _row(parts: Sequence[str], kind: str = "row") -> str:
    return f'<div class="{kind}">{"".join(f"<div>{part}</div>" for part in parts)}</div>'


def picture_in_page(figure: Figure, caption: str) -> str:
    """A figure inside the page."""
    file = io.BytesIO()
    figure.savefig(file, format="svg", dpi=_DPI, metadata={"Date": None})
    data = base64.b64encode(file.getvalue()).decode()
    text = escape(caption)
    return f'<figure><img alt="{text}" src="data:image/svg+xml;base64,{data}"><figcaption>{text}</figcaption></figure>'
