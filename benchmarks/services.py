"""How soon a recorded training answers its operator: services, requests in a queue, and Ctrl-C."""

from __future__ import annotations

import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import rclpy
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from benchmarks.processes import BenchError, BenchProcess, bench, machine, markdown

LIMIT = 300.0
"""Seconds that anything may take."""
SERVICES = ("pde_sim_node/pause", "pde_sim_node/resume", "tuner_node/pause", "tuner_node/resume")


def run(problem: str = "burgers", calls: int = 20, queued: int = 20) -> dict[str, Any]:
    """Seconds of each call, of `queued` ones that are sent at once, and of the end by Ctrl-C."""
    with bench() as running:
        os.environ |= running.environment
        out = running.folder / "run"
        command = [sys.executable, "-m", "pdeloop", "train", problem, "--record", "--out", str(out)]
        words = ["--optimizer", "two_point", "--iterations", "100000"]
        training = running.run("training", [*command, *words])
        _until(lambda: "adapted" in _read(out / "progress.jsonl"), training)
        rclpy.init()
        result = _call(calls, queued)
        rclpy.shutdown()
        return {"machine": machine(), **result, **_interrupt(training)}


def _call(calls: int, queued: int) -> dict[str, Any]:
    node = rclpy.create_node("operator")
    waiting = QoSProfile(depth=max(10, queued))  # all answers may come at once
    clients = {name: node.create_client(Trigger, name, qos_profile=waiting) for name in SERVICES}
    spinning = threading.Thread(target=rclpy.spin, args=(node,), daemon=True)
    spinning.start()

    def seconds(name: str, count: int = 1) -> float:
        began, over = time.perf_counter(), threading.Semaphore(0)
        for _ in range(count):
            clients[name].call_async(Trigger.Request()).add_done_callback(lambda _: over.release())
        for _ in range(count):
            if not over.acquire(timeout=LIMIT):
                raise BenchError(f"{name} did not answer within {LIMIT:.0f} s")
        return time.perf_counter() - began

    for client in clients.values():
        if not client.wait_for_service(LIMIT):
            raise BenchError(f"there is no service {client.srv_name}")
    single: dict[str, list[float]] = {name: [] for name in SERVICES}
    for _ in range(calls):
        for name in SERVICES:
            single[name].append(seconds(name))
            time.sleep(0.3)
    return {
        "calls": single,
        "queued": queued,
        "queues": {name: seconds(name, queued) for name in SERVICES if name.endswith("resume")},
    }


def _interrupt(training: BenchProcess) -> dict[str, float]:
    """Seconds after Ctrl-C: until a line says so, until the end, and of processor time meanwhile."""
    process = training.process
    used = sum(map(_processor_time, _family(process.pid)))
    children = _reaped()
    began = time.perf_counter()
    process.send_signal(signal.SIGINT)
    while "stopping" not in training.line():
        pass
    told = time.perf_counter() - began
    process.wait(LIMIT)
    ended = time.perf_counter() - began
    return {"told": told, "ended": ended, "processor": _reaped() - children - used}


def _until(true: Callable[[], bool], training: BenchProcess) -> None:
    limit = time.monotonic() + LIMIT
    while not true():
        if time.monotonic() > limit or training.process.poll() is not None:
            raise BenchError(f"the training does not go on: {training.log()[-300:]}")
        time.sleep(0.1)


def _read(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""


def _reaped() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _family(pid: int) -> list[int]:
    """The process and all that descend from it (Linux)."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [pid, *(member for child in children for member in _family(int(child)))]


def _processor_time(pid: int) -> float:
    """Seconds so far, with those of the children that have ended (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def text(result: dict[str, Any]) -> str:
    """Tables of `result`."""
    calls = [
        (f"`~/{name.split('/')[1]}` of the {name.split('/')[0]}", _ms(median(own)), _ms(max(own)))
        for name, own in result["calls"].items()
    ]
    queues = [
        (f"{result['queued']} requests at once to the {name.split('/')[0]}", "", _ms(took))
        for name, took in result["queues"].items()
    ]
    table = markdown(("service", "median, ms", "longest, ms"), [*calls, *queues])
    return (
        f"{table}\n\nCtrl-C: told after {_ms(result['told'])} ms, ended after {result['ended']:.2f} s, "
        f"{result['processor']:.2f} s of processor time (load {result['machine']['load']:.1f})"
    )


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.0f}"
