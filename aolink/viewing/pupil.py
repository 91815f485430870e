"""Maps over the lenslets, exposure by exposure: light, mean slopes, blur, NIS."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from aolink.gathered import MAPS, maps_of
from aolink.series import Step
from aolink.viewing.entities import PUPIL
from aolink.viewing.series import Drawing
from aolink.viewing.timebase import Timebase

_COLOURS = {"viridis": "Viridis", "magma": "Magma", "RdBu_r": "Spectral"}
"""Rerun's colour maps that are nearest to those of `MAPS`."""
_SHARE = 98
"""Percentile of the values in the first exposures that is the end of the colours."""
_FIRST = 64
"""Exposures from which the range of the colours is found."""


def log_maps(drawing: Drawing, timebase: Timebase, steps: Sequence[Step]) -> None:
    """Maps by the names of `MAPS` with the numbers under the pointer, NaN where no light falls: ``/pupil/NAME``; of the
    paths by the estimator of the highest rank.

    The first exposures set the ends of the colours.
    """
    rig, scales, name = drawing.rig, drawing.scales, next(reversed(drawing.estimators), "")
    rows, columns = rig.sensor.grid
    layout = rr.components.ImageFormat(width=columns, height=rows, color_model="L", channel_datatype="F32")
    maps = [(each.exposure, maps_of(rig, each.exposure, each.estimates.get(name))) for each in steps]
    for what, (_, _, colours) in MAPS.items():
        if not (known := [(exposure, found[what].astype(np.float32)) for exposure, found in maps if what in found]):
            continue
        if what not in scales:
            values = np.abs(np.stack([picture for _, picture in known[:_FIRST]]))
            values = values[np.isfinite(values)]
            scales[what] = float(np.percentile(values, _SHARE)) if len(values) else 0.0
        reach = scales[what] or 1.0
        ends = (-reach if colours == "RdBu_r" else 0.0, reach)
        drawing.log(
            f"{PUPIL}/{what}",
            rr.DepthImage.from_fields(
                format=layout, colormap=rr.components.Colormap.auto(_COLOURS[colours]), depth_range=ends
            ),
        )
        times = timebase.at_starts([exposure for exposure, _ in known])
        buffers = np.stack([picture.ravel().view(np.uint8) for _, picture in known])
        drawing.send_columns(f"{PUPIL}/{what}", times, rr.DepthImage.columns(buffer=buffers))
