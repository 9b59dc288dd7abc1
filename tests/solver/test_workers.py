# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The threads that share a step: who takes which slice, and on which cores they are."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from pde_sim_node.equations import Burgers
from pde_sim_node.plants import SpectralPlant
from pdeloop.solver import workers
from pdeloop.solver.workers import SolverThreads, use_cores
from tests.support.interpreter import ROOT, helps_solver, python

several = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
P1 = {
    "n_z": 128, "n_a": 6, "width": 0.15, "sample_time": 0.05, "integration_time": 0.0025,
    "horizon": 300, "state_weight": 1.0, "action_weight": 1.0,
}  # fmt: skip


def rollout(plant: SpectralPlant, seeds: range, steps: int = 20) -> bytes:
    plant.reset(np.array(seeds))
    for _ in range(steps):
        states = plant.step(np.full((len(seeds), plant.n_a), 0.1))
    return states.tobytes() + plant.episode_costs().total.tobytes()


def test_plants_in_several_threads_share_the_helpers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "solver_threads", SolverThreads())
    use_cores(range(1))
    alone = SpectralPlant(Burgers(), **P1)
    expected = [rollout(alone, range(first, first + 12)) for first in (0, 50, 100)]
    use_cores(range(4))
    plants = [SpectralPlant(Burgers(), **P1) for _ in expected]
    found: list[list[bytes]] = [[] for _ in expected]

    def work(which: int) -> None:
        for _ in range(10):
            found[which].append(rollout(plants[which], range(50 * which, 50 * which + 12)))

    started = [threading.Thread(target=work, args=(which,)) for which in range(len(plants))]
    for worker in started:
        worker.start()
    for worker in started:
        worker.join()
    assert found == [[bits] * 10 for bits in expected]


def test_a_small_step_is_compiled_code_alone_and_a_large_one_is_shared() -> None:
    program = """
import os, threading
import numpy as np
from pdeloop.solver import workers
from pde_sim_node.equations import Burgers
from pde_sim_node.plants import SpectralPlant
from tests.solver.test_workers import P1, rollout
workers.use_cores(range(3))
plant = SpectralPlant(Burgers(), **P1)
few = rollout(plant, range(2))
assert not plant.parallel.shared
assert threading.active_count() == 1
many = rollout(plant, range(16))
assert plant.parallel.shared
assert threading.active_count() == 3
if child := os.fork():
    print(os.waitpid(child, 0)[1])
else:  # a fork has none of the threads, and starts others
    os._exit(rollout(plant, range(16)) != many)
"""
    done = python("-c", program)
    assert done.stdout.strip() == "0"


@several
def test_helpers_leave_the_core_that_their_process_is_kept_on() -> None:
    """A real process is kept on a core, as a pair is, before its helpers exist."""
    cores = sorted(os.sched_getaffinity(0))
    program = f"""
import sys
from pdeloop.process.affinity import pin_process
from pdeloop.solver import workers
from pde_sim_node.equations import Burgers
from pde_sim_node.plants import SpectralPlant
from tests.solver.test_workers import P1, rollout
pin_process({cores[0]})
plant = SpectralPlant(Burgers(), **P1)
rollout(plant, range(16))
print("there", flush=True)
sys.stdin.readline()
"""
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None

    def places() -> dict[bool, set[int]]:
        """Cores of the helpers (True) and of all other threads (False)."""
        found: dict[bool, set[int]] = {True: set(), False: set()}
        for thread in Path(f"/proc/{process.pid}/task").iterdir():
            number = int(thread.name)
            found[helps_solver(process.pid, number)] |= os.sched_getaffinity(number)
        return found

    with process:
        assert process.stdout.readline() == "there\n"
        limit = time.monotonic() + 240
        while places() != {True: set(cores[1:]), False: {cores[0]}}:
            assert time.monotonic() < limit, places()
            time.sleep(0.05)
