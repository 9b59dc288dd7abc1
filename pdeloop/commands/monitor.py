# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop monitor`: the live page."""

from __future__ import annotations

import argparse
import os
import shlex
import webbrowser

from pdeloop.commands.common import Commands, a_path, command
from pdeloop.messages.spec import ParameterError

PORT = 8420


def add(commands: Commands) -> None:
    """The command `monitor`."""
    monitor = command(
        commands,
        "monitor",
        _monitor,
        help="serve a live page of a running loop",
        description="Serve a page on 127.0.0.1 that shows a loop as it runs: the field, the "
        "actions, the profile against the target, the training curve, the nodes, and buttons to "
        "pause. Without DIR and ROS_DOMAIN_ID it shows the newest training on this machine, then "
        "the next one. Ctrl-C ends it; the loop never waits for it.",
        example="pdeloop monitor runs/burgers-20260101-120000-1 --environment 3",
    )
    add = monitor.add_argument
    add(
        "folder",
        nargs="?",
        type=a_path,
        metavar="DIR",
        help="folder of the run to show [the newest one that is running]",
    )
    add(
        "--port",
        type=int,
        default=PORT,
        metavar="N",
        help=f"port of the page; 0: any free one [{PORT}]",
    )
    add(
        "--namespace",
        metavar="NS",
        help="namespace of the pair to show first [the first one found]",
    )
    add(
        "--environment",
        type=int,
        default=0,
        metavar="M",
        help="environment of each episode to show [0]",
    )
    add("--open", action="store_true", help="open the page in the browser")
    add(
        "--network",
        action="store_true",
        help="also find a loop whose messages leave this machine (the page never does)",
    )


def _monitor(options: argparse.Namespace) -> int:
    from pdeloop.domain import given_domain
    from pdeloop.monitor.finder import Finder, run_id
    from pdeloop.process.affinity import lower_priority
    from tuner_node.run_folder import RunFolder
    from viewer_node.web.page import Page
    from viewer_node.web.server import Server

    folder = options.folder
    if not 0 <= options.port < 65536:
        raise ParameterError(f"--port is {options.port}; expected a whole number from 0 to 65535")
    if options.environment < 0:
        raise ParameterError(f"--environment is {options.environment}; expected 0 or more")
    if folder is not None and run_id(folder) is None:
        raise ParameterError(f"no run in {folder}; give the folder of a run, or no folder")
    finder = Finder(folder, given_domain())
    if folder is not None and finder.find() is None:
        way = RunFolder(folder).without_results()
        if (folder / "result.json").exists():
            way = f"it is finished and is shown by: pdeloop report {shlex.quote(str(folder))}"
        raise ParameterError(f"no loop is working on the run in {folder}; {way}")
    from pdeloop.monitor.node import show_loops  # here, as it needs ROS

    page = Page(options.environment)
    lower_priority(19)
    try:
        server = Server(page, options.port)
    except OSError as error:
        raise ParameterError(
            f"port {options.port} on 127.0.0.1 is not available ({os.strerror(error.errno or 0)}); "
            "choose another with --port N, or a free one with --port 0"
        ) from error
    server.start()
    print(f"monitor at {server.address}  (Ctrl-C ends it)", flush=True)
    if options.open:
        webbrowser.open(server.address)
    try:
        given = options.namespace
        namespace = None if given is None else f"/{given.strip('/')}"
        show_loops(page, finder, namespace=namespace, network=options.network)
    finally:
        server.stop()
    return 0
