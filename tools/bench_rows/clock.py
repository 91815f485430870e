"""Rows about the stated uncertainty of frames' host times, on a serial line and a clock that are bad in every way at
once."""

from __future__ import annotations

import numpy as np
from scipy import stats

from aolink.devices import clock as clocks
from aolink.devices.clock import QUERY_PERIOD_S, SUSPICION_PERIOD_S, WARM_UP_QUERIES, ClockExchange, ClockRegression
from bench_rows.row import Effort, Row

_SEEDS = 100
_SESSION_S = 60.0
_DRIFT = 200e-6
_WALK = 1e-6 / 60**0.5
"""Random walk of the frequency, 1/sqrt(s)."""
_JITTER_NS = 2e6
"""Mean of the exponential time that a packet takes beyond the shortest, each way."""
_ROUND_TRIP_NS = 4e6
"""The shortest round trip; the share of it in the first direction is drawn by seed, from none to all."""
_STEP_NS = 50_000_000
_READOUT_S = 0.05
_START_NS = 1_800_000_000_000_000_000


def _session(seed: int, duration_s: float, *, stamps_show_it: bool) -> tuple[np.ndarray, int, int]:
    """Error over sigma of the host time of each frame, 10 a second; and how many of the frames off by the step are
    flagged and not flagged.

    Where no stamp shows the step (a device that counts its fast steps from its clock), those frames are flagged that
    began after the last query which agreed with the old clock, once the step is found.
    """
    rng = np.random.default_rng(seed)
    there_ns = _ROUND_TRIP_NS * rng.uniform()
    step_at_s = duration_s * rng.uniform(0.3, 0.7)
    step_ns = _STEP_NS * int(rng.choice([-1, 1]))
    grid_s = np.arange(0.0, duration_s + 2.0, 0.1)
    drift = _DRIFT * rng.choice([-1, 1]) + np.cumsum(_WALK * 0.1**0.5 * rng.standard_normal(grid_s.size))
    phase_ns = np.r_[0.0, np.cumsum(drift)[:-1]] * 1e8

    def device_ns(second: float, *, stepped: bool = True) -> int:
        set_ns = step_ns if stepped and second >= step_at_s else 0
        return round(second * 1e9 + float(np.interp(second, grid_s, phase_ns))) + set_ns

    def exchange(second: float) -> ClockExchange:
        there_s = (there_ns + rng.exponential(_JITTER_NS)) * 1e-9
        back_s = (_ROUND_TRIP_NS - there_ns + rng.exponential(_JITTER_NS)) * 1e-9
        left_s = second + there_s + 5e-6
        return ClockExchange(
            _START_NS + round(second * 1e9), device_ns(second + there_s), device_ns(left_s),
            _START_NS + round((left_s + back_s) * 1e9),
        )  # fmt: skip

    clock, frames = ClockRegression(), list[tuple[int, int, float]]()
    for k in range(WARM_UP_QUERIES):
        clock.add(exchange(0.05 * k))
    steps, due_s = clocks.StepClock(clock, device_ns(0.0), 1_000_000), 0.5
    for second in np.arange(0.5, duration_s, 0.1).tolist():
        while due_s <= second:
            clock.add(exchange(due_s))
            due_s += SUSPICION_PERIOD_S if clock.suspected else QUERY_PERIOD_S
        began_s = second - _READOUT_S
        stamp, true_ns = device_ns(began_s), _START_NS + round(began_s * 1e9)
        counted_ns = device_ns(began_s, stepped=not stamps_show_it) - device_ns(0.0)
        found_ns, sigma_ns = steps.host_ns(stamp, counted_ns, _START_NS + round(second * 1e9))
        if clock.suspected:
            due_s = min(due_s, second + SUSPICION_PERIOD_S)
        frames.append((true_ns, found_ns - true_ns, sigma_ns))
    true, error, sigma = (np.array(each, dtype=float) for each in zip(*frames, strict=True))
    wrong = np.abs(error) > 5 * sigma
    flagged = np.zeros_like(wrong)
    if clock.step is not None:
        flagged = (true >= clock.step.after_ns) & (true <= clock.step.before_ns)
    return error / sigma, int((wrong & flagged).sum()), int((wrong & ~flagged).sum())


def host_times(effort: Effort) -> list[Row]:
    """Drift of 200 ppm and its walk, jitter of 2 ms each way, delay asymmetric by up to 4 ms, a step of 50 ms.

    The share of the first direction in the round trip is the same in a whole session, so a session counts as one sample
    of the NEES.
    """
    seeds, duration_s = effort.of(_SEEDS, 3), float(effort.of(round(_SESSION_S), 8))
    sessions = [_session(seed, duration_s, stamps_show_it=True)[0] for seed in range(1, seeds + 1)]
    nees = float(np.mean([np.mean(each**2) for each in sessions]))
    low, high = (float(stats.chi2.ppf(share, seeds)) / seeds for share in (0.025, 0.975))
    ratios = np.abs(np.concatenate(sessions))
    covered = [float((ratios < stats.norm.ppf(0.5 + level / 2)).mean()) for level in (0.68, 0.95)]
    hidden = [_session(seed, duration_s, stamps_show_it=False)[1:] for seed in range(1001, 1001 + seeds)]
    flagged, unflagged = (sum(each) for each in zip(*hidden, strict=True))
    what = f"{seeds} sessions of {duration_s:.0f} s: 200 ppm, jitter 2 ms, asymmetry to 4 ms, a step of 50 ms"
    return [
        Row(
            f"NEES of frames' host times, {what}", f"{nees:.2f}", f"{low:.2f} to {high:.2f}",
            min(high / nees, nees / low), 1.0,
        ),
        Row(
            f"coverage of their 68 and 95 % intervals; worst error {ratios.max():.1f} sigma",
            f"{100 * covered[0]:.1f}, {100 * covered[1]:.1f} %", "68, 95 %", covered[1] / 0.95, 1.0,
        ),
        Row(
            "frames off by a step that no stamp shows: outside the period that the session warns of",
            f"{unflagged} of {flagged + unflagged}", "limit 0", float(not unflagged), 1.0,
        ),
    ]  # fmt: skip
