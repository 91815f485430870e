"""What travels in a film is followed in whole pixels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from aolink.errors import ImportingError
from aolink.jobs.look_follow import followed, travels, window


def test_a_picture_that_travels_far_is_followed_to_a_fraction_of_a_pixel() -> None:
    rng = np.random.default_rng(1)
    big = ndimage.gaussian_filter(rng.normal(size=(400, 500)), 2.0)
    path = np.cumsum(rng.integers(-9, 14, size=(25, 2)), axis=0)  # a third of a frame
    path -= path[0]
    frames = [big[100 - y : 220 - y, 250 - x : 410 - x] + 0.01 * rng.normal(size=(120, 160)) for x, y in path]
    assert np.abs(path).max() > 40
    assert np.abs(travels(frames) - path).max() < 0.6
    still = [big[100:220, 250:410] + 0.02 * rng.normal(size=(120, 160)) for _ in range(5)]
    assert not travels(still).any()


def test_a_film_that_is_cut_is_refused_with_its_frame() -> None:
    rng = np.random.default_rng(1)
    first, second = (ndimage.gaussian_filter(rng.normal(size=(120, 160)), 2.0) for _ in range(2))
    with pytest.raises(ImportingError, match="frame 7"):
        travels([first] * 6 + [second] * 9)
    assert np.abs(travels([first] * 6 + [second] + [first] * 6)[:6]).max() < 0.1  # a flash is no cut


def test_a_region_is_followed_where_it_is_seen() -> None:
    rng = np.random.default_rng(2)
    thing = ndimage.gaussian_filter(rng.normal(size=(30, 30)), 1.5)
    places = np.cumsum(rng.integers(-2, 3, size=(40, 2)), axis=0).clip(-10, 10)
    cuts = 0.02 * rng.normal(size=(40, 54, 54))
    for k, (x, y) in enumerate(places):
        cuts[k, 12 + y : 42 + y, 12 + x : 42 + x] += thing
    cuts[7] = rng.normal(size=(54, 54))  # something else, a flash
    found, seen = followed(cuts, 12)
    assert not seen[7]
    assert seen.sum() == 39
    # From where it is in the frame that shows it best.
    start = (places - found)[0]
    np.testing.assert_array_equal((places - found)[seen], np.broadcast_to(start, (39, 2)))


def test_what_is_beyond_a_picture_is_unknown() -> None:
    picture = np.arange(12.0).reshape(3, 4)
    np.testing.assert_array_equal(window(picture, -1, 1, 3, 2), [[np.nan, 4, 5], [np.nan, 8, 9]])
    assert np.isnan(window(picture, 5, 0, 2, 2)).all()
