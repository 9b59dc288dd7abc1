# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop train`: one training, over topics or in this process, in a folder of its own."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import itertools
import os
import re
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import controller_node.law
from controller_node.identification import DesignSettings, check_sizes
from pde_sim_node.build import build_plant
from pde_sim_node.plant import Plant
from pdeloop.display import Display, ProgressFile
from pdeloop.domain import announced, own_domain
from pdeloop.exploration_scale import scale_remark
from pdeloop.given_model import FILE as GIVEN
from pdeloop.given_model import file_of_gains, with_gains
from pdeloop.in_process import LocalPair, train
from pdeloop.interruption import Interruption, interruptible
from pdeloop.jit.cache import is_on_disk
from pdeloop.messages.files import FileError, make_own_folder, write_atomically
from pdeloop.messages.frames import MAX_VALUES
from pdeloop.messages.own_code import OwnCodeError
from pdeloop.messages.parameters import EXECUTION, PLANT, PROBLEM, RECORDER, VIEWER, model_order
from pdeloop.messages.spec import ParameterError
from pdeloop.output import print_json
from pdeloop.pairs import LoopNode, Transport
from pdeloop.problem_values import problem_values
from pdeloop.process.module_path import safe_children
from pdeloop.process.start import die_with
from pdeloop.solver import polynomial, polynomial_step, polynomial_sweep
from pdeloop.supervisor import Child, NodeError, Supervisor, node_command
from tuner_node import narration
from tuner_node.batch import NoModelError
from tuner_node.build import build_training, remarks_on
from tuner_node.optimizer_parameters import kind_of
from tuner_node.run_folder import RunFolder, RunFolderError, resuming, timestamp
from tuner_node.run_store import RunWriter
from tuner_node.training import Training

POLL = 0.05
"""Seconds between two looks at the nodes."""
QUIET = 5.0
"""Seconds without news of the training after which it is said what the nodes wait for."""


def built_in(training: Training) -> dict[str, Any]:
    """The controller of a training in this process, as result.json has it."""
    return {"nodes": [], "law": training.settings.law.name}


