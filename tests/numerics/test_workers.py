"""Processes end with the one that started them, in whatever way that ends."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from aolink.recording.reader import Recording
from tests.conftest import Session

Run = Callable[..., subprocess.CompletedProcess[str]]
_PATIENCE_S = 60.0


def all_end(processes: list[psutil.Process]) -> bool:
    """Whether they all do. A process that has ended and that nobody has asked about counts as ended."""
    deadline = time.monotonic() + _PATIENCE_S
    while any(each.is_running() and each.status() != psutil.STATUS_ZOMBIE for each in processes):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


@contextmanager
def started(folder: Path, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "aolink", *words]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_for(true: Callable[[], object], process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + _PATIENCE_S
    while not true():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.mark.slow
def test_the_workers_of_a_killed_batch_end_and_the_next_run_does_it_all(
    aolink: Run, recorded: Session, tmp_path: Path
) -> None:
    shutil.copy(recorded.path, tmp_path / "a.mcap")
    batch = ("estimate", "a.mcap", "-e", "o1", "--set", "plant.process_noise=1,2,3,4,5,6", "--jobs", "2", "-o", "out")
    with started(tmp_path, *batch) as process:
        wait_for(lambda: [*tmp_path.glob("out/.*.mcap.*")], process)
        children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) >= 2
        process.kill()
    assert all_end(children)
    # The table that the killed process held is left; the next run removes it.
    assert not [*tmp_path.glob("out/.*.mcap.*")], "the workers remove what they had begun"
    again = aolink(*batch, "--json")
    assert again.returncode == 0, again.stderr
    assert [row["error"] for row in json.loads(again.stdout)] == [None] * 6
    assert all(Recording(path).complete for path in tmp_path.glob("out/*.mcap"))
    assert not [*tmp_path.glob("out/.*")]


def test_a_worker_that_is_ended_while_it_imports_what_a_call_needs_prints_nothing(tmp_path: Path) -> None:
    """Code in C gives an interrupted import as an error of the import."""
    (tmp_path / "needed.py").write_text(
        "import multiprocessing, pathlib, time\n"
        "def work(): pass\n"
        "if multiprocessing.parent_process() is not None:\n"
        "    pathlib.Path('begun').touch()\n"
        "    try:\n"
        "        time.sleep(60)\n"
        "    except BaseException as error:\n"
        "        raise ImportError('initialisation failed') from error\n"
    )
    # Imported inside, so that the worker imports it with the call, not with the program.
    (tmp_path / "program.py").write_text(
        "import pathlib, time\n"
        "from aolink.numerics.workers import processes\n"
        "if __name__ == '__main__':\n"
        "    from needed import work\n"
        "    try:\n"
        "        with processes(1) as pool:\n"
        "            pool.submit(work)\n"
        "            while not pathlib.Path('begun').exists():\n"
        "                time.sleep(0.01)\n"
        "            raise ValueError\n"
        "    except ValueError:\n"
        "        pass\n"
    )
    done = subprocess.run(
        [sys.executable, "program.py"], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=_PATIENCE_S
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_workers_that_have_nothing_to_do_end_as_well(tmp_path: Path) -> None:
    program = (
        "import os, sys\n"
        "from aolink.numerics.workers import processes\n"
        "if __name__ == '__main__':\n"
        "    with processes(2) as pool:\n"
        "        print(*{pool.submit(os.getpid).result() for _ in range(20)}, flush=True)\n"
        "        sys.stdin.read()\n"
    )
    (tmp_path / "program.py").write_text(program)
    with subprocess.Popen(
        [sys.executable, "program.py"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=tmp_path
    ) as process:
        assert process.stdout is not None
        workers = [psutil.Process(int(word)) for word in process.stdout.readline().split()]
        process.kill()
    assert workers
    assert all_end(workers)


# What the thread that writes calls does meanwhile: it writes the first one, or has been made and not been started yet.
BUSY = ""
NOT_STARTED = (
    "    import threading, time\n"
    "    start = threading.Thread.start\n"
    "    threading.Thread.start = lambda self: (time.sleep(0.5 if 'Feeder' in self.name else 0), start(self))[1]\n"
)


@pytest.mark.parametrize("meanwhile", [BUSY, NOT_STARTED], ids=["busy", "not started"])
def test_a_pool_ends_with_calls_waiting_that_are_larger_than_a_pipe(tmp_path: Path, meanwhile: str) -> None:
    program = (
        "from aolink.numerics.workers import processes\n"
        "if __name__ == '__main__':\n" + meanwhile + "    with processes(1) as pool:\n"
        "        for _ in range(4):\n"
        "            pool.submit(len, bytes(10_000_000))\n"
        "        raise SystemExit(7)\n"
    )
    (tmp_path / "program.py").write_text(program)
    assert subprocess.run([sys.executable, "program.py"], cwd=tmp_path, timeout=_PATIENCE_S).returncode == 7


@pytest.mark.slow
def test_a_pool_ends_while_a_result_is_on_its_way_that_is_larger_than_a_pipe(tmp_path: Path) -> None:
    """A worker that is ended in the middle of it: nobody sends the rest."""
    program = (
        "import select\nfrom aolink.numerics.workers import processes\n"
        "if __name__ == '__main__':\n    with processes(1) as pool:\n"
        "        pool.submit(bytes, 400_000_000)\n"
        "        select.select([pool._result_queue._reader], [], [])\n"
        "        raise SystemExit(7)\n"
    )
    (tmp_path / "program.py").write_text(program)
    assert subprocess.run([sys.executable, "program.py"], cwd=tmp_path, timeout=_PATIENCE_S).returncode == 7


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_what_a_terminal_sends_to_all_is_for_the_parent_alone(
    recorded: Session, tmp_path: Path, number: signal.Signals
) -> None:
    """A terminal sends Ctrl-C and its own end to every process; jobs on the way are ended in good order, not killed."""
    shutil.copy(recorded.path, tmp_path / "a.mcap")
    values = ",".join(str(1 + k) for k in range(100))
    words = ["estimate", "a.mcap", "-e", "o1", "--set", f"plant.process_noise={values}", "--jobs", "2", "-o", "out"]
    with subprocess.Popen(
        [sys.executable, "-m", "aolink", *words], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    ) as process:  # fmt: skip
        deadline = time.monotonic() + _PATIENCE_S
        while not [*tmp_path.glob("out/*.mcap")]:
            assert time.monotonic() < deadline
            time.sleep(0.005)
        os.killpg(process.pid, number)
        _, errors = process.communicate(timeout=_PATIENCE_S)
    assert (process.returncode, errors) == (128 + number, f"aolink: interrupted by {number.name}\n")
    assert not [*tmp_path.glob("out/.*")]


@pytest.mark.slow
def test_the_simulated_rig_of_a_killed_demo_ends(tmp_path: Path) -> None:
    with started(tmp_path, "demo", "--rig", "tip-tilt", "--exposures", "100000") as process:
        wait_for(lambda: [*tmp_path.glob("demo-*/session.mcap")], process)
        children = psutil.Process(process.pid).children(recursive=True)
        assert children
        process.kill()
    assert all_end(children)


def test_a_process_whose_parent_ended_before_it_began_to_watch_ends() -> None:
    program = "import os; from aolink.numerics.workers import end_with; end_with({parent}); print(1, flush=True)"
    for parent, said in (("os.getppid()", b"1\n"), ("os.getpid()", b"")):
        command = [sys.executable, "-c", program.format(parent=parent)]
        done = subprocess.run(command, stdout=subprocess.PIPE, check=False, timeout=_PATIENCE_S)
        assert (done.stdout, done.returncode) == (said, int(not said))


@pytest.mark.slow
def test_the_viewer_of_a_killed_command_ends(recorded: Session, tmp_path: Path) -> None:
    with started(tmp_path, "view", str(recorded.path), "--web") as process:
        wait_for(lambda: psutil.Process(process.pid).children(recursive=True), process)
        children = psutil.Process(process.pid).children(recursive=True)
        process.kill()
    assert all_end(children)
