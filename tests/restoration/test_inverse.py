"""The exact inverse: exact where it is stable, refused where it is not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from aolink.errors import RestorationError
from aolink.restoration import Psf, largest_zero, restore, stable_direction
from tests.restoration.scenes import DECAYING, UNIFORM, blocks, blurred

# One zero inside and one outside of the unit circle.
MIXED = np.array([1.0, 2.6, 1.2]) / 4.8


def psf(values: np.ndarray, origin: int = 0) -> Psf:
    return Psf(values=values, origin=(origin,))


def test_zeros_by_their_own_polynomial() -> None:
    assert largest_zero(np.array([1.0, -0.0, 0.0])) == 0
    assert largest_zero(MIXED) == pytest.approx(2.0)
    assert largest_zero(MIXED[::-1]) == pytest.approx(1 / 0.6)
    assert largest_zero(UNIFORM) == pytest.approx(1)
    # A delay has no zeros, only a longer way.
    assert largest_zero(np.r_[0, 0, DECAYING]) == pytest.approx(largest_zero(DECAYING))


@pytest.mark.parametrize(
    "values", [DECAYING, DECAYING[::-1], np.r_[0, 0, DECAYING, 0]], ids=["decaying", "rising", "late"]
)
def test_a_known_start_gives_the_scene_back(values: np.ndarray) -> None:
    m = len(values) - 1
    scene = blocks(16, 200 + m)
    image, inside = blurred(scene, values, (0,))
    lit = np.flatnonzero(values)
    taps = lit[-1] - lit[0]
    direction = stable_direction(values)
    # The scene's pixels that the first measured one meets besides its own.
    first = m - lit[-1] if direction == "forward" else 200 + m - lit[-1]
    start = scene[:, first : first + taps]
    found = restore(image, psf(values), method="inverse", boundary=start)
    assert found.direction == direction
    width = 200 - lit[0]
    assert abs(found.image[:, :width] - inside[:, :width]).max() < 1e-9


def test_the_recursion_of_the_inverse_system() -> None:
    image, _ = blurred(np.pad(blocks(6, 80), ((0, 0), (len(DECAYING) - 1, 0))), DECAYING, (0,))
    found = restore(image, psf(DECAYING), method="inverse", boundary=0.0)
    assert found.image == pytest.approx(signal.lfilter([1], DECAYING, image, axis=1), abs=1e-10)


def test_a_wrong_start_decays_inside_the_circle_and_stays_on_it() -> None:
    scene = blocks(8, 400)
    for values, decays in ((DECAYING, True), (UNIFORM, False)):
        image, inside = blurred(scene, values, (0,))
        error = abs(restore(image, psf(values), method="inverse", boundary=0.0).image - inside)
        assert error[:, :8].max() > 0.1
        late = error[:, -50:].max()
        assert late < 1e-6 if decays else 0.05 < late < 5


def test_an_unknown_start_is_estimated() -> None:
    m = len(UNIFORM) - 1
    scene = np.repeat(np.random.default_rng(1).uniform(0, 1, (8, 12)), 18, axis=1)
    image, inside = blurred(scene, UNIFORM, (m // 2,))
    zero = restore(image, psf(UNIFORM, m // 2), method="inverse", boundary=0.0)
    estimated = restore(image, psf(UNIFORM, m // 2), method="inverse")
    assert np.std(estimated.image - inside) < 0.15 * np.std(zero.image - inside)
    # Whatever the start, the picture is the one that was given.
    again, _ = blurred(estimated.image, UNIFORM, (m // 2,))
    assert again == pytest.approx(image[:, m // 2 : -(m // 2)], abs=1e-10)


def test_an_unstable_direction_is_refused_before_it_runs() -> None:
    image = np.zeros((4, 300))
    with pytest.raises(RestorationError, match=r"unstable forwards.*1\.4\d* forwards and 0\.7"):
        restore(image, psf(DECAYING[::-1]), method="inverse", direction="forward")
    with pytest.raises(RestorationError, match=r"unstable backwards.*forwards and 1\.4"):
        restore(image, psf(DECAYING), method="inverse", direction="backward")


def test_a_psf_with_zeros_on_both_sides_has_no_stable_inverse() -> None:
    with pytest.raises(RestorationError, match=r"unstable: .*2 forwards and 1\.67.*smoother, gauss_markov or tv"):
        restore(np.zeros((4, 30)), psf(MIXED), method="inverse")
    with pytest.raises(RestorationError, match=r"unstable forwards.*2 forwards and 1\.67"):
        restore(np.zeros((4, 30)), psf(MIXED), method="inverse", direction="forward")


def test_a_psf_for_each_pixel() -> None:
    ramp = np.linspace(0.6, 0.9, 60)[:, None]
    values = np.concatenate([ramp, 1 - ramp], axis=1)
    scene = blocks(5, 61)
    image = values[:, 0] * scene[:, 1:] + values[:, 1] * scene[:, :-1]
    varying = Psf(values=values, origin=(0,))
    assert varying.varies
    found = restore(image, varying, method="inverse", boundary=scene[:, :1])
    assert found.image == pytest.approx(scene[:, 1:], abs=1e-12)


def test_a_missing_pixel_or_a_wrong_boundary_is_refused() -> None:
    mask = np.ones((4, 30), bool)
    mask[1, 3] = False
    with pytest.raises(RestorationError, match="cannot do without a pixel"):
        restore(np.zeros((4, 30)), psf(DECAYING), method="inverse", mask=mask)
    with pytest.raises(RestorationError, match="boundary has shape"):
        restore(np.zeros((4, 30)), psf(DECAYING), method="inverse", boundary=np.zeros((4, 3)))
