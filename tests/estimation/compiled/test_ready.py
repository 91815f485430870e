"""Machine code is made once, and nothing is left to compile in a session."""

import ast
import os
import subprocess
import sys
import threading
import time

import pytest

from aolink.estimation.compiled import kept


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder of this test that keeps machine code."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    kept.folder.cache_clear()
    yield tmp_path
    kept.folder.cache_clear()


def test_one_process_compiles_a_group_for_all_others(place, capsys):
    """What a process has compiled itself may differ in the last bit from what the others load."""
    said = place / "said"

    def program(groups):
        return f"open({str(said)!r}, 'a').write({' '.join(groups)!r} + ';')"

    kept.compile_once(["a"], program)
    kept.compile_once(["a", "b", "c"], program)
    kept.compile_once(["c", "a"], program)
    assert said.read_text() == "a;b c;"
    lines = capsys.readouterr().err.splitlines()
    assert [each.partition(" (once)")[0] for each in lines] == [
        "aolink: compiling the loops of a", "aolink: compiling the loops of b, c"
    ]  # fmt: skip


def test_who_waits_for_another_process_says_so(place, capsys):
    """One that holds the lock until this one has said that it waits, in the lines of its standard error."""
    holds = (
        "import fcntl, sys; lock = open(sys.argv[1], 'w'); fcntl.flock(lock, fcntl.LOCK_EX);"
        " print('held', flush=True); sys.stdin.read()"
    )
    where = kept.folder()
    assert where
    command = [sys.executable, "-c", holds, str(where / "compiling.lock")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdin
        assert other.stdout
        assert other.stdout.readline() == "held\n"
        waiting = threading.Thread(target=kept.compile_once, args=(["a"], lambda groups: "pass"))
        waiting.start()
        said = ""
        while "waiting" not in said:
            said += capsys.readouterr().err
            time.sleep(0.01)
        other.stdin.close()
        waiting.join()
    assert "waiting" not in capsys.readouterr().err


def test_a_compilation_that_fails_is_said_and_tried_again(place, capsys):
    said = place / "said"
    kept.compile_once(["a"], lambda groups: "import sys; sys.exit('no room is left')")
    assert capsys.readouterr().err.splitlines()[1:] == [
        "aolink: this failed, so each process compiles them for itself: no room is left"
    ]
    kept.compile_once(["a"], lambda groups: f"open({str(said)!r}, 'w')")
    assert said.exists()


def test_where_nothing_can_be_kept_a_line_says_so_and_what_to_do(place, monkeypatch, capsys):
    (place / "file").touch()
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(place / "file"))
    monkeypatch.setattr(kept, "HERE", place / "file")
    assert kept.folder() is None
    (line,) = capsys.readouterr().err.splitlines()
    assert "NUMBA_CACHE_DIR" in line
    assert f"{place / 'file'}: Not a directory" in line


PROGRAM = """
import sys
from pathlib import Path
from aolink.estimation.compiled import kept

kept.SOURCES = tuple(sorted(Path(sys.argv[1]).glob("*.py")))
sys.path.insert(0, sys.argv[1])
from outer import outer
print(outer())
"""
INNER = """
from aolink.estimation.compiled.small import compiled

@compiled
def constant():
    return {}
"""
OUTER = """
from inner import constant
from aolink.estimation.compiled.small import compiled

@compiled
def outer():
    return constant() + 1
"""


@pytest.mark.slow
def test_a_source_that_is_older_than_the_code_made_of_another_is_compiled_all_the_same(tmp_path):
    """Copies that keep time stamps (rsync -a, layers of images) bring changed sources with earlier dates."""
    for name, text in (("inner.py", INNER.format(1)), ("outer.py", OUTER)):
        (tmp_path / name).write_text(text)

    def outcome():
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
        command = [sys.executable, "-c", PROGRAM, str(tmp_path)]
        return int(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)

    assert outcome() == 2
    (tmp_path / "inner.py").write_text(INNER.format(10))
    os.utime(tmp_path / "inner.py", (0, 0))
    assert outcome() == 11


def test_the_name_of_the_folder_follows_from_what_the_sources_contain(tmp_path):
    """And not from where they lie or from their dates."""
    here, there = tmp_path / "here", tmp_path / "there"
    for place in (here, there):
        place.mkdir()
        (place / "a.py").write_text("x = 1")
    os.utime(there / "a.py", (0, 0))
    assert kept.key([here / "a.py"]) == kept.key([there / "a.py"])
    (there / "a.py").write_text("x = 2")
    assert kept.key([here / "a.py"]) != kept.key([there / "a.py"])


def test_what_is_compiled_comes_from_the_sources_that_the_name_follows_from():
    """A constant or function of another module would be compiled in, and change unnoticed."""
    names = {str(path.relative_to(kept.HERE.parents[2]).with_suffix("")).replace("/", ".") for path in kept.SOURCES}
    for path in kept.HERE.glob("*.py"):
        nodes = [each for each in ast.parse(path.read_text()).body if isinstance(each, ast.ImportFrom)]
        imported = {each.module for each in nodes if each.module and each.module.startswith("aolink")}
        # The first has only types, the second the package's own modules; `kept` holds no compiled code.
        if path.stem != "kept":
            assert imported - {"aolink.numerics.arrays", "aolink.estimation.compiled"} <= names, path


FIRST_SESSION = """
import dataclasses, sys
from aolink.estimation import make_estimator
from aolink.estimation.compiled import joint, mixtures, modes, pixels, small, windows
from aolink.rig import load_rig
from aolink.simulation.model import simulate

def overloads():
    loaded = small, pixels, modes, mixtures, joint, windows
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
    several += estimator.is_multimodal is not None and estimator.is_multimodal[0]
print(before, overloads(), several)
"""


def first_session(rig, name, noise, exposures):
    """In a process of its own: this one has compiled before."""
    arguments = [sys.executable, "-c", FIRST_SESSION, rig, name, str(noise), str(exposures)]
    out = subprocess.run(arguments, capture_output=True, text=True, check=True).stdout
    return map(int, out.split())


@pytest.mark.slow
def test_nothing_is_compiled_in_a_session():
    before, after, several = first_session("section-vi-lively", "profile", 0.003, 30)
    assert before == after > 4
    assert several


@pytest.mark.slow
def test_nothing_is_compiled_in_a_session_of_moments():
    before, after, _ = first_session("section-vi-lively", "moments", 0.003, 4)
    assert before == after >= 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "name"), [("membrane-12x12", "profile"), ("membrane-12x12", "moments"), ("single-lenslet", "profile")]
)
def test_nothing_is_compiled_in_a_session_of_spots(rig, name):
    before, after, _ = first_session(rig, name, 1e-3, 4)
    assert before == after > 2
