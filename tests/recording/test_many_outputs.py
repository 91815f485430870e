"""Recordings of plants that move many spots at once: what is large in them is kept small."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard

from aolink.estimation import run
from aolink.estimation.estimate import as_recorded, motion
from aolink.estimation.model.factored import FactoredModel
from aolink.numerics.covariance import from_correlation_steps, in_correlation_steps, psd_root
from aolink.recording import convert
from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference, reestimate
from aolink.rig import load_rig
from aolink.session import record
from aolink.simulation.model import simulate
from aolink.wire.truth import truth_message
from tests.commands import simulated_rig
from tests.conftest import Session
from tests.kinds import must_be

NAMES = ("open-loop", "o1", "o3")


@pytest.fixture(scope="module")
def pupil(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """48 spots behind a pupil, one plant for all of them; without unmodelled slopes its basis is dense."""
    folder = tmp_path_factory.mktemp("pupil")
    path, rig = folder / "session.mcap", folder / "dense.toml"
    before, after = load_rig("sh-8x8").toml.split("[plant.unmodelled]")
    rig.write_text(before + after[after.index("[timing]") :])
    with simulated_rig(rig) as (camera, mirror):
        return Session(path, record(load_rig(rig), camera, mirror, path, estimators=NAMES, exposures=5))


@pytest.mark.slow
def test_online_and_offline_estimates_agree_bit_for_bit(pupil: Session) -> None:
    recording = Recording(pupil.path)
    for name, again in reestimate(recording, NAMES).items():
        recorded = recording.estimates(name)
        assert len(recorded) == 5
        assert first_difference(recorded, again) is None
    (estimate, *_) = recording.estimates("o3")
    assert estimate.innovation_covariance.shape == (1, 192)


@pytest.mark.slow
def test_the_attached_arrays_expand_the_recorded_coefficients(pupil: Session) -> None:
    recording = Recording(pupil.path)
    outputs, basis = (
        np.load(io.BytesIO(recording.attachments[f"exposure_{name}.npy"])) for name in ("outputs", "basis")
    )
    for name in ("open-loop", "o3"):
        estimate = recording.estimates(name)[-1]
        count = estimate.coefficients.shape[1]
        path = np.tensordot(outputs, basis[..., :count] @ estimate.coefficients[0], axes=1)
        response = estimate.model.response(estimate.inputs).path[0]
        np.testing.assert_allclose(estimate.path, path + response, atol=1e-10)


@pytest.mark.slow
def test_a_plant_of_hundreds_of_states_is_recorded_as_patterns_and_courses(tmp_path: Path) -> None:
    """144 actuators before 100 lenslets: what expands the coefficients takes two megabytes."""
    names, path = ("o3", "profile"), tmp_path / "session.mcap"
    with simulated_rig("membrane-12x12") as (camera, mirror):
        record(load_rig("membrane-12x12"), camera, mirror, path, estimators=names, exposures=2)
    recording = Recording(path)
    attached = [recording.attachments[f"exposure_{name}.npy"] for name in ("outputs", "basis")]
    assert sum(map(len, attached)) < 3e6
    patterns, courses = (np.load(io.BytesIO(each)) for each in attached)
    for name, again in reestimate(recording, names).items():
        recorded = recording.estimates(name)
        assert first_difference(recorded, again) is None
        estimate = recorded[-1]
        z = estimate.coefficients[0]
        path_of_z = patterns[:, : len(z)] @ (z * courses[:, : len(z)]).T
        np.testing.assert_allclose(
            estimate.path, path_of_z + estimate.model.response(estimate.inputs).path[0], atol=1e-10
        )
        assert estimate.end_covariance.shape == (1, 288, 288)
        message = convert.estimate_message(estimate)
        assert message.ByteSize() < {"o3": 0.2e6, "profile": 0.3e6}[name]  # of 1.3 and 4.5 MB as doubles
        assert not len(message.end_covariance) + len(message.coefficient_covariance)
    mix = np.eye(2, 200)
    mixed, root = motion(estimate, mix, psd_root(estimate.coefficient_covariance))
    np.testing.assert_allclose(mixed, estimate.path[:2], atol=1e-12)
    missing = estimate.path_sd[:2].ravel() ** 2 - np.sum(root**2, axis=1)
    np.testing.assert_allclose(
        missing, np.repeat(must_be(FactoredModel, estimate.model).noise.left_out[:2], 200), atol=1e-12
    )


def test_a_whole_innovation_covariance_of_an_older_file_is_read() -> None:
    rig = load_rig("sh-8x8")
    exposures = simulate(rig, 1)
    (estimate,) = run(rig, exposures, ["o3"])["o3"]
    message = convert.estimate_message(estimate)
    assert not message.innovation_covariance
    whole = np.diag(estimate.innovation_covariance[0])
    message.innovation_covariance.extend(whole.ravel())
    del message.innovation_variance[:]
    read = convert.estimate_from_message(message, estimate.model, exposures[0])
    np.testing.assert_array_equal(read.innovation_covariance[0], whole)


def large_covariances(count: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    root = np.random.default_rng(1).standard_normal((2, count, count))
    return root @ root.swapaxes(-1, -2)


def test_large_covariances_are_rounded_and_stay_positive_semidefinite_and_others_are_as_they_are() -> None:
    singular = np.random.default_rng(2).standard_normal((2, 400, 3)) * np.geomspace(1e-9, 1e9, 400)[:, None]
    for given in (large_covariances(300), singular @ singular.swapaxes(-1, -2)):
        rounded = as_recorded(given)
        sd, before = (np.sqrt(np.einsum("aii->ai", each)) for each in (rounded, given))
        assert (sd >= before).all()
        np.testing.assert_allclose(sd, before, rtol=1.05e-4)  # half of 401 half steps, which variances grow by
        scale, old_scale = (each[:, :, None] * each[:, None, :] for each in (sd, before))
        np.testing.assert_allclose(rounded / scale, given / old_scale, atol=2.5e-4)
        np.testing.assert_array_equal(rounded, rounded.swapaxes(-1, -2))
        assert np.linalg.eigvalsh(rounded / scale).min() > -1e-13
    few = large_covariances(256)
    assert as_recorded(few) is few


@pytest.mark.parametrize("variance", [0.0, -1e-20])
def test_a_state_without_uncertainty_stays_certain(variance: float) -> None:
    """Also where rounding left its variance below zero."""
    given = large_covariances(300)
    given[:, 7] = given[:, :, 7] = 0.0
    given[:, 7, 7] = variance
    rounded = as_recorded(given)
    assert not rounded[:, 7].any()
    assert not rounded[:, :, 7].any()
    assert np.isfinite(rounded).all()
    np.testing.assert_array_equal(convert.decoded(convert.correlated(rounded), 2, 300), rounded)


@pytest.mark.parametrize("count", [1, 2, 300])
def test_correlations_are_recorded_as_the_proto_file_says(count: int) -> None:
    given = from_correlation_steps(*in_correlation_steps(large_covariances(count)))
    data = convert.correlated(given)
    content = zstandard.decompress(data)
    sd = np.frombuffer(content[: 8 * count], "<f4").reshape(2, count).astype(float)
    planes = np.frombuffer(content[8 * count :], np.uint8).reshape(3, -1).astype(int)
    stored = planes[0] + 256 * planes[1] + 65536 * planes[2]
    r = np.where(stored % 2, -(stored + 1) // 2, stored // 2).reshape(2, -1) / 2**20
    rows, columns = np.tril_indices(count, -1)
    np.testing.assert_array_equal(r * sd[:, rows] * sd[:, columns], given[:, rows, columns])
    np.testing.assert_array_equal(sd**2, np.einsum("aii->ai", given))
    np.testing.assert_array_equal(convert.decoded(data, 2, count), given)


def test_covariances_that_were_not_rounded_are_recorded_as_doubles() -> None:
    assert convert.correlated(large_covariances(300)) == b""


def test_compressed_covariances_are_damage_where_they_are_not_what_they_say() -> None:
    """Also what would not fit into memory: a frame of nothing but zeros is small."""
    data = convert.correlated(as_recorded(large_covariances(300)))
    zeros = zstandard.compress(bytes(4 * 8000 + 3 * 8000 * 7999 // 2))
    assert convert.is_compressed(data, 2, 300)
    wrong = [(data, 2, 299), (data, 1, 300), (b"", 2, 300), (data[4:], 2, 300), (zeros, 1, 8000)]
    assert not any(convert.is_compressed(*each) for each in wrong)


def test_a_truth_of_very_many_outputs_is_in_single_precision() -> None:
    truth = simulate("sh-30x30", 1)[0].truth
    assert truth is not None
    message = truth_message(1, truth)
    assert message.ByteSize() < 4.1 * truth.path.size
    read = convert.truth_from_message(message)
    np.testing.assert_allclose(read.path, truth.path, rtol=1e-7)
    np.testing.assert_array_equal(read.end_state, truth.end_state)
