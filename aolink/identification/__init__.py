"""Models of disturbance and plant from recordings of blurred frames. Pure: exposures and text, no files.

To add a kind of process: its parameters in `models.PARAMETERS` (a name that ends with ``correlation_s`` is a real pole,
one with ``frequency_hz`` and its ``damping`` a pair), its starting points in `search._grid`, its name in
`choose.CANDIDATES` where cross-validation is to compare it, and a test that finds it in simulated exposures. The page
is `aolink/pages/identify.md`.
"""

from aolink.identification.choose import CANDIDATES, Tried, chosen, tried
from aolink.identification.models import PARAMETERS, PLANTS, UNITS, IdentifiedPlant, Process, ProcessSum, kinds_of
from aolink.identification.readings import FEWEST, Readings, readings
from aolink.identification.rig_text import identified_text
from aolink.identification.search import Maximum, Space, maxima, space_of
from aolink.identification.sets import Identified, Piece, identified

__all__ = [
    "CANDIDATES", "FEWEST", "PARAMETERS", "PLANTS", "UNITS", "Identified", "IdentifiedPlant", "Maximum",
    "Piece", "Process", "ProcessSum", "Readings", "Space", "Tried",
    "chosen", "identified", "identified_text", "kinds_of", "maxima", "readings",
    "space_of", "tried",
]  # fmt: skip
