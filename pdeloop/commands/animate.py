# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop animate`."""

from __future__ import annotations

import argparse

from pdeloop.commands import common

NAME = "animation.gif"


def add(commands: common.Commands) -> None:
    """The command `animate`."""
    animate = common.command(
        commands,
        "animate",
        _animate,
        help="animate a run without control, with LQT and with the adapted law",
        description="Show an episode of a finished run without control, with LQT and with the "
        "adapted law side by side, from the same initial field and in the same colours, as a GIF, "
        "or as an MP4 if ffmpeg is installed.",
        example="pdeloop animate runs/burgers --out burgers.gif",
    )
    add = animate.add_argument
    add("folder", type=common.a_path, metavar="RUN", help="folder of a finished run")
    add(
        "--out",
        type=common.a_path,
        metavar="FILE",
        help=f"file to write, .gif or .mp4 [RUN/{NAME}]",
    )
    add(
        "--field",
        type=int,
        default=0,
        metavar="I",
        help="number of the initial field in the closing evaluation [0]",
    )
    add("--seconds", type=float, default=6.0, metavar="S", help="duration in seconds [6]")
    common.add_own_code(animate)


def _animate(options: argparse.Namespace) -> int:
    from pdeloop.animation import animated, write, writes

    if not 0 < options.seconds <= 60:
        options.refuse(f"--seconds is {options.seconds:g}; expected a number above 0, at most 60")
    path = options.out or options.folder / NAME
    writes(path)
    run = common.finished_run(options)
    write(path, animated(run, field=options.field, seconds=options.seconds))
    print(f"animation in {path}")
    return 0
