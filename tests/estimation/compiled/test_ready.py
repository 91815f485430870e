"""Machine code is made once, and nothing is left to compile in a session."""

import os
import subprocess
import sys

import pytest

from aolink.estimation.compiled import compile_once, forget_stale


def test_one_process_compiles_for_all_others_once_for_each_version_of_the_sources(tmp_path):
    """What a process has compiled itself may differ in the last bit from what the others load."""
    said, source = tmp_path / "said", tmp_path / "loops.py"
    source.touch()
    program = f"open({str(said)!r}, 'a').write('compiled ')"
    compile_once(tmp_path, program)
    compile_once(tmp_path, program)
    assert said.read_text() == "compiled "
    later = source.stat().st_mtime + 60
    os.utime(source, (later, later))
    compile_once(tmp_path, program + "; raise SystemExit(1)")  # it has failed, so that the next one tries again
    compile_once(tmp_path, program)
    assert said.read_text() == 3 * "compiled "


FIRST_SESSION = """
import dataclasses, sys
from aolink.estimation import make_estimator
from aolink.estimation.compiled import joint, line, mixtures, modes, small, windowed
from aolink.rig import load_rig
from aolink.simulation.model import simulate

def overloads():
    loaded = small, line, modes, mixtures, joint, windowed
    each = [value for module in loaded for value in vars(module).values()]
    return sum(len(value.signatures) for value in each if hasattr(value, "signatures"))

rig, name = load_rig(sys.argv[1]), sys.argv[2]
rig = dataclasses.replace(rig, sensor=dataclasses.replace(rig.sensor, noise_density=float(sys.argv[3])))
assert overloads() == 0
estimator = make_estimator(rig, name)
before = overloads()
several = 0
for exposure in simulate(rig, int(sys.argv[4]), seed=2):
    estimator.step(exposure)
    several += estimator.several is not None and estimator.several[0]
print(before, overloads(), several)
"""


def first_session(rig, name, noise, exposures):
    """In a process of its own: this one has compiled before."""
    arguments = [sys.executable, "-c", FIRST_SESSION, rig, name, str(noise), str(exposures)]
    out = subprocess.run(arguments, capture_output=True, text=True, check=True).stdout
    return map(int, out.split())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["profile", "mixture"])
def test_nothing_is_compiled_in_a_session(name):
    before, after, several = first_session("section-vi-lively", name, 0.003, 30)
    assert before == after > 4
    assert several


@pytest.mark.parametrize("name", ["moments", "moments:flux=measured,basis=fourier"])
def test_nothing_is_compiled_in_a_session_of_moments(name):
    before, after, _ = first_session("section-vi-lively", name, 0.003, 4)
    assert before == after > 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "name"), [("membrane-12x12", "profile"), ("membrane-12x12", "moments"), ("single-lenslet", "mixture")]
)
def test_nothing_is_compiled_in_a_session_of_spots(rig, name):
    before, after, _ = first_session(rig, name, 1e-3, 4)
    assert before == after > 2


def test_machine_code_is_not_older_than_any_source(tmp_path):
    kept = tmp_path / "__pycache__"
    kept.mkdir()
    files = kept / "of_old.nbi", tmp_path / "one.py", tmp_path / "two.py", kept / "of_new.nbi"
    for age, name in enumerate(files):
        name.touch()
        os.utime(name, (age, age))
    forget_stale(tmp_path)
    assert [each.name for each in kept.iterdir()] == ["of_new.nbi"]
    forget_stale(tmp_path / "not there")
