"""Models of disturbance and plant from recordings of blurred frames. Pure: exposures and text, no files."""

from aolink.identification.aliases import by_pixels
from aolink.identification.choose import CANDIDATES, Tried, chosen, tried
from aolink.identification.models import PARAMETERS, PLANTS, UNITS, IdentifiedPlant, Process, ProcessSum, kinds_of
from aolink.identification.readings import FEWEST, Readings, readings
from aolink.identification.rig_model import RigModel, rig_model
from aolink.identification.rig_text import identified_text
from aolink.identification.search import Maximum, Space, maxima, space_of
from aolink.identification.sets import Identified, Piece, identified

__all__ = [
    "CANDIDATES", "FEWEST", "PARAMETERS", "PLANTS", "UNITS", "Identified", "IdentifiedPlant", "Maximum", "Piece",
    "Process", "ProcessSum", "Readings", "RigModel", "Space", "Tried", "by_pixels", "chosen", "identified",
    "identified_text", "kinds_of", "maxima", "readings", "rig_model", "space_of", "tried",
]  # fmt: skip
