"""The phase structure function of von Karman's turbulence, as another library has it."""

import numpy as np

from aolink.optics.turbulence import Layer
from tests.needs import needed


def structure_function(layer: Layer, distance_m: np.ndarray) -> np.ndarray:
    """The mean square difference of phase at points some distance apart, rad^2."""
    hcipy = needed("hcipy")
    r = np.ravel(distance_m)
    points = hcipy.CartesianGrid(hcipy.UnstructuredCoords([r, np.zeros_like(r)]))
    found = hcipy.phase_structure_function_von_karman(layer.r0_m, layer.outer_scale_m)(points)
    return np.asarray(found).reshape(np.shape(distance_m))
