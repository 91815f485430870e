"""`aolink identify --follow` in memory: when it says that a model fits, and what it offers where none does."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink.errors import IdentificationError
from aolink.exposure import Exposure
from aolink.identification import CANDIDATES, readings, rig_model
from aolink.identification.likelihood import Likelihood
from aolink.identification.search import SHORT_RUN
from aolink.jobs.follow import FITTED, HELD_OUT, REPORT, Following, News, Offer, offer_path, with_own_kinds
from aolink.jobs.identify import Wanted
from aolink.rig import load_rig, parse_rig
from tests.kinds import must_be


def with_line(frequency_hz):
    """The rig `loop` with a line and no drift: one process is fitted in a quarter of the time."""
    text = load_rig("loop").toml
    drift = text.index("[[disturbance.model]] # what"), text.index('[[disturbance.model]]\nkind = "resonance"')
    text = text[: drift[0]] + text[drift[1] :]
    return parse_rig(text.replace("frequency_hz = 12.0", f"frequency_hz = {frequency_hz}"))


def joined(*series):
    """Exposures of several simulations as if they were of one session."""
    out: list[Exposure] = []
    step = 0
    for exposures in series:
        out += [
            replace(each, frame_id=len(out) + k, first_step=each.first_step + step)
            for k, each in enumerate(exposures, 1)
        ]
        step = out[-1].first_step + out[-1].n_steps
    return out


def followed(rig, exposures, target="identified.toml"):
    job = Following(rig, Wanted(), Path(target))
    return job, [each for exposure in exposures for each in job.see(exposure)]


def test_a_model_that_fits_is_said_to_fit_at_intervals():
    rig = with_line(12.0)
    job, said = followed(rig, list(aolink.simulate(rig, 60 + REPORT, seed=3)))
    news = [must_be(News, each) for each in said]
    assert [each.frame_id for each in news] == [60, 60 + REPORT]
    assert all(each.fits for each in news)
    assert job.judged
    assert not job.offers


@pytest.mark.rare
def test_after_a_line_has_moved_its_new_frequency_is_offered_and_then_fits():
    rig, moved = with_line(12.0), with_line(14.0)
    change, count = 70, 40 + FITTED + HELD_OUT + 2
    exposures = joined(aolink.simulate(rig, change, seed=5), aolink.simulate(moved, count, seed=6))
    job, said = followed(rig, exposures)
    (offer,) = (each for each in said if isinstance(each, Offer))
    assert change < offer.fitted[0]
    assert offer.fitted[1] - offer.fitted[0] == FITTED - 1
    assert offer.held_out == (offer.fitted[1] + 1, offer.fitted[1] + HELD_OUT)
    (found,) = offer.result.found
    assert found.model.name == "resonance"
    frequency = next(each for each in found.parameters if each.name == "frequency_hz")
    assert frequency.best == pytest.approx(14.0, rel=0.02)
    assert "12 Hz" in offer.before_model
    assert offer.log_likelihood > offer.before + 10
    offered = parse_rig(offer.result.text)
    assert np.array_equal(offered.plant.A[:2, :2], rig.plant.A[:2, :2])
    held = [each for each in exposures if offer.held_out[0] <= each.frame_id <= offer.held_out[1]]
    alone = Likelihood(readings(rig, held), SHORT_RUN)(rig_model(offered, 0))
    assert offer.log_likelihood == pytest.approx(alone, abs=5)
    last = must_be(News, said[-1])
    assert last.fits
    assert last.text.startswith("identified.toml fits")
    assert job.offers == 1
    # The offer is followed as well: it no longer fits where the line moves once more.
    again = joined(exposures, aolink.simulate(with_line(9.0), 60, seed=7))[len(exposures) :]
    (missed,) = (must_be(News, each) for exposure in again for each in job.see(exposure))
    assert not missed.fits
    assert "identified.toml does not fit" in missed.text


@pytest.mark.rare
def test_what_does_not_foretell_better_is_not_offered():
    """The line moves while a new model is fitted, and is back where the rig file has it when that is judged."""
    rig = with_line(12.0)
    moved = joined(aolink.simulate(with_line(14.0), FITTED, seed=6), aolink.simulate(rig, HELD_OUT, seed=7))
    job, said = followed(rig, moved)
    assert not job.offers
    news = must_be(News, said[-1])
    assert news.frame_id == FITTED + HELD_OUT
    assert news.fits is None
    assert "is not offered" in news.text


def test_exposures_that_no_model_can_be_fitted_to_are_said_and_following_goes_on():
    """The frames' period is not that of the rig file after exposure 80, which the identification refuses."""
    late = [
        replace(each, first_step=each.first_step + 13 * (number > 80))
        for number, each in enumerate(aolink.simulate(with_line(14.0), FITTED + 1, seed=6), 1)
    ]
    _, said = followed(with_line(12.0), late)
    *before, last = (must_be(News, each) for each in said)
    assert [each.fits for each in before] == [False] * len(before)
    assert before[0].frame_id <= 60
    assert (last.frame_id, last.fits) == (FITTED, None)
    assert last.text.startswith("no new model: exposures do not start every 50 fast steps")


def test_what_shows_no_spot_is_not_judged():
    rig = with_line(12.0)
    dark = [
        replace(each, pixels=np.full_like(each.pixels, rig.sensor.black_level)) for each in aolink.simulate(rig, 70)
    ]
    job, said = followed(rig, dark)
    assert not job.judged
    assert not said


def test_slopes_without_pixels_are_one_error():
    rig = load_rig("loop")
    exposure = replace(next(iter(aolink.simulate(rig, 1))), slopes=np.zeros(rig.n_outputs))
    with pytest.raises(IdentificationError, match="slopes and no pixels"):
        followed(rig, [exposure])


def test_without_a_model_asked_for_it_is_of_the_kinds_that_the_rig_file_has():
    assert with_own_kinds(Wanted(), load_rig("loop")).models == ("ornstein-uhlenbeck+resonance",)
    assert with_own_kinds(Wanted(), load_rig("jitter")).models == CANDIDATES
    assert with_own_kinds(Wanted(models=("resonance",)), load_rig("loop")).models == ("resonance",)


def test_each_offer_has_a_file_of_its_own():
    names = [offer_path(Path("a/rig.v2.toml"), number) for number in (1, 2, 3)]
    assert names == [Path("a/rig.v2.toml"), Path("a/rig.v2-2.toml"), Path("a/rig.v2-3.toml")]
