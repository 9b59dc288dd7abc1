# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop export`."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from pdeloop.commands import common
from pdeloop.messages.spec import ParameterError

if TYPE_CHECKING:
    from pdeloop.finished_run import FinishedRun

LAWS = ("adapted", "lqt")
"""The laws of a run, the first being the default."""


MODEL_FILES = {
    "fmu": (".fmu", "the law as an FMU for co-simulation, which a C compiler makes,"),
    "onnx": (".onnx", "the law as an ONNX model"),
    "matlab": (".mat", "the law's matrices, for MATLAB, Simulink and python-control,"),
}
"""Exports of laws made of matrices: the ending of the file, and what it holds."""


def add(commands: common.Commands) -> None:
    """The command `export`."""
    export = common.command(
        commands,
        "export",
        _export,
        help="export a run's law as .npz, C, a ROS 2 package, an FMU, ONNX or .mat, its rollouts as a "
        "data set, its learning curve",
        description="Write the law a = K_a U^T z + K_b s_r of a finished run for other programs: "
        "as .npz with K_a, K_b, U, s_r and the model, which `pdeloop train --model` also reads, or "
        "as a C99 function; the laws `feedforward`, `observer` and `neural` as a C99 function of the "
        "step, with a memory, or with a network; any other law's parameters as .npz; affine laws and "
        "observers also as a ROS 2 package of rclpy and NumPy, an FMU, an ONNX model or matrices for "
        "MATLAB; the rollouts of the training as a data set; and the cost after each step of it as "
        ".csv or as event files of TensorBoard.",
        example="pdeloop export runs/burgers-20260101-120000-1 --out law.c --ros2 src/my_law "
        "--fmu law.fmu --onnx law.onnx --matlab law.mat --minari burgers/rollouts-v0",
    )
    add_argument = export.add_argument
    add_argument("folder", type=common.a_path, metavar="RUN", help="folder of a finished run")
    add_argument(
        "--out", type=common.a_path, metavar="FILE", help="write the law to this .npz or .c"
    )
    add_argument(
        "--ros2",
        type=common.a_path,
        metavar="DIR",
        help="write the law as a ROS 2 package, with the name of this new folder, of rclpy and NumPy",
    )
    for name, (ending, what) in MODEL_FILES.items():
        add_argument(
            f"--{name}", type=common.a_path, metavar="FILE", help=f"write {what} to this {ending}"
        )
    add_argument(
        "--controller", choices=LAWS, help="the adapted law, or the first one (lqt) [adapted]"
    )
    add_argument("--seed", type=int, metavar="S", help="training seed of the law [the first]")
    add_argument(
        "--curve",
        type=common.a_path,
        metavar="FILE",
        help="write the curves of all seeds to this .csv",
    )
    add_argument(
        "--minari",
        metavar="NAME",
        help="make a data set of Minari of the rollouts, by this new name",
    )
    add_argument(
        "--parquet", type=common.a_path, metavar="FILE", help="write the rollouts to this .parquet"
    )
    add_argument(
        "--tensorboard",
        type=common.a_path,
        metavar="DIR",
        help="write the curves and the optimiser's other numbers to this new folder",
    )
    common.add_own_code(export)


def _export(options: argparse.Namespace) -> int:
    from pdeloop.export import curve_csv, law_of
    from pdeloop.messages.files import write_atomically, writing_to

    files = {"--out": (options.out, (".npz", ".c")), "--curve": (options.curve, (".csv",))}
    files["--parquet"] = options.parquet, (".parquet",)
    models = {name: getattr(options, name) for name in MODEL_FILES}
    files |= {f"--{name}": (path, (MODEL_FILES[name][0],)) for name, path in models.items()}
    of_laws = options.out, options.ros2, *models.values()
    of_runs = options.curve, options.tensorboard, options.minari, options.parquet
    if all(path is None for path in (*of_laws, *of_runs)):
        options.refuse(
            "expected --out FILE or another form for the law, --curve FILE or --tensorboard DIR for "
            "the curve, --minari NAME or --parquet FILE for the rollouts"
        )
    which = options.controller
    if options.law in LAWS:  # as --controller was called
        print("WARNING: --law of export is now called --controller", file=sys.stderr)
        which, options.law = which or options.law, None
    if all(path is None for path in of_laws) and not (which is None and options.seed is None):
        options.refuse("--controller and --seed choose a law: give --out FILE, or leave them out")
    for flag, (path, suffixes) in files.items():
        if path is not None and path.suffix.lower() not in suffixes:
            raise ParameterError(
                f"{flag} is {path}; expected a file that ends in {' or '.join(suffixes)}"
            )
    run = common.finished_run(options)
    contents = {}
    if options.ros2 is not None:
        from pdeloop.ros2_package import write_package

        write_package(run, options.ros2, which or LAWS[0], options.seed)
        print(f"written to {options.ros2}")
    if options.out is not None:
        law = law_of(run, which or LAWS[0], options.seed)
        contents[options.out] = law.c() if options.out.suffix.lower() == ".c" else law.npz()
        if run.result.get("controller", {}).get("law") == "not seen":
            print("WARNING: the run's controller was not seen to use this law", file=sys.stderr)
    for name, path in models.items():
        if path is not None:
            contents[path] = _model_file(name, run, which or LAWS[0], options.seed)
    if options.curve is not None:
        contents[options.curve] = curve_csv(run)
    if options.parquet is not None:
        from pdeloop.data_sets import parquet

        contents[options.parquet] = parquet(run)
    for path, content in contents.items():
        with writing_to(path, ParameterError):
            write_atomically(path, content)
        print(f"written to {path}")
    if options.minari is not None:
        from pdeloop.data_sets import write_minari

        write_minari(run, options.minari)
        print(f"written to Minari's data set {options.minari}")
    if options.tensorboard is not None:
        from pdeloop.tensorboard import write_events

        write_events(run, options.tensorboard)
        print(f"written to {options.tensorboard}")
    return 0


def _model_file(name: str, run: FinishedRun, which: str, seed: int | None) -> bytes:
    from pdeloop import model_files
    from pdeloop.export import law_of
    from pdeloop.law_form import law_form

    law = law_form(run, which, seed)
    if name == "fmu":
        return model_files.fmu(law, law_of(run, which, seed).c())
    if name == "onnx":
        return model_files.onnx(law)
    law.require_matrices()
    print(f"spectral radius of the closed loop on the identified model: {law.spectral_radius:.4g}")
    return model_files.matlab(law)
