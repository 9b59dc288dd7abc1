# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How soon a recorded training answers its operator: services, requests in a queue, and Ctrl-C."""

from __future__ import annotations

import os
import resource
import signal
import threading
import time
from pathlib import Path
from statistics import median
from typing import Any

import rclpy
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from benchmarks.processes import (
    BenchError,
    BenchProcess,
    bench,
    ended_well,
    machine,
    program,
    progress,
    table,
)

LIMIT = 300.0
"""Seconds that anything may take."""
SERVICES = ("pde_sim_node/pause", "pde_sim_node/resume", "tuner_node/pause", "tuner_node/resume")


def run(*, problem: str = "burgers", calls: int = 20, queued: int = 20) -> dict[str, Any]:
    """Seconds of each call, of `queued` ones that are sent at once, and of the end by Ctrl-C."""
    with bench() as running:
        os.environ |= running.environment
        out = running.folder / "run"
        command = program("pdeloop", "train", problem, "--record", "--out", str(out))
        words = ["--optimizer", "two_point", "--iterations", "100000"]
        training = running.run("training", [*command, *words])
        limit = time.monotonic() + LIMIT
        while not any(row["event"] == "adapted" for row in progress(out)):
            if time.monotonic() > limit or ended_well(training):
                raise BenchError(f"the training does not go on: {training.log()[-300:]}")
            time.sleep(0.1)
        rclpy.init()
        rows = _call(calls, queued)
        rclpy.shutdown()
        return {"machine": machine(), "rows": rows, **_interrupt(training)}


def _call(calls: int, queued: int) -> list[dict[str, Any]]:
    """Milliseconds of the calls of each service."""
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
    rows = [
        {"request": name, "median": 1e3 * median(own), "longest": 1e3 * max(own)}
        for name, own in single.items()
    ]
    for name in SERVICES:
        if name.endswith("resume"):
            took = 1e3 * seconds(name, queued)
            rows.append({"request": f"{name}, {queued} at once", "median": took, "longest": took})
    return rows


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
    columns = {"request": "service", "median": "median, ms", "longest": "longest, ms"}
    return (
        f"{table(result['rows'], columns)}\n\nCtrl-C: told after {1e3 * result['told']:.0f} ms, ended "
        f"after {result['ended']:.2f} s, {result['processor']:.2f} s of processor time "
        f"(load {result['machine']['load']:.1f})"
    )
