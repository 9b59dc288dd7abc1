# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant that another program serves, line by line in JSON on its standard input and output.

    it says first    {"n_z": 2, "n_a": 1, "sample_time": 0.1, ...}     attributes of `Dynamics`
    {"reset": seed}  {"z": [0.5, 1.0]}                                  the beginning of an episode
    {"step": [a]}    {"z": [0.4, 1.1]}                                  a sample later

The same seed and actions must give the same bits. A program that ends, or is late, is started again,
and the episode so far repeated, once in each episode.
"""

from __future__ import annotations

import hashlib
import json
import os
import selectors
import shlex
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from weakref import finalize

import numpy as np

from pde_sim_node.dynamics import Dynamics, arguments_of
from pdeloop.messages.arrays import Array
from pdeloop.messages.documents import parse_json
from pdeloop.messages.own_code import PROCESS, absolute_words
from pdeloop.messages.text import shown

START = 60.0
"""Seconds, at least, in which a program has to declare its plant."""
DECLARED = (
    "n_z",
    "n_a",
    "target",
    "horizon",
    "sample_time",
    "state_weight",
    "action_weight",
    "action_target",
    "action_low",
    "action_high",
    "action_rate",
    "zero_mean",
    "divergence_bound",
)
"""Attributes of a plant that a program may declare."""
_declarations: dict[tuple[str, str], Mapping[str, Any]] = {}
"""By command, and the content of its files."""


class ServiceError(RuntimeError):
    """A program that ends, is late, or answers something else."""


def from_process(command: str | Sequence[str], *, timeout: float = 60.0) -> Process:
    """A plant that a program serves in JSON lines; see docs/bring-your-own.md.

    Parameters
    ----------
    command
        The program and its arguments: "julia rod.jl", or a list of words.
    timeout
        Time (s) that an answer may take.

    Returns
    -------
    Process

    Raises
    ------
    ValueError
        The program cannot be started, or does not say its sizes in time.

    Examples
    --------
    >>> import pdeloop
    >>> rod = pdeloop.from_process("./rod")  # doctest: +SKIP
    """
    words = command if isinstance(command, str) else shlex.join(command)
    named = {} if timeout == 60.0 else {"timeout": float(timeout)}
    return Process(absolute_words(words, Path.cwd()), **named)


class Process(Dynamics):
    """A program in the loop; see `from_process`."""

    stateful = True

    def __init__(self, command: str, timeout: float = 60.0) -> None:
        self._command, self._timeout = command, timeout
        key = command, _digest(command)
        if key not in _declarations:
            service = Service(command, timeout)
            _declarations[key] = service.declaration
            service.close()
        self._identity = {**_declarations[key], "content": key[1]}
        for name, value in _declarations[key].items():
            setattr(self, name, value)
        self._service: Service | None = None
        self._episode: list[dict[str, Any]] = []
        self._repeated = False

    def identity(self) -> Mapping[str, Any]:
        """Its arguments, what the program declares, and the content of its files."""
        return {**arguments_of(self), **self._identity, "command": ""}

    def initial_state(self, rng: np.random.Generator) -> Array:
        """What the program answers to a seed."""
        self._episode, self._repeated = [], False
        return self._asked({"reset": int(rng.integers(2**53))})

    def step(self, z: Array, a: Array) -> Array:
        """What it answers to an action."""
        return self._asked({"step": a.tolist()})

    def _asked(self, request: dict[str, Any]) -> Array:
        self._episode.append(request)
        try:
            self._service = self._service or Service(self._command, self._timeout)
            return self._service.state(request)
        except ServiceError:
            if self._service is not None:
                self._service.close()
            self._service = None
            if self._repeated:
                raise
        self._repeated = True
        self._service = Service(self._command, self._timeout)
        return [self._service.state(earlier) for earlier in self._episode][-1]


class Service:
    """A running program. ServiceError or ValueError for what it does wrong."""

    def __init__(self, command: str, timeout: float) -> None:
        self._command, self._timeout, self._buffer = command, timeout, b""
        try:
            self._process = subprocess.Popen(
                shlex.split(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
        except (OSError, ValueError) as error:
            raise ValueError(f"the program {shown(command)} cannot be started: {error}") from error
        self.close: Any = finalize(self, _end, self._process)
        try:
            self.declaration = self._declared(self._line(max(timeout, START)))
        except (ServiceError, ValueError):
            self.close()
            raise

    def state(self, request: Mapping[str, Any]) -> Array:
        """The state that answers a request."""
        try:
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()
        except OSError:
            raise ServiceError(self._ended()) from None
        answer, n_z = self._line(self._timeout), self.declaration["n_z"]
        numbers = np.array(_numbers(answer.get("z")))
        if numbers.shape != (n_z,):
            told = answer.get("error") or f"got {shown(json.dumps(answer))}"
            raise ValueError(
                f'the program {shown(self._command)} must answer {{"z": [...]}} with {n_z} numbers; '
                f"{told}"
            )
        return numbers

    def _declared(self, line: Mapping[str, Any]) -> Mapping[str, Any]:
        unknown = [name for name in line if name not in DECLARED]
        missing = [name for name in ("n_z", "n_a") if name not in line]
        if unknown or missing:
            told = f"unknown is {unknown[0]!r}" if unknown else f"{missing[0]!r} is missing"
            raise ValueError(
                f"the program {shown(self._command)} must first declare its plant, with names of "
                f"{', '.join(DECLARED)}; {told}"
            )
        return {name: float("nan") if value is None else value for name, value in line.items()}

    def _line(self, patience: float) -> dict[str, Any]:
        """The next line; ServiceError where it does not come."""
        deadline = time.monotonic() + patience
        output = self._process.stdout
        assert output is not None
        with selectors.DefaultSelector() as selector:
            selector.register(output, selectors.EVENT_READ)
            while b"\n" not in self._buffer:
                left = deadline - time.monotonic()
                if left <= 0 or not selector.select(left):
                    raise ServiceError(
                        f"the program {shown(self._command)} has not answered for {patience:g} s"
                    )
                read = os.read(output.fileno(), 2**20)
                if not read:
                    raise ServiceError(self._ended())
                self._buffer += read
        line, _, self._buffer = self._buffer.partition(b"\n")
        try:
            found = parse_json(line.decode())
        except ValueError as error:
            raise ValueError(
                f"the program {shown(self._command)} wrote {shown(line.decode(errors='replace'))}; "
                "expected one JSON object a line, and everything else on standard error"
            ) from error
        if not isinstance(found, dict):
            raise ValueError(
                f"the program {shown(self._command)} wrote {shown(found)}; expected {{...}}"
            )
        return found

    def _ended(self) -> str:
        code = self._process.wait()
        return f"the program {shown(self._command)} has ended, with exit code {code}"


def maker(name: str) -> Callable[..., Process]:
    """What makes the plant of a name that begins with `process:`."""
    return partial(Process, name.removeprefix(PROCESS))


def _numbers(values: Any) -> Any:
    """A list of numbers, of which null stands for NaN."""
    if not isinstance(values, list) or not all(
        item is None or (isinstance(item, int | float) and not isinstance(item, bool))
        for item in values
    ):
        return []
    return [np.nan if item is None else float(item) for item in values]


def _digest(command: str) -> str:
    """A digest of the files among the words of a command."""
    files = [Path(word) for word in shlex.split(command) if Path(word).is_file()]
    return hashlib.sha256(b"\0".join(path.read_bytes() for path in files)).hexdigest()


def _end(process: subprocess.Popen[bytes]) -> None:
    """Close its input, which ends a program that reads it, and kill one that stays."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            try:
                pipe.close()
            except OSError:
                continue
    try:
        process.wait(0.5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
