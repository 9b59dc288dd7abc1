# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Shared by the tests: processes of a loop, and a watch on what they leave behind."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import itertools
import os
import signal
import sys
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits

from pde_sim_node.equations.loading import OWN_EQUATIONS
from pde_sim_node.plants.loading import OWN_PLANTS
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from pdeloop.method.laws.registry import OWN_LAWS
from tests.support import leftovers
from tests.support.colcon_workspace import Workspace, build
from tests.support.compiled import COMPILED
from tests.support.domains import share_domains
from tests.support.forked_workers import fork_workers
from tests.support.loop_harness import Processes, processes
from tests.support.made_once import made_once
from tests.support.small import RECORDED, REPRODUCED, SMALL
from tests.support.undrawn import undraw

LONG = (
    "test_soak",
    "test_launch",
    "test_beyond",
    "test_working_directory",
    "test_foreign",
    "test_readme_commands",
    "test_pairs",
    "test_introspection",
    "test_actuators",
    "test_operator",
)
"""Files with the longest tests over topics. One of them at the end leaves the other workers idle."""

# The user's ROS settings do not reach the tests, nor the fixtures that several tests share.
ROS_SETTINGS = ("ROS_DOMAIN_ID", "FASTRTPS_DEFAULT_PROFILES_FILE", "PDELOOP_NETWORK")
for name in ROS_SETTINGS:
    os.environ.pop(name, None)
# Hundreds of processes import the same modules; each would compile them again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False  # for the tests themselves, whose asserts each worker would rewrite
# Processes inherit what is ignored: SIGINT in a shell's background, SIGHUP under nohup.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(scope="session", autouse=True)
def temporary_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The temporary folder of whatever the tests run, of this worker alone; see `leftovers`."""
    folder = tmp_path_factory.mktemp("tmp", numbered=False)  # short: sockets are in it
    share_domains(folder)
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
    return folder


@pytest.fixture(scope="module", autouse=True)
def _nothing_left(temporary_folder: Path, request: pytest.FixtureRequest) -> Iterator[None]:
    """No file of the temporary folder, and no process, remains of the tests in a file."""
    before = leftovers.files(temporary_folder)
    yield
    leftovers.check(temporary_folder, before, f"the tests of {request.node.name}")


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """Linear algebra in one thread: with as many as cores, most of them spin while four workers run."""
    with threadpool_limits(limits=1):
        yield


@pytest.fixture(scope="session", autouse=True)
def _compiled(tmp_path_factory: pytest.TempPathFactory, temporary_folder: Path) -> None:
    """What nearly all tests use is compiled once, its parts by as many workers, not by each of them."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    first = int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw")) % len(COMPILED)
    names = list(COMPILED)
    for name in (*names[first:], *names[:first]):
        made_once(tmp_path_factory, f"compiled-{name}", lambda _, name=name: COMPILED[name]())


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """What one test sets in the environment does not reach those after it."""
    for name in ROS_SETTINGS:
        monkeypatch.delenv(name, raising=False)
    for kind in (OWN_EQUATIONS, OWN_LAWS, OWN_OPTIMIZERS, OWN_PLANTS):
        # Set, if only to what it is: code that a test allows is not allowed afterwards.
        monkeypatch.setenv(kind.variable, os.environ.get(kind.variable, ""))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported and collected stays: the garbage collector does not look through it.

    It would do so again and again, which took half of the time until the first test.
    """
    gc.disable()
    try:
        with _first_alone():
            return (yield)
    finally:
        gc.enable()
        gc.freeze()


@contextlib.contextmanager
def _first_alone() -> Iterator[None]:
    """One worker comes before the others, who find what it has compiled to bytecode."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        yield
        return
    with Path(__file__).open() as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fcntl.flock(lock, fcntl.LOCK_SH)  # once the first one is done, all of them have it
            fcntl.flock(lock, fcntl.LOCK_UN)
        except OSError:
            pass  # a file system without locks: all of them at once
        yield


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Workers have to collect the same tests in the same order, and a set has another one in each."""
    for mark in metafunc.definition.iter_markers("parametrize"):
        if any(
            isinstance(values, set | frozenset) for values in (*mark.args, *mark.kwargs.values())
        ):
            pytest.fail(f"the parameters of {metafunc.definition.name} are a set: sort them")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Each worker's share has tests over topics, which mostly wait, next to those that compute.

    Workers are given equal parts of the list and take from the end of each other's. So it takes
    until the last of them for a worker to run out of either kind, and the longest come first.
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    topics = [item for item in items if item.get_closest_marker("topics")]
    topics.sort(key=lambda item: item.path.stem not in LONG)
    others = [item for item in items if not item.get_closest_marker("topics")]
    parts = [len(others) * i // workers for i in range(workers + 1)]
    items[:] = [
        item
        for i in range(workers)
        for item in between_modules(topics[i::workers], others[parts[i] : parts[i + 1]])
    ]


def between_modules(topics: list[pytest.Item], others: list[pytest.Item]) -> list[pytest.Item]:
    """The tests over topics, evenly between the modules of the others, which share fixtures."""
    mixed: list[pytest.Item] = []
    passed = taken = 0
    for _, module in itertools.groupby(others, key=lambda item: item.path):
        together = list(module)
        passed += len(together)
        due = -(-len(topics) * passed // len(others))
        mixed += [*topics[taken:due], *together]
        taken = due
    return mixed + topics[taken:]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A failure shows what the test's processes printed."""
    report = yield
    running = getattr(item, "funcargs", {}).get("loop")
    if report.failed and isinstance(running, Processes):
        report.sections.append(("processes", running.everything()))
    return report


