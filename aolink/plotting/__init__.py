"""Figures of recordings with matplotlib, on given axes or figures or new ones; and a report of them.

`overview` reads a series once; figures of the whole session are drawn from it, figures of one exposure from the series.
`save_figure` writes one of the latter in a paper's size, `write_report` puts figures on one page.
"""

from aolink.plotting.devices import plot_latency, plot_losses
from aolink.plotting.exposure import plot_exposure
from aolink.plotting.files import FIGURES, save_figure
from aolink.plotting.overview import Overview, overview
from aolink.plotting.picture import draw_session
from aolink.plotting.pupil import plot_pupil
from aolink.plotting.report import write_report
from aolink.plotting.scene import plot_scene
from aolink.plotting.session import plot_blur, plot_errors, plot_nis
from aolink.plotting.style import new_figure, paper

__all__ = [
    "FIGURES", "Overview", "draw_session", "new_figure", "overview", "paper", "plot_blur",
    "plot_errors", "plot_exposure", "plot_latency", "plot_losses", "plot_nis", "plot_pupil", "plot_scene",
    "save_figure", "write_report",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
