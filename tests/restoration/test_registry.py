"""Restoration methods of other packages: found by their entry points, used like aolink's own."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aolink.errors import RestorationError
from aolink.restoration import restore
from aolink.restoration.deblur import psnr
from tests.restoration.scenes import UNIFORM, blocks, blurred

Run = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def with_packages(with_example: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a process with the example package, and a package whose method is missing."""
    broken = tmp_path_factory.mktemp("broken") / "broken-1.0.dist-info"
    broken.mkdir()
    (broken / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (broken / "entry_points.txt").write_text("[aolink.restorations]\ngone = no_such_module:method\n")
    path = os.pathsep.join([str(broken.parent), with_example["PYTHONPATH"]])
    return with_example | {"PYTHONPATH": path, "COLUMNS": "200"}


@pytest.mark.slow
def test_a_method_of_another_package_restores_a_picture(
    aolink: Run, with_packages: dict[str, str], tmp_path: Path,
) -> None:  # fmt: skip
    image, scene = blurred(0.1 + blocks(40, 66, seed=2), UNIFORM, (3,))
    np.save(tmp_path / "in.npy", image)
    np.savetxt(tmp_path / "psf.csv", UNIFORM[None], delimiter=",")
    picture = ("in.npy", "--psf", "psf.csv", "-o", "out.npy", "--method")
    done = aolink("deblur", *picture, "richardson_lucy", env=with_packages)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "out.npy: richardson_lucy\n"
    inside = np.s_[:, 8:-8]
    restored = np.load(tmp_path / "out.npy")
    assert psnr(restored[inside], scene[inside]) > psnr(image[inside], scene[inside]) + 3


@pytest.mark.slow
def test_a_method_that_cannot_be_loaded_is_one_line(
    aolink: Run, with_packages: dict[str, str], tmp_path: Path,
) -> None:  # fmt: skip
    np.save(tmp_path / "in.npy", np.ones((9, 9)))
    (tmp_path / "psf.csv").write_text("1,1\n")
    arguments = ("deblur", "in.npy", "--psf", "psf.csv", "-o", "out.npy", "--method", "gone")
    done = aolink(*arguments, env=with_packages)
    assert done.returncode == RestorationError.exit_code
    assert done.stderr == (
        "aolink: the restoration method gone of broken (no_such_module:method) cannot be loaded:"
        " ModuleNotFoundError(\"No module named 'no_such_module'\")\n"
    )


@pytest.mark.parametrize(
    ("method", "parameters", "says"),
    [
        ("tv", {"boundary": 0.0}, "tv takes no boundary, which belongs to smoother, lag, inverse, filter, predictor"),
        ("smoother", {"denoise": abs}, "smoother takes no denoise, which belongs to pnp"),
        ("tv", {"strength": 2}, "tv takes no strength, which is a parameter of no method of aolink"),
    ],
)
def test_a_parameter_that_a_method_does_not_take_is_refused(method: str, parameters: dict[str, Any], says: str) -> None:
    with pytest.raises(RestorationError, match=says):
        restore(np.ones((9, 9)), np.ones(2), method=method, **parameters)
