"""Vibrations by all pixels: which alias, how long it lasts, its frequency."""

import math

import numpy as np
import pytest

import aolink
from aolink.errors import EstimatorError
from aolink.identification import (
    Candidate,
    Maximum,
    Process,
    ProcessSum,
    by_pixels,
    candidates,
    identified_text,
    readings,
    refined,
    scanned,
    space_of,
)
from aolink.rig import load_rig, parse_rig

KINDS = ("ornstein-uhlenbeck", "resonance")
EXPOSURE_S = 0.05


def parameters(cycles, damping=0.002):
    """A drift, and a vibration of so many cycles in an exposure."""
    return np.log([0.5, 2 * 0.08**2 / 0.5, cycles / EXPOSURE_S, damping, 0.08])


def shaken(x):
    """The rig `loop` with these parameters."""
    rig = load_rig("loop")
    drift, line = np.exp(x[:2]).tolist(), np.exp(x[2:]).tolist()
    model = ProcessSum((Process(KINDS[0], tuple(drift)), Process(KINDS[1], tuple(line))))
    return parse_rig(identified_text(rig.toml, rig, [model]))


def frames(cycles, count):
    return list(aolink.simulate(shaken(parameters(cycles)), count, seed=3))


def space(exposures):
    rig = load_rig("loop")
    seen = [readings(rig, exposures)]
    return space_of(KINDS, seen), seen


def candidate(cycles, log_likelihood, damping=0.002):
    at = Maximum(parameters(cycles, damping), log_likelihood, 12)
    return Candidate(at.x, at)


def cycles_of(found):
    return [pytest.approx(math.exp(each.x[2]) * EXPOSURE_S) for each in found]


@pytest.mark.slow
@pytest.mark.parametrize("cycles", [1.51, 2.4])
def test_the_pixels_decide_whatever_the_likelihood_of_centroid_and_width_says(cycles):
    """One of the two aliases is a cycle below, and one as far from a whole or half number of cycles, on the other
    side."""
    whole = round(2 * cycles)
    found = [candidate(whole - cycles, 0.0), candidate(cycles - 1, -1.0), candidate(cycles, -9.0)]
    left = cycles_of(by_pixels(found, shaken, frames(cycles, 48)))
    assert left[0] == cycles
    assert cycles - 1 not in left


def test_without_evidence_the_order_stays():
    def refused(x):
        raise EstimatorError("profile takes at most 24 states")

    found = [candidate(2.6, 0.0), candidate(2.4, -1.0)]
    assert by_pixels(found, shaken, []) == found
    assert by_pixels(found, refused, []) == found
    assert by_pixels(found[:1], refused, []) == found[:1]
    of, _ = space(frames(2.4, 32))
    np.testing.assert_array_equal(refined(of, found[0].x, refused, []), found[0].x)


@pytest.mark.rare
def test_a_scan_finds_a_vibration_far_from_every_maximum():
    """The maximum that it is given is at another frequency, and its vibration never changes."""
    exposures = frames(2.4, 64)
    of, seen = space(exposures)
    highest, told = candidate(1.13, 0.0, 1e-4).maximum, []
    scan = scanned(of, [highest], seen, shaken, exposures, lambda *done: told.append(done))
    found, left = scan.candidates, np.array(scan.left[2]) * EXPOSURE_S
    assert any(low < 2.4 < high for low, high in left)
    assert np.diff(left[left[:, 0] > 0.2]).sum() < 0.3  # of the 3.75 cycles an exposure that are scanned
    best = found[0]
    assert math.exp(best.x[2]) * EXPOSURE_S == pytest.approx(2.4, abs=0.02)
    assert 1 / (2 * math.pi * math.exp(best.x[2]) * math.exp(best.x[3]) * EXPOSURE_S) == pytest.approx(64 / 8)
    assert math.exp(best.x[4]) == pytest.approx(0.08, rel=0.25)  # its sd
    assert math.exp(best.maximum.x[2]) == pytest.approx(math.exp(best.x[2]), rel=0.02)
    apart = np.diff(np.sort([math.exp(each.x[2]) * EXPOSURE_S for each in found]))
    assert (apart > 0.15 / 8).all()  # no two at one peak
    done, _ = np.array(told).T
    assert told[0][0] == 0
    assert (np.diff(done) > 0).all()
    assert {of for _, of in told} == {2 * 64}


def test_nothing_is_scanned_where_one_vibration_is_alone_or_there_are_no_pixels():
    def refused(x):
        raise EstimatorError("profile takes at most 24 states")

    def unasked(x):
        raise AssertionError("no rig is wanted")

    def nothing(scan):
        return not scan.candidates and not scan.left

    exposures, highest = frames(2.4, 32), candidate(2.6, 0.0).maximum
    of, seen = space(exposures)
    assert nothing(scanned(of, [highest], seen, unasked, []))
    assert nothing(scanned(of, [highest], seen, refused, exposures))
    alone = space_of(("resonance",), seen)
    assert nothing(scanned(alone, [Maximum(highest.x[2:], 0.0, 12)], seen, unasked, exposures))


@pytest.mark.parametrize(
    ("damping", "made"),
    [(1e-4, [1 / 8]), (0.5 / (2 * math.pi * 2.4 * 8), [None]), (0.2, [None, 1 / 8])],
    ids=["longer than the recording", "as long as its eighth", "shorter"],
)
def test_a_maximum_whose_vibration_lasts_for_longer_than_the_recording_is_tried_with_one_that_changes(damping, made):
    """``made``: decay times over the recording's length, None for the maximum's own."""
    of, seen = space(frames(2.4, 64))
    at = Maximum(parameters(2.4, damping), 0.0, 12)
    found = candidates(of, [at], seen)
    expected = [damping if each is None else 1 / (2 * math.pi * 2.4 * 64 * each) for each in made]
    np.testing.assert_allclose([math.exp(each.x[3]) for each in found], expected)
    for each in found:
        assert each.maximum is at
        assert each.x[2] == pytest.approx(at.x[2])


@pytest.mark.rare
def test_frequency_and_damping_move_to_where_the_pixels_see_them():
    exposures = frames(2.4, 48)
    of, _ = space(exposures)
    told, start = [], parameters(2.41, 0.02)
    x = refined(of, start, shaken, exposures, lambda *done: told.append(done))
    assert math.exp(x[2]) * EXPOSURE_S == pytest.approx(2.4, abs=0.008)
    assert 0.0005 < math.exp(x[3]) < 0.007
    np.testing.assert_array_equal(x[[0, 1, 4]], start[[0, 1, 4]])
    assert told == [(0, 2), (1, 2)]
