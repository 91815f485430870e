"""What the pages document works: every code block of every page is run, and every command in their text is a real one.

A block is indented by four spaces or more, or fenced. Its commands are run one after the other, as they stand, in a
folder that holds the files they speak of; `SHORTER` says what is changed about them, and why. A new block is run from
the day it is written; one of a kind that nothing here knows how to run fails.
"""

from __future__ import annotations

import gzip
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import tifffile
import typer
from PIL import Image
from typer.core import TyperGroup

from aolink.cli.common import app
from aolink.recording.reader import Recording
from aolink.rig import load_rig, parse_rig
from aolink.session import record
from aolink.simulation.model import simulate
from tests.commands import command_server, simulated_rig
from tests.jobs.test_look import line_film
from tests.jobs.test_look_spots import shaken
from tests.jobs.test_witness import from_truth
from tests.kinds import must_be
from tests.needs import needed

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    {
        *ROOT.glob("*.md"),
        *(each for top in ("aolink", "recordings", "tests", "tools") for each in (ROOT / top).rglob("*.md")),
    }
)
PAGES.remove(ROOT / "CHANGELOG.md")  # it tells of commands as they were

SHORTER = {
    "--duration 60": "--duration 2",
    "--exposures 30": "--exposures 6",
    "--start 10 --end 20": "--start 0.5 --end 1.5",
    "[--view]": "",  # a test has no screen
}
"""What is changed about a command before it is run: times, and what needs a screen."""
EXIT_CODES = {"aolink copy broken.mcap": 1}
"""Exit codes of commands that do not end with 0, as the page says beside them."""
BY_CI = ("sh tools/demo", "sh tools/test")
"""They set everything up, so that CI runs them and no test can."""
LIGHTS: tuple[str, ...] = ("--light", "dark,flat:4,flat:8,still")
"""What the simulated camera sees one after the other while `aolink calibrate` asks for it."""


@dataclass(frozen=True)
class CodeBlock:
    """A code block of a page."""

    page: Path
    line: int
    language: str
    """Empty where it is indented and not fenced."""
    text: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def code_blocks(page: Path) -> Iterator[CodeBlock]:
    """Fenced and indented blocks, in order. What is indented after a line of text goes on with its paragraph."""
    fence, begun, kept, before = "", 0, list[str](), ""
    for number, line in enumerate([*page.read_text().splitlines(), "."], 1):
        if fence:
            if line.startswith("```"):
                yield CodeBlock(page, begun, fence[3:].strip() or "none", "\n".join(kept))
                fence, kept = "", []
            else:
                kept.append(line)
        elif line.startswith("```"):
            fence, begun = line, number + 1
        elif line.startswith("    ") and (kept or not before.strip()):
            begun = begun if kept else number
            kept.append(line.strip())
        elif kept and line.strip():
            yield CodeBlock(page, begun, "", "\n".join(kept))
            kept = []
        before = line


BLOCKS = [block for page in PAGES for block in code_blocks(page)]
NO_CODE = {
    "aolink sim section-vi --real-time --listen": "test_the_block_of_a_tunnel_works",
    "dask ": "tests/jobs/test_cluster.py starts them",
    "make ": "tests/tools/test_device.py makes the reference device, tests/session/test_real_time.py runs it",
}
"""How indented blocks begin that are no commands, and what holds them."""
SHELL = [block for block in BLOCKS if not block.language and not block.text.startswith(tuple(NO_CODE))]
PYTHON = [block for block in BLOCKS if block.language == "python"]
ENGINES = {
    "slurm": ("task.sh", "SLURM_ARRAY_TASK_ID=1 sh task.sh && SLURM_ARRAY_TASK_ID=2 sh task.sh", ""),
    "snakemake": ("Snakefile", "snakemake --cores 2", "snakemake"),
}
"""How a block for an engine is run: as which file, by which command, and the module that has to be installed."""
TOML = [block for block in BLOCKS if block.language == "toml"]


def commands(block: CodeBlock) -> Iterator[str]:
    """Each command without its comment; where parts of it are in brackets, without them and with all of them."""
    for line in block.text.splitlines():
        command = re.sub(r"\s+#.*", "", line)
        for whole, shorter in SHORTER.items():
            command = command.replace(whole, shorter)
        if command.startswith("aolink view ") and not re.search(r" -o ", command):
            command += " -o view.rrd"  # nor has it here
        bare, full = re.sub(r"\[.*?\]", "", command), re.sub(r"[\[\]]", "", command)
        yield from dict.fromkeys(" ".join(each.split()) for each in (bare, full))


