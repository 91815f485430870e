"""Views of a session: Rerun files, their layout, and the viewer.

One `sender.Sender` draws exposures and messages, part by part: of a recording (`save`), and of a session while it goes
on (`live`, in a process of its own). A quantity's curves are named in its row of `aolink.recording.topics`.

To add another view: a name in `entities`, a function that sends it, its call (the topic's ``shown_by``, or
`Sender.send`), and its place in `blueprint` with the unit in its name. What matplotlib draws too is computed in
`aolink.gathered`. No estimator, SciPy or pandas is loaded until the first picture.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aolink.viewing.feed import serve, show
    from aolink.viewing.live import LiveView, live_viewer
    from aolink.viewing.look import Look
    from aolink.viewing.process import check_display, open_viewer, serve_web
    from aolink.viewing.save import save_rrd
else:  # the type checker would accept any name
    from aolink.names import at_first_use

    __getattr__ = at_first_use(
        __name__,
        {
            "feed": "serve show",
            "live": "LiveView live_viewer",
            "look": "Look",
            "process": "check_display open_viewer serve_web",
            "save": "save_rrd",
        },
    )

__all__ = [
    "LiveView", "Look", "check_display", "live_viewer", "open_viewer", "save_rrd", "serve", "serve_web",
    "show",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