def resolve(problem: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of a new run; ValueError if the problem's plant cannot be built from them.

    Nothing is compiled.
    """
    plant, values = problem_values(problem, options)
    kind = kind_of(values)
    if kind.needs_trajectories and not plant.quadratic:
        raise ParameterError(
            f"the optimizer '{values['optimizer']}' needs a quadratic cost about a target, which "
            "this plant does not have: choose one that needs only costs, such as two_point, or "
            "give a target"
        )
    if kind.needs_trajectories and not (plant.cost.plain or kind.any_cost):
        raise ParameterError(
            f"the optimizer '{values['optimizer']}' needs scalar weights and a constant target, "
            "unlike the cost of this plant: choose model_based or two_point"
        )
    if not values["model"]:
        check_sizes(DesignSettings.of(values), plant.state_size, plant.horizon)
    return values


def load_compiled(values: Mapping[str, Any], *, fits: bool = False) -> None:
    """Load or compile what a run with these parameters needs; ValueError where that is impossible.

    Compiled code is kept on disk, so that this is slow once only, and not for the nodes.

    fits: also what fits of field models call, as a compiler that knows the plant's FFT is faster.
    """
    notice = threading.Timer(4.0, print, ["compiling, once ..."], {"file": sys.stderr})
    notice.daemon = True
    notice.start()
    beside = None
    try:
        if fits and not is_on_disk(polynomial.advance):
            beside = _begin_compiling(polynomial_step.__name__)
        plant = build_plant(values)
        circles = fits and _fits_circles(values, plant)
        if beside and not circles:
            beside.kill()
        controller_node.law.load_compiled()
        if importlib.util.find_spec("pdeloop.fast_path"):
            compiled = ["pde_sim_node"] * (plant.parallel is not None)
            for node in ("controller_node", *compiled):
                importlib.import_module(f"{node}.fast_path").load_compiled()
        if circles:
            polynomial_sweep.load_compiled()
            if beside:
                beside.wait()
            polynomial_step.load_compiled()
    finally:
        notice.cancel()
        if beside:
            beside.kill()
            beside.wait()


def _begin_compiling(module: str) -> subprocess.Popen[bytes] | None:
    """A process that compiles what a module's `load_compiled` loads; None where there can be none.

    Numba compiles one function at a time in a process, and keeps each on disk.
    """
    words = "from {0} import load_compiled as l; from {1} import die_with as d; d({2}); l()"
    code = words.format(module, die_with.__module__, os.getpid())
    none = subprocess.DEVNULL
    with safe_children(), contextlib.suppress(OSError):
        return subprocess.Popen([sys.executable, "-c", code], stdin=none, stdout=none, stderr=none)
    return None


def _fits_circles(values: Mapping[str, Any], plant: Plant) -> bool:
    """Whether models of one field on a periodic axis are fitted, whose kinds are tried first."""
    whole = plant.grid.is_circle and len(plant.grid.components) == 1 and not values["sensors"]
    return whole and (kind_of(values).needs_trajectories or values["identification"] == "field")


def begin(
    problem: str, options: Mapping[str, Any], out: Path | None, transport: Transport | None = None
) -> tuple[Path, dict[str, Any]]:
    """Folder and parameters of a new training, of which nothing has been done yet.

    The option `model` may be the matrices of a model (`ReducedModel`), or a file of them: the folder
    then gets the model with the gains for the plant's target.

    Mistakes that show without a compiler are refused before anything is compiled, as are options that
    change nothing. transport: over topics, if not given. A plant may change the working directory.
    """
    here = Path.cwd()
    matrices = options.get("model", "")
    if not isinstance(matrices, str) or (matrices and not file_of_gains(matrices)):
        options = {**options, "model": GIVEN}
    else:
        matrices = ""
    values = resolve(problem, options)
    transport = transport or Transport()
    refuse_unused(options, values, in_process=transport.in_process, viewed=transport.view)
    folder = out or Path("runs") / f"{values['problem']}-{timestamp()}"
    content = b""
    if matrices != "":
        content = with_gains(matrices, build_plant(values, compiled=False), values)
        values["model"] = str(here / folder / GIVEN)
    with TemporaryDirectory() as temporary:
        # The run's folder is made after everything was looked at.
        own = {"model": str(Path(temporary) / GIVEN)} if content else {}
        if content:
            Path(own["model"]).write_bytes(content)
        training = build_training({**values, **own})
    if not transport.in_process:
        check_messages(values, training)
    folder = folder if Path.cwd() == here else here / folder
    RunFolder(folder).refuse_another()
    load_compiled(values, fits=True)
    RunFolder(folder).create(values)
    if content:
        write_atomically(folder / GIVEN, content)
    return folder, values


def check_messages(values: Mapping[str, Any], training: Training) -> None:
    """ParameterError where the models of an exploration are more than one message can hold."""
    order, together = model_order(values), training.settings.explorations
    numbers = together * values["n_z"] * order
    if numbers > MAX_VALUES:
        raise ParameterError(
            f"parameter 'reduced_order' is {order}: {together} models of a state of {values['n_z']} "
            f"numbers are {numbers} numbers, and a message holds at most {MAX_VALUES}; take a lower "
            "order, or train in one process: --in-process"
        )


def continuing(folder: Path, values: Mapping[str, Any], transport: Transport) -> str:
    """The command that continues a training as it was begun, with the code that its user has named."""
    words = transport.words
    for kind in ("equation", "plant", "optimizer", "law"):
        words += [f"--{kind}", shlex.quote(values[kind])] if ":" in values[kind] else []
    return " ".join([resuming(folder), *words])


def reopen(folder: Path) -> dict[str, Any]:
    """The parameters of the unfinished training in `folder`, which is no longer paused.

    RunFolderError if there is none.
    """
    run = RunFolder(folder)
    run.unfinished()
    values = run.values()
    try:
        with run.locked():
            if (folder / "result.json").exists():
                raise RunFolderError(
                    f"the run in {folder} is complete; there is nothing to continue"
                )
            run.change(paused=False)
    except FileError as error:
        raise RunFolderError(f"{folder}/run.json cannot be used: {error}") from error
    return values


def run(folder: Path, values: dict[str, Any], transport: Transport, as_json: bool = False) -> int:
    """Carry out the training in `folder`, from where it is; returns the exit code.

    as_json: the result alone on stdout, as JSON; progress goes to stderr.
    """
    stream = sys.stderr if as_json else sys.stdout
    display = Display(values["seed"], values["seeds"], stream)
    started, again = time.monotonic(), continuing(folder, values, transport)
    shown, folder = folder, folder.absolute()
    try:
        # Over topics every node that was started must be known, and every bag finished.
        with interruptible(again, at_once=transport.in_process) as check:
            carry_out(folder, values, transport, display, check, f"continue with: {again}")
    except Interruption:
        if not (folder / "result.json").exists():  # which is written last
            raise
    finally:
        display.close()
    summary = RunFolder(folder).result()
    if as_json:
        print_json({"folder": str(shown), **summary})
    else:
        for text in narration.closing_lines(values["problem"], summary, shown):
            display.line(text)
        display.line(f"  {time.monotonic() - started:.1f} s with start-up")
    for text in narration.warnings(summary):
        display.warn(text)
    return narration.exit_code(summary)


def carry_out(
    folder: Path,
    values: dict[str, Any],
    transport: Transport,
    display: Display,
    check: Callable[[], None],
    advice: str,
    *,
    kept: bool = True,
) -> None:
    """Train in `folder` to the end; `check`, called now and then, may raise to stop it.

    advice: how to go on after a failure; kept: whether the folder stays.
    """
    for remark in remarks_on(values):
        display.warn(remark)
    if told := scale_remark(values):
        display.line(told)
    if transport.in_process:
        _train_here(folder, values, display, check, advice, kept)
    else:
        _train_over_topics(folder, display, transport, check)


def _train_here(
    folder: Path,
    values: dict[str, Any],
    display: Display,
    check: Callable[[], None],
    advice: str,
    kept: bool,
) -> None:
    begun = False
    with RunFolder(folder).locked():
        training = build_training(values)
        writer = RunWriter(folder, values, training, warn=display.line)

        def report(row: Mapping[str, Any]) -> None:
            nonlocal begun
            begun |= row.get("event") != "phase"
            writer.note(row)
            writer.keep(now=time.monotonic())
            display.row(row)
            check()

        # Nothing is saved on the way out of an interruption: it may come in the middle of an update.
        try:
            train(training, LocalPair(values), report, max_batch=values["max_batch"])
        except NoModelError as error:
            writer.fail(str(error))
            raise
        except OwnCodeError as error:
            if not (kept or begun):  # nothing is lost
                raise
            raise OwnCodeError(f"{error} ({advice})") from error
        try:
            writer.finish({"transport": "in-process", "controller": built_in(training)})
        except OSError as error:
            raise RunFolderError(
                f"cannot write the results to {folder}: {error.strerror}; make room and {advice}"
            ) from error


def _train_over_topics(
    folder: Path, display: Display, transport: Transport, check: Callable[[], None]
) -> None:
    logs = folder / "logs"
    make_own_folder(logs)
    bags: list[Path] = []

    def command(node: LoopNode) -> list[str]:
        if node.package == "recorder_node":  # started again, it leaves the unfinished bag alone
            bags.append(unused(folder / "bag"))
            node = node.having(bag=str(bags[-1].resolve()))
        elif recorder is not None and recorder.ended:
            node = node.without_recorder()
        return node_command(node.package, *node.ros_arguments(folder / "parameters.yaml"))

    children = {
        node.name: Child(
            node.name,
            partial(command, node),
            logs / f"{node.name}.log",
            optional=node.package in ("recorder_node", "viewer_node"),
            cores=node.cores,
        )
        for node in transport.nodes(folder)
    }
    recorder = children.get("recorder_node")
    progress = ProgressFile(folder / "progress.jsonl")
    begun = False
    with own_domain() as domain, announced(domain, folder, network=transport.network):
        display.line(f"start (ROS_DOMAIN_ID={domain}{', on the network' * transport.network})")
        environment, remarks = transport.environment()
        for remark in remarks:
            display.line(f"  {remark}")
        if recorder is not None:
            from recorder_node.recording import large_bag  # here, as it needs the extra `record`

            if text := large_bag(RunFolder(folder).values(), transport.record_every):
                display.line(f"  {text}")
        waiting = Waiting(list(children.values()), display.line)
        supervisor = Supervisor(
            list(children.values()), "tuner_node", domain, logs, display.line, environment
        )
        try:
            done = False
            while not done:
                check()
                done = supervisor.poll()
                rows = progress.rows()
                waiting.look(time.monotonic(), bool(rows))
                for row in rows:
                    display.row(row)
                    begun |= row.get("event") != "phase"
                if recorder is not None and recorder.ended and not (done or begun):
                    raise NodeError(f"nothing can be recorded: {recorder.last_line()}")
                time.sleep(0 if done else POLL)
        except Interruption as signal_name:
            display.close()
            display.line(f"{signal_name}: stopping the nodes ...")
            raise
        finally:
            supervisor.stop()
    if supervisor.stopped:
        raise Interruption("request")
    if recorder is not None:
        names_of_bags = ", ".join(str(bag) for bag in bags)
        display.line(f"  recorded in {names_of_bags}" + ", not to the end" * recorder.ended)


class Waiting:
    """Says on the terminal what the nodes wait for, where nothing happens for some seconds."""

    def __init__(self, children: Sequence[Child], tell: Callable[[str], None]) -> None:
        self._children, self._tell = children, tell
        self._since = self._looked = time.monotonic()
        self._said = ""

    def look(self, now: float, happened: bool) -> None:
        """Look after the nodes; call it often. happened: whether the training has advanced since."""
        if happened:
            self._since, self._said = now, ""
        if now - self._since < QUIET or now - self._looked < 1.0:
            return
        self._looked = now
        warnings = [child.warning(time.time() - 2 * QUIET) for child in self._children]
        text = "; ".join(dict.fromkeys(filter(None, warnings)))
        words = re.sub(r"\d+", "", text)  # but for the seconds
        if words and words != self._said:
            self._said = words
            self._tell(f"  {text}")


def unused(path: Path) -> Path:
    """`path`, or the first of path-2, path-3, ... that does not exist."""
    numbered = (path.with_name(f"{path.name}-{n}") for n in itertools.count(2))
    # A dangling link counts as present.
    return next(p for p in itertools.chain([path], numbered) if not os.path.lexists(p))


OF_A_METHOD = {
    "learning_rate": ("optimizer", "two_point"),
    "learning_rate_from_zero": ("optimizer", "two_point"),
    "smoothing_radius": ("optimizer", "two_point"),
    "dmdc_rank": ("identification", "dmdc"),
    "dmdc_order": ("identification", "dmdc"),
}
"""Parameters of one method: which parameter chooses it, and by which word."""
OF_THE_COMMAND = ("out", "resume", "recorder", "pairs", "plant_fingerprint")
"""Parameters of the tuner that follow from where and how a training runs."""
OF_NODES = {*(spec.name for spec in (*PLANT, *EXECUTION)), "episode_timeout", "max_attempts"}
"""Parameters of processes and messages, which a training in this process does not have."""
ELSEWHERE = {spec.name for spec in (*RECORDER, *VIEWER)} - {spec.name for spec in PROBLEM}


def refuse_unused(
    given: Mapping[str, Any],
    values: Mapping[str, Any],
    *,
    in_process: bool = False,
    viewed: bool = False,
) -> None:
    """ParameterError for a parameter that was given for a training and has no effect on it.

    given: those that the user named, not those of a problem's file; values: all of them, resolved;
    viewed: whether a viewer runs as well.
    """
    for name in given:
        reason = _reason(name, values, in_process=in_process, viewed=viewed)
        if reason:
            raise ParameterError(f"parameter '{name}' has no effect here: {reason}")


def _reason(name: str, values: Mapping[str, Any], *, in_process: bool, viewed: bool) -> str:
    if name in OF_A_METHOD:
        chooser, word = OF_A_METHOD[name]
        if values[chooser] != word:
            return f"it applies to the {chooser} {word}, but this one is {values[chooser]}"
    if name == "sensor_delays" and not values["sensors"]:
        return "there are no sensors; give sensors as well"
    if name in OF_THE_COMMAND:
        return "it follows from how the training is started; see pdeloop train --help"
    if name in OF_NODES and in_process:
        return "it applies to nodes; train over topics, without --in-process"
    if name in ELSEWHERE and not (viewed and name.startswith("view_")):
        return "it belongs to a node that the training does not start" + (
            "; add --view" if name.startswith("view_") else ""
        )
    return ""
