"""The choice between the aliases of a frequency by all pixels.

The likelihood of `likelihood` has two sums of each exposure, and its maxima at the aliases of a vibration can be nearly
as high as that at its frequency. The shape of the blur tells more: where a spot turns, and how often. So the filter of
`profile` goes through the exposures once for each maximum, and the sum of its log-evidences, which is the
log-likelihood of the pixels except for Laplace's approximation (`aolink.estimation.pixels.modes`), decides. A maximum
that is far behind is left out at once, so that most of them take few exposures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from aolink.errors import EstimatorError
from aolink.estimation import Estimator, make_estimator
from aolink.exposure import Exposure
from aolink.identification.search import Maximum
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig

_ESTIMATOR = "profile:tempered=0"
"""Without tempered points: they cost ten times as much, and the evidence is not from them."""
_RULED_OUT = 30.0
"""Nats by which a maximum is behind where it is left out: the evidence is approximate."""
_MOST = 10.0
"""The most nats by which one exposure counts against a maximum: no single frame may decide."""
_SETTLED = 4
"""Exposures at the beginning that do not count: every filter first has to find its state."""
_ENOUGH = 256
"""Exposures after which maxima that are still alike are left as they are."""


def by_pixels(
    found: Sequence[Maximum], rig_of: Callable[[Maximum], Rig], exposures: Sequence[Exposure]
) -> list[Maximum]:  # fmt: skip
    """The maxima that the pixels do not rule out, the one with the highest evidence first.

    Where `profile` cannot work on the rig, or there is one maximum only, they are all returned in their order.

    Parameters
    ----------
    found:
        Local maxima of the likelihood of a recording's readings.
    rig_of:
        A function that gives the rig with the model of a maximum.
    exposures:
        The exposures of the recording, with pixels.
    """
    if len(found) < 2:
        return list(found)
    try:
        running = {k: make_estimator(rig_of(each), _ESTIMATOR) for k, each in enumerate(found)}
    except EstimatorError:
        return list(found)
    total = np.zeros(len(found))
    for number, exposure in enumerate(exposures[:_ENOUGH]):
        each = np.array([_log_evidence(estimator, exposure) for estimator in running.values()])
        if number < _SETTLED or not np.isfinite(each).any():
            continue
        at = list(running)
        total[at] += np.maximum(np.nan_to_num(each, nan=-np.inf) - np.nanmax(each), -_MOST)
        behind = [k for k in at if total[k] < total[at].max() - _RULED_OUT]
        for k in behind:
            del running[k]
        if len(running) == 1:
            break
    return [found[k] for k in sorted(running, key=lambda k: -total[k])]


def _log_evidence(estimator: Estimator, exposure: Exposure) -> float:
    """Log-evidence of a frame, nats, the sum over axes; NaN where it shows none."""
    estimator.step(exposure)
    assert estimator.posterior is not None
    evidence: FloatArray | None = estimator.posterior.log_evidence
    return float("nan") if evidence is None else float(evidence.sum())
