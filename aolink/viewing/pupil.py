"""Maps over the lenslets, exposure by exposure: light, mean slopes, blur, NIS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.estimation.estimate import Estimate
from aolink.exposure import Exposure
from aolink.plotting.pupil import MAPS, spot_values
from aolink.rig import Rig
from aolink.viewing.entities import PUPIL
from aolink.viewing.series import Drawing
from aolink.viewing.timebase import Timebase

_COLOURS = {"viridis": "Viridis", "magma": "Magma", "RdBu_r": "Spectral"}
"""Rerun's colour maps that are nearest to those of `MAPS`."""
_SHARE = 98
"""Percentile of the values in the first exposures that is the end of the colours."""
_FIRST = 64
"""Exposures from which the range of the colours is found."""


def log_maps(
    drawing: Drawing, timebase: Timebase, rig: Rig, exposures: Sequence[Exposure],
    estimates: Mapping[int, Estimate], scales: dict[str, float],
) -> None:  # fmt: skip
    """Maps by the names of `MAPS` with the numbers under the pointer, NaN where no light falls: ``/pupil/NAME``.

    Parameters
    ----------
    estimates:
        By frame id.
    scales:
        Value at the end of the colours, by the map's name; a map that is not in it yet gets its value from these
        exposures.
    """
    sensor, (rows, columns) = rig.sensor, rig.sensor.grid
    seen: dict[str, list[tuple[Exposure, NDArray[np.float32]]]] = {}
    for exposure in exposures:
        for name, values in spot_values(rig, exposure, estimates.get(exposure.frame_id)).items():
            picture = np.full(rows * columns, np.nan, dtype=np.float32)
            picture[sensor.lit] = values
            seen.setdefault(name, []).append((exposure, picture))
    layout = rr.components.ImageFormat(width=columns, height=rows, color_model="L", channel_datatype="F32")
    for name, pictures in seen.items():
        signed = MAPS[name][2] == "RdBu_r"
        if name not in scales:
            values = np.abs(np.stack([picture for _, picture in pictures[:_FIRST]]))
            known = values[np.isfinite(values)]
            scales[name] = float(np.percentile(known, _SHARE)) if len(known) else 0.0
        reach = scales[name] or 1.0
        colours = rr.components.Colormap.auto(_COLOURS[MAPS[name][2]])
        look = rr.DepthImage.from_fields(
            format=layout, colormap=colours, depth_range=(-reach if signed else 0.0, reach)
        )
        drawing.log(f"{PUPIL}/{name}", look)
        times = timebase.at_steps([e.first_step for e, _ in pictures], [e.frame_id for e, _ in pictures])
        buffers = np.stack([picture.view(np.uint8) for _, picture in pictures])
        drawing.send_columns(f"{PUPIL}/{name}", times, rr.DepthImage.columns(buffer=buffers))
