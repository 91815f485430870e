"""A film in which one of two objects is gone after a while: the other one's truth is kept, and all readers take it."""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import aolink
from aolink.batch import estimate_file
from aolink.cli.tables.scores import scores
from aolink.estimation import run, score
from aolink.exporting.files import export
from aolink.exposure import Exposure
from aolink.films.film import array_film
from aolink.importing.first_rig import first_rig
from aolink.importing.frames import FilmSettings
from aolink.importing.recording import import_film
from aolink.plotting import save_figure
from aolink.rig import Rig, parse_rig
from aolink.viewing import save_rrd
from tests.kinds import truth_of
from tests.viewing.rrd import read_rrd

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from paper_report.spot_films import random_walk, spot_film

GONE = 20
"""First frame without the second object."""
K, EXPOSURES = 8, 5


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, Path]:
    rng = np.random.default_rng(7)
    middles = np.array([[24.0, 32.0], [70.0, 30.0]])
    frames = spot_film(rng, random_walk(rng, K * EXPOSURES, 2, 0.3), middles).frames
    frames[GONE:, :, 48:] = np.rint(1000 + 20 * rng.normal(size=frames[GONE:, :, 48:].shape)).astype(np.uint16)
    places = ((24.0, 32.0), (70.0, 30.0))
    settings = FilmSettings(rate_hz=100.0, subtract_median=True, track=2, frames_per_exposure=K, places=places)
    film = array_film(frames, "film")
    rig = parse_rig(first_rig(film, settings, "film").text)
    path = tmp_path_factory.mktemp("film") / "film.mcap"
    import_film(film, rig, settings, path)
    return rig, path


@pytest.fixture(scope="module")
def exposures(recorded: tuple[Rig, Path]) -> list[Exposure]:
    return list(aolink.read(recorded[1]).exposures())


@pytest.mark.rare
def test_the_truth_of_an_object_does_not_need_the_other_one(exposures: list[Exposure]) -> None:
    for k, exposure in enumerate(exposures):
        gone = (k + 1) * K > GONE
        assert truth_of(exposure).known.tolist() == [True, True, not gone, not gone]
        assert np.isnan(truth_of(exposure).path[2:]).all() == gone


@pytest.mark.rare
def test_errors_are_those_of_the_objects_whose_path_is_known(
    recorded: tuple[Rig, Path], exposures: list[Exposure]
) -> None:
    (estimates,) = run(recorded[0], exposures, ["o1"]).values()
    errors = [e.path - truth_of(x).path for e, x in zip(estimates, exposures, strict=True)]
    whole, first = errors[: GONE // K], [each[:2] for each in errors[GONE // K :]]
    means = [float(np.mean(each**2)) for each in (*whole, *first)]
    assert score(exposures, estimates).path_rmse == pytest.approx(np.sqrt(np.mean(means)), rel=1e-12)


@pytest.mark.slow
def test_it_is_shown_drawn_and_exported(recorded: tuple[Rig, Path], exposures: list[Exposure], tmp_path: Path) -> None:
    """Where it is known: a line of the first object in each exposure, of the second one in the first two."""
    side = tmp_path / "estimates.mcap"
    estimate_file(recorded[1], side, "o1")
    series = aolink.read(recorded[1], side=[side])
    paths = read_rrd(save_rrd(series, tmp_path / "a.rrd"))["/camera/image/path/truth"]
    strips = [len(each) for each in paths["LineStrips2D:strips"] if each is not None]
    assert strips == [2 if (k + 1) * K <= GONE else 1 for k in range(EXPOSURES)]
    save_figure(series, "exposure", tmp_path / "exposure.png", exposure=EXPOSURES - 1, spot=1)
    export(series, tmp_path / "a.csv")
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    errors = np.array([[float(row["o1_path_error_rms"] or "nan")] for row in rows]).reshape(EXPOSURES, 4)
    known = np.array([truth_of(each).known for each in exposures])
    assert (np.isfinite(errors) == known).all()


def test_a_table_of_scores_has_no_number_for_states_that_no_film_shows(
    exposures: list[Exposure], recorded: tuple[Rig, Path]
) -> None:
    rig, _ = recorded
    text = io.StringIO()
    Console(width=200, file=text).print(scores({"o1": score(exposures, run(rig, exposures, ["o1"])["o1"])}))
    (row,) = [words for line in text.getvalue().splitlines() if (words := line.split())[:1] == ["o1"]]
    assert row[1:3] == ["-", "-"]
    assert float(row[3]) > 0