def cost_of(block: CodeBlock) -> str:
    """A model is fitted to pixels in minutes."""
    return "rare" if block.text.startswith("aolink identify shaken.mcap") else "slow"


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all the files that the pages' commands speak of."""
    folder = tmp_path_factory.mktemp("laboratory")
    rigs = load_rig("section-vi").path_of("", "")
    shutil.copytree(rigs, folder / "aolink" / "rigs")
    shutil.copy(rigs / "section-vi.toml", folder / "my.toml")  # as README begins with
    (folder / "recordings").mkdir()
    shutil.copy(ROOT / "recordings" / "fork.npz", folder / "recordings")
    rig = load_rig(folder / "my.toml")
    with simulated_rig(folder / "my.toml") as ports:
        record(rig, *ports, folder / "session.mcap", estimators=["moments"], exposures=12)
        shutil.copy(folder / "session.mcap", folder / "again.mcap")
    with simulated_rig("jitter") as ports:
        record(load_rig("jitter"), *ports, folder / "shaken.mcap", exposures=24)
    with simulated_rig("loop") as ports:
        record(load_rig("loop"), *ports, folder / "running.mcap", exposures=62)
    for part in ("001", "002"):
        with simulated_rig(folder / "my.toml") as ports:
            record(rig, *ports, folder / f"session-{part}.mcap", exposures=4)
    whole = (folder / "session.mcap").read_bytes()
    (folder / "broken.mcap").write_bytes(whole[: len(whole) // 2])
    mmirs = ROOT / "tests" / "data" / "mmirs"
    for name, source in (("frame.fits", "mmirs_wfs_0150.fits.gz"), ("flat.fits", "mmirs_camera2_ref.fits.gz")):
        (folder / name).write_bytes(gzip.decompress((mmirs / source).read_bytes()))
    scene = np.asarray(Image.open(rigs / "moving-scene.png").convert("L").resize((96, 96)))
    Image.fromarray(scene).save(folder / "moved.png")
    frames = np.stack([each.pixels for each in simulate(rig, 6)])
    rate = 1 / (rig.timing.frame_period_steps * rig.timing.fast_step_s)
    np.savez(folder / "film.npz", frames=frames, rate_hz=rate)
    np.savez(folder / "wide.npz", frames=np.pad(frames, ((0, 0), (7, 7), (200, 200)), mode="edge"), rate_hz=rate)
    tifffile.imwrite(folder / "film.tif", np.stack(list(shaken().frames())))
    np.save(folder / "line.npy", line_film())
    from_truth(Recording(folder / "session.mcap"), folder / "gyro.csv")
    np.savetxt(folder / "psf.csv", np.full((1, 9), 1 / 9), delimiter=",")
    (folder / "log.csv").write_text("time,x,y\n0.0,0.0,0.0\n0.1,5.0,1.0\n")
    return folder


def run(command: str, folder: Path, answers: str = "") -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, with this Python's own programs first on the path and without a screen.

    One of aolink's that needs no shell does not wait for a process to load.
    """
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment |= {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
    }
    if command.startswith("aolink ") and not set(command) & set("*?[&|><$"):
        return command_server().run(shlex.split(command)[1:], folder, answers, environment)
    return subprocess.run(
        ["sh", "-c", command], cwd=folder, env=environment, input=answers, capture_output=True, text=True, timeout=600
    )


@pytest.mark.parametrize(
    "block", [pytest.param(each, marks=getattr(pytest.mark, cost_of(each)), id=str(each)) for each in SHELL]
)
def test_a_block_of_commands_works(block: CodeBlock, laboratory: Path, tmp_path: Path) -> None:
    """Devices are simulated ones behind pseudo terminals; what a command writes is not there before it."""
    folder = tmp_path / "here"
    shutil.copytree(laboratory, folder)
    for command in commands(block):
        if command in BY_CI:
            assert command in (ROOT / ".ci" / "run").read_text()
            continue
        assert command.startswith("aolink "), f"{block}: {command} is no command that this test knows how to run"
        if target := re.search(r"(?:-o|--output) (\S+)", command):
            (folder / target[1]).unlink(missing_ok=True)
        with ExitStack() as stack:
            if "/dev/ttyACM" in command:
                options = LIGHTS if command.startswith("aolink calibrate") else ()
                if "--reconnect" in command:
                    options += ("--real-time",)
                named = re.search(r"--rig ([\w-]+)(?: |$)", command)  # a rig that comes along, or the laboratory's
                served = named[1] if named else folder / "my.toml"
                camera, mirror = stack.enter_context(simulated_rig(served, *options))
                command = command.replace("/dev/ttyACM0", camera).replace("/dev/ttyACM1", mirror)
            done = run(command, folder, answers="\n" * 8)
        expected = next((code for start, code in EXIT_CODES.items() if command.startswith(start)), 0)
        assert done.returncode == expected, f"{block}: {command}\n{done.stdout}{done.stderr}"
        assert "Traceback" not in done.stderr
        if target and "--dry-run" not in command.split():  # which writes nothing
            assert (folder / target[1]).exists(), command


@pytest.mark.slow
def test_the_block_of_a_tunnel_works(tmp_path: Path) -> None:
    """Where rig and host are one machine there is nothing to tunnel: both ends have the same ports."""
    (block,) = (block for block in BLOCKS if block.text.startswith("aolink sim section-vi --real-time --listen"))
    serve, tunnel, save = commands(block)
    assert re.findall(r"-L (\d+):127\.0\.0\.1:(\d+)", tunnel) == [("5000", "5000"), ("5001", "5001")]
    _, _, rig, *options = serve.replace("127.0.0.1:5000", "127.0.0.1:0").split()
    with simulated_rig(rig, *options) as (camera, mirror):
        save = save.replace("socket://127.0.0.1:5000", camera).replace("socket://127.0.0.1:5001", mirror)
        done = run(save, tmp_path)
    assert done.returncode == 0, done.stderr
    assert Recording(tmp_path / "session.mcap").complete


@pytest.mark.slow
@pytest.mark.parametrize("block", PYTHON, ids=str)
def test_a_block_of_python_works(block: CodeBlock, laboratory: Path, tmp_path: Path) -> None:
    """As a program of its own, in a folder that has a recording; a file that it writes is one that aolink takes."""
    for module in re.findall(r"^import (hcipy|pyrtc|skimage)$", block.text, re.MULTILINE):
        needed(module)
    folder = tmp_path / "here"
    shutil.copytree(laboratory, folder)
    before = set(folder.iterdir())
    (folder / "block.py").write_text(block.text)
    done = run("python block.py", folder)
    assert done.returncode == 0, f"{block}\n{done.stdout}{done.stderr}"
    for made in {*folder.glob("*.mcap")} - before:
        assert run(f"aolink info {made.name} --check", folder).returncode == 0
        assert len(list(Recording(made))) > 0


@pytest.mark.parametrize("block", TOML, ids=str)
def test_a_block_of_toml_is_of_a_rig_file_or_of_the_example_package(block: CodeBlock, laboratory: Path) -> None:
    """A rig file that is whole stands alone; tables of one are added to the laboratory's."""
    tables = tomllib.loads(block.text)
    if "project" in tables:
        example = tomllib.loads((ROOT / "tests" / "example_package" / "pyproject.toml").read_text())["project"]
        for group, points in tables["project"]["entry-points"].items():
            assert points.items() <= example["entry-points"][group].items()
    else:
        before = "" if "plant" in tables else (laboratory / "my.toml").read_text()
        parse_rig(f"{before}\n{block.text}")


@pytest.mark.slow
@pytest.mark.parametrize("block", [block for block in BLOCKS if block.language in ENGINES], ids=str)
def test_a_block_for_an_engine_works(block: CodeBlock, laboratory: Path, tmp_path: Path) -> None:
    """Where the engine is installed; of Slurm only what a task is needs to be there. All recordings have side files."""
    folder = tmp_path / "here"
    shutil.copytree(laboratory, folder)
    name, command, module = ENGINES[block.language]
    if module:
        pytest.importorskip(module, reason="what runs in batches is aolink's; the engine is tried where it is")
    (folder / name).write_text(block.text)
    done = run(command, folder)
    assert done.returncode == 0, f"{block}\n{done.stdout}{done.stderr}"
    assert {each.name for each in folder.glob("results/**/*.mcap")} == {f"session-{k}.o3.mcap" for k in ("001", "002")}


def test_every_block_is_of_a_kind_that_is_tried() -> None:
    assert {block.language for block in BLOCKS} == {"", "python", "toml", "text", *ENGINES}, "text is for equations"
    assert SHELL
    assert PYTHON
    for start in NO_CODE:
        assert any(block.text.startswith(start) for block in BLOCKS), f"no page has a block that begins with {start!r}"


def test_commands_in_the_text_have_the_options_that_they_are_given() -> None:
    """Commands inside sentences are not run, but neither may they name what there is not."""
    known = must_be(TyperGroup, typer.main.get_command(app)).commands
    seen = 0
    for page in PAGES:
        for text in re.findall(r"`(aolink [a-z][^`]*)`", page.read_text()):
            _, name, *arguments = text.split()
            assert name in known, f"{page.name}: there is no command {name}"
            options = {option for parameter in known[name].params for option in parameter.opts} | {"--help"}
            for argument in arguments:
                assert argument in options or argument[0] != "-", f"{page.name}: aolink {name} has no {argument}"
            seen += 1
    assert seen > 10