def shared_memory() -> set[str]:
    """Fast DDS's files in shared memory that no living process uses."""
    names = {path.name for path in Path("/dev/shm").iterdir()}
    found = {name for name in names if "fastrtps" in name or "fastdds" in name}
    for maps in Path("/proc").glob("[0-9]*/maps") if found else ():
        with contextlib.suppress(OSError):
            used = maps.read_text()
            found = {name for name in found if f"/dev/shm/{name}" not in used}
    return found


@pytest.fixture
def loop(tmp_path: Path) -> Iterator[Processes]:
    """Processes on a ROS domain of their own; none of them and no shared memory may remain."""
    before = shared_memory()
    with processes(tmp_path) as running:
        yield running
    assert running.left_behind() == []
    assert shared_memory() <= before


@pytest.fixture
def forked_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pools of this test have worker processes that are forked, not executed."""
    fork_workers(monkeypatch)


@pytest.fixture(scope="session")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """The package as `colcon build` installs it, with its compiled code."""

    def make(folder: Path) -> Workspace:
        workspace = build(folder)
        workspace.add_compiled()
        return workspace

    return made_once(tmp_path_factory, "colcon", make)


@pytest.fixture(scope="session")
def reproduction(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A small reproduction: its folder, and what it said."""

    def make(folder: Path) -> tuple[Path, str]:
        with processes(folder) as running:
            run = running.pdeloop(
                "reproduce", *REPRODUCED, "--processes", "1", "--out", str(folder / "out")
            )
            return folder / "out", running.wait(run, 600.0)

    return made_once(tmp_path_factory, "reproduction", make)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports have their pages and files, which hold no pictures: most of what they cost."""
    undraw(monkeypatch.setattr)


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small run over topics, of RECORDED["iterations"] for two seeds, recorded as one MCAP bag."""

    def make(folder: Path) -> Path:
        with processes(folder) as running:
            options = [word for name, value in RECORDED.items() for word in (f"--{name}", value)]
            command = ("train", str(SMALL), *options, "--record", "--out", str(folder / "run"))
            running.wait(running.pdeloop(*command), 600.0)
        return folder / "run"

    return made_once(tmp_path_factory, "recorded", make)
