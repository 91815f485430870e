"""Figures of recordings with matplotlib, on given axes or figures or new ones; and a report of them.

`overview` reads a series once; figures of the whole session are drawn from it, figures of one exposure from the series.
`save_figure` writes one in a paper's size, `write_report` puts them on one page.
"""

from typing import TYPE_CHECKING

from aolink.plotting.overview import Overview, overview  # at once: it has the name of its module

if TYPE_CHECKING:
    from aolink.plotting.devices import incidents, plot_latency, plot_losses
    from aolink.plotting.exposure import plot_exposure
    from aolink.plotting.files import FIGURES, save_figure
    from aolink.plotting.picture import draw_session
    from aolink.plotting.pupil import plot_pupil
    from aolink.plotting.report import write_report
    from aolink.plotting.scene import plot_scene
    from aolink.plotting.session import plot_blur, plot_errors, plot_nis
    from aolink.plotting.style import new_figure, paper
else:  # the type checker would accept any name
    from aolink.names import at_first_use

    __getattr__ = at_first_use(
        __name__,
        {
            "devices": "incidents plot_latency plot_losses",
            "exposure": "plot_exposure",
            "files": "FIGURES save_figure",
            "picture": "draw_session",
            "pupil": "plot_pupil",
            "report": "write_report",
            "scene": "plot_scene",
            "session": "plot_blur plot_errors plot_nis",
            "style": "new_figure paper",
        },
    )

__all__ = [
    "FIGURES", "Overview", "draw_session", "incidents", "new_figure", "overview", "paper", "plot_blur",
    "plot_errors", "plot_exposure", "plot_latency", "plot_losses", "plot_nis", "plot_pupil", "plot_scene",
    "save_figure", "write_report",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
