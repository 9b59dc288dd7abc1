# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The start of a process: its standard streams, its signals, missing packages. It imports little.

The console scripts of the nodes are here; `python -m pdeloop.process.start NODE` does the same.
"""

import gc
import importlib
import os
import resource
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from pdeloop.process.module_path import leave_out_working_directory
from pdeloop.process.quick_imports import quick_imports

STOPPED_BY_SIGNAL = 130
"""Exit code."""
REFUSED = 1
"""Exit code."""
LEAST_ADDRESS_SPACE = 2 * 2**30
"""Bytes (`ulimit -v`). A node maps 1.4 GB and uses a sixth of it. Where that cannot be had, OpenBLAS
asks for it for ever, deaf to signals, and other libraries fail in words that do not name the cause."""
PARENT = "PDELOOP_PARENT"
"""The environment variable with the id of the process that started a node, with which it ends."""
BLAS_THREADS = "OPENBLAS_NUM_THREADS"
"""The environment variable with their number. Results are those of one (`one_thread`): the others would
begin with each process, and spin for work that does not come."""
OWN = {"MPLBACKEND": "agg"}
"""Variables with other values in own processes, and in what these start: figures go to files alone."""
_PR_SET_PDEATHSIG = 1
_EXTRAS = {
    "rosbags": "record",
    "mcap": "record",
    "matplotlib": "report",
    "jinja2": "report",
    "aiohttp": "monitor",
    "gymnasium": "gym",
    "distributed": "cluster",
    "cmaes": "bench",
    "osqp": "bench",
    "tensorboardX": "tensorboard",
}
"""Modules that only some commands and nodes need, and the extra that installs them."""
_ROS = ("rclpy", "rcl_interfaces", "rosgraph_msgs", "rosidl_runtime_py", "builtin_interfaces")
_MESSAGES = ("_msgs", "_srvs")
"""Names and endings of the modules of ROS 2."""


def begin(program: str) -> None:
    """The first thing of a process. Until it has handlers of its own, a signal ends it, with one line.

    Most of a start is imports, and an exception within those of compiled code is lost, or becomes
    another: so none is raised.
    """
    leave_out_working_directory()
    os.environ.setdefault(BLAS_THREADS, "1")
    os.environ.update(OWN)
    _open_streams()
    for stream in (sys.stdout, sys.stderr):  # PYTHONIOENCODING=ascii, LC_ALL=C
        if isinstance(stream, TextIOWrapper) and stream.errors != "backslashreplace":
            with suppress(OSError):  # of a terminal that is open for reading as well
                stream.reconfigure(errors="backslashreplace")
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < LEAST_ADDRESS_SPACE:
        print(
            f"{program}: the limit of this process's address space (ulimit -v) is {limit // 2**20} "
            f"MiB; expected at least {LEAST_ADDRESS_SPACE // 2**20} MiB, most of which stays unused: "
            "raise it, or limit resident memory instead, with a control group",
            file=sys.stderr,
        )
        sys.exit(REFUSED)

    def end(name: str) -> None:
        try:
            os.write(2, f"{program}: stopped by {name}\n".encode())
        finally:
            os._exit(STOPPED_BY_SIGNAL)

    on_signals(end)


def die_with(parent: int) -> None:
    """This process is killed when its parent, the process of this id, ends."""
    import ctypes  # which only a process that was started by another one needs

    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before that
        os._exit(1)


def _open_streams() -> None:
    """Let each standard stream that is closed (`>&-`) lead to /dev/null.

    Otherwise the next file or socket that is opened would take its number, and what is printed.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(descriptor, True)
            setattr(sys, name, os.fdopen(descriptor, mode))


def on_signals(handler: Callable[[str], None]) -> dict[signal.Signals, Any]:
    """Let SIGINT, SIGTERM and SIGHUP (a closed terminal) call `handler` with their name.

    Returns the handlers of before.
    """
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as nohup leaves it
        numbers.append(signal.SIGHUP)

    def handle(number: int, frame: object) -> None:
        handler(signal.Signals(number).name)

    return {number: signal.signal(number, handle) for number in numbers}


def what_to_install(error: ImportError) -> str | None:
    """Name the missing module and how to install it; None for one that nothing here installs.

    Modules of another Python's ROS, as PYTHONPATH may name them, are named with their place.
    """
    module = (error.name or "").split(".")[0]
    if foreign := _foreign(error):
        path, what = foreign
        return (
            f"the {what} in {path} cannot be loaded by this Python "
            f"{sys.version_info.major}.{sys.version_info.minor}: take it out of PYTHONPATH (a "
            "setup.bash of ROS 2 puts it there), or install pdeloop for the Python of that ROS 2"
        )
    if not isinstance(error, ModuleNotFoundError):
        return None
    if module in _ROS or module.endswith(_MESSAGES):
        return f"needs {module}: source an installed ROS 2 Jazzy, or pip install 'pdeloop[ros]'"
    extra = _EXTRAS.get(module)
    return extra and f"needs {module}: pip install 'pdeloop[{extra}]'"


def _foreign(error: ImportError) -> tuple[Path, str] | None:
    """The folder and name of a package of ROS 2 that is there, outside of this Python, and broken."""
    frames, trace = [Path(error.path)] if error.path else [], error.__traceback__
    while trace is not None:
        frames.append(Path(trace.tb_frame.f_code.co_filename))
        trace = trace.tb_next
    for file in frames:
        for folder in file.parents:
            ours = folder.name in (*_ROS, "rpyutils") or folder.name.endswith(_MESSAGES)
            if ours and Path(sys.prefix) not in folder.parents:
                return folder.parent, folder.name
    return None


def run(node: str) -> int:
    """The `main` of a node, in whose package it is `node.main`."""
    if parent := os.environ.pop(PARENT, ""):
        die_with(int(parent))
    begin(node)
    try:
        with quick_imports():
            module = importlib.import_module(f"{node}.node")
    except ImportError as error:
        if (needed := what_to_install(error)) is None:
            raise
        print(f"{node}: {needed}", file=sys.stderr)
        return REFUSED
    gc.freeze()  # nor later: modules stay
    code: int = module.main()
    sys.stdout.flush()
    sys.stderr.flush()
    # Everything is closed. Tearing down the interpreter would still cost a third of a core second.
    os._exit(code)


pde_sim_node = partial(run, "pde_sim_node")
controller_node = partial(run, "controller_node")
tuner_node = partial(run, "tuner_node")
recorder_node = partial(run, "recorder_node")
viewer_node = partial(run, "viewer_node")

if __name__ == "__main__":
    del sys.argv[0]  # so that the node's name stands there
    sys.exit(run(sys.argv[0]))
