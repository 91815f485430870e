"""In a folder of somebody else's data nothing of that folder runs, whatever its files are called."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OTHERS = (
    "cobs", "dask", "distributed", "google", "llvmlite", "matplotlib", "mcap", "numba", "numpy", "rerun", "scipy",
    "serial", "sitecustomize", "typer", "usercustomize", "yaml",
)  # fmt: skip
STANDARD = (
    "concurrent", "csv", "hashlib", "json", "multiprocessing", "pickle", "select", "selectors", "socket", "struct",
    "subprocess", "tempfile", "tomllib",
)  # fmt: skip
BATCH = "estimate s.mcap t.mcap -e o3 --jobs 2 -o made"


@pytest.fixture
def decoys(tmp_path: Path) -> Path:
    """A folder with a recording, and with modules that say so when they run."""
    (tmp_path / "s.mcap").write_bytes((ROOT / "recordings" / "section-vi.mcap").read_bytes())
    (tmp_path / "t.mcap").symlink_to("s.mcap")
    for name in ("aolink", "random", "threading", *OTHERS, *STANDARD):
        text = f"open({str(tmp_path / 'ran')!r}, 'a').write('{name} ')\nraise SystemExit(9)"
        (tmp_path / f"{name}.py").write_text(text)
    (tmp_path / ".numba_config.yaml").write_text(f"cache_dir: {tmp_path / 'ran'}")
    return tmp_path


def run(decoys: Path, *command: str | Path, **more: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"} | more
    done = subprocess.run(command, cwd=decoys, env=environment, capture_output=True, text=True, timeout=600)
    assert not (decoys / "ran").exists(), (decoys / "ran").read_text()
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    "words",
    [
        "info s.mcap",
        pytest.param(BATCH, marks=pytest.mark.slow),
        pytest.param("view s.mcap -o v.rrd", marks=pytest.mark.slow),
        pytest.param("report s.mcap -o r.html", marks=pytest.mark.slow),
        pytest.param("demo --exposures 3", marks=pytest.mark.rare),  # each estimator in a process
    ],
)
def test_a_command_runs_nothing_of_the_folder_that_it_is_started_in(decoys: Path, words: str) -> None:
    run(decoys, Path(sys.executable).with_name("aolink"), *words.split())


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("-P",)])
def test_nor_does_the_module_once_it_runs(decoys: Path, options: tuple[str, ...]) -> None:
    """Before that Python itself has imported what the package's first lines need, from there unless it is given -P."""
    if not options:
        for name in ("aolink", "random", "threading"):
            (decoys / f"{name}.py").unlink()
    run(decoys, sys.executable, *options, "-m", "aolink", *BATCH.split())


@pytest.mark.parametrize("words", ["info s.mcap", pytest.param(BATCH, marks=pytest.mark.slow)])
def test_nor_does_one_that_an_empty_entry_of_a_variable_leads_there(decoys: Path, words: str) -> None:
    """Before a command's first lines Python has looked there itself."""
    for name in ("aolink", "random", "threading", "sitecustomize", "usercustomize"):
        (decoys / f"{name}.py").unlink()
    run(decoys, Path(sys.executable).with_name("aolink"), *words.split(), PYTHONPATH=f"{ROOT}:")


@pytest.mark.slow
def test_nor_does_a_style_for_pictures_change_ours(decoys: Path) -> None:
    """TeX would run what the style says."""
    rc = decoys / "matplotlibrc"
    pages = []
    for text in ("", "text.usetex: True\ntext.latex.preamble: \\input{there}\nlines.linewidth: 9\nfont.size: 30\n"):
        rc.write_text(text)
        run(decoys, Path(sys.executable).with_name("aolink"), "report", "s.mcap", "-o", "r.html", "--overwrite")
        pages.append((decoys / "r.html").read_text())
    assert pages[0] == pages[1]


def test_nor_do_processes_that_a_notebook_starts(decoys: Path) -> None:
    """Its own path begins with the current folder."""
    program = (
        "import os, sys; here = os.getcwd(); os.chdir('/'); from aolink.numerics.workers import processes;"
        "os.chdir(here); assert sys.path[0] == ''\n"
        "with processes(1) as pool: assert '' not in pool.submit(eval, '__import__(\"sys\").path').result()\n"
        "assert sys.path[0] == ''"
    )
    run(decoys, sys.executable, "-c", program)
