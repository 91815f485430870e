"""What each case costs: seconds of processor time, of this process and of all that it starts.

--slow-limit 2: a case that takes more and is marked neither slow nor rare fails. --costs FILE: a line for each case.
What is set up for the whole session is nobody's; what is set up for a module is paid by the case that comes first.
"""

from __future__ import annotations

import os
import resource
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

# A worker has a core: threads of BLAS would wait for each other there, busily. This is read when NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
_TICKS = os.sysconf("SC_CLK_TCK")
_spared_s = _begun_s = 0.0


@contextmanager
def spared() -> Iterator[None]:
    """What is set up in here is not the cost of the case that happens to need it first."""
    global _spared_s
    before_s, taken_s = _spared_s, _taken_s()
    try:
        yield
    finally:
        _spared_s = before_s + _taken_s() - taken_s


def pytest_addoption(parser: pytest.Parser) -> None:
    limit = "seconds of processor time that a case which is not marked slow may take"
    parser.addoption("--slow-limit", type=float, metavar="SECONDS", help=limit)
    parser.addoption("--costs", type=Path, metavar="FILE", help="where to add a line with what each case takes")


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol() -> Generator[None, object, object]:
    global _begun_s
    _begun_s = _taken_s() - _spared_s
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[object]) -> Generator[None, object, object]:
    if fixturedef.scope != "session":
        return (yield)
    with spared():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if call.when == "teardown":
        taken_s, option = _taken_s() - _spared_s - _begun_s, item.config.option
        marks = [each for each in ("slow", "rare") if item.get_closest_marker(each)]
        if option.costs:
            with option.costs.open("a") as file:
                file.write(f"{taken_s:.3f} {','.join(marks) or '-'} {item.nodeid}\n")
        if option.slow_limit and taken_s > option.slow_limit and not marks and report.passed:
            report.outcome = "failed"
            report.longrepr = f"{item.nodeid} takes {taken_s:.1f} s of processor time: shorten it, or mark it slow"
    return report


def _taken_s() -> float:
    used = [resource.getrusage(each) for each in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used) + _living_s(str(os.getpid()))


def _living_s(process: str) -> float:
    """What the children of a process which still run have taken, and theirs."""
    total = 0.0
    for children in Path(f"/proc/{process}/task").glob("*/children"):
        try:
            for child in children.read_text().split():
                times = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[11:15]
                total += sum(map(int, times)) / _TICKS + _living_s(child)
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has ended
    return total
