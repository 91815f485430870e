"""What a session looks like: Rerun files, their layout, and the viewer.

Each topic has a function that turns a batch of plain data into Rerun entities on a given stream; `save_rrd`
calls them with a whole recording, `LiveView` with one exposure after the other.
"""

from aolink.viewing.live import LiveView, live_viewer, serve, show
from aolink.viewing.save import Look, save_rrd
from aolink.viewing.viewer import check_display, open_viewer, screenshot, serve_web

__all__ = [
    "LiveView",
    "Look",
    "check_display",
    "live_viewer",
    "open_viewer",
    "save_rrd",
    "screenshot",
    "serve",
    "serve_web",
    "show",
]
