# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""User code: what a name stands for, and which code may be run.

A name is one of the project, an entry point of an installed package, ``package.module:Name``,
``path/to/file.py:Name``, or a file of another kind that holds code, like an FMU. All but the first two
are code, which is executed to get it. So a name that a problem's file gives is not enough: the user
has to name the same code, on the command line, in Python or in an environment variable, which the
processes that are started inherit.
"""

from __future__ import annotations

import copyreg
import hashlib
import importlib
import os
import shlex
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from pdeloop.messages.long_calls import LONG_CALLS
from pdeloop.messages.text import shown

FMU = ".fmu"
"""Ending of a Functional Mock-up Unit, whose name is code as a whole."""
PROCESS = "process:"
"""Beginning of a name that is a command, of a program that serves a plant."""
_handed_over: dict[tuple[str, str], type] = {}
"""Classes of this program, by the kind of code and the names that stand for them."""
_executing: list[Path] = []
"""The files that are being executed, the innermost last."""


class OwnCodeError(RuntimeError):
    """Code of a user's own that fails in use; one sentence, which names the code and the reason."""


@dataclass(frozen=True)
class OwnCode:
    """One kind of code that users may bring.

    word: what it is, and the parameter and the flag that name it: equation; variable: the environment
    variable with the names of code that may be run, separated by commas; shipped: what comes with the
    project, by name; no package takes these names; files: by the ending, or the beginning, of names
    that are code as a whole, what loads one.
    """

    word: str
    variable: str
    shipped: Mapping[str, Any]
    files: Mapping[str, Callable[[str], Any]] = field(default_factory=dict)

    @property
    def group(self) -> str:
        """The group of entry points by which an installed package offers it."""
        return f"pdeloop.{self.word}s"

    def allow(self, name: str) -> str:
        """Allow code for this process and those it starts; its name from any folder."""
        whole = ":".join(filter(None, identity(name)))
        before = os.environ.get(self.variable)
        os.environ[self.variable] = f"{before},{whole}" if before else whole
        return whole

    def take(self, code: object) -> str:
        """The name of code that a program gives, by name or as a class, which is thereby allowed.

        ValueError if it is neither.
        """
        if isinstance(code, str):
            return self.allow(code)
        if not isinstance(code, type):
            raise ValueError(
                f"{self.word} is {shown(code)}; expected a class, or a name like 'file.py:Class'"
            )
        name = next((own for own, kind in self.shipped.items() if kind is code), None)
        if name is None:
            name = self.allow(name_of(code))
            _handed_over[self.word, name] = code
        return name

    def configured(self, name: str, environment: Mapping[str, str] = os.environ) -> Any:
        """Load the code that a problem's parameters name, if it may be run.

        ValueError if the name is code that is not allowed; or see `load`.
        """
        self.require(name, environment)
        return self.load(name)

    def require(self, name: str, environment: Mapping[str, str] = os.environ) -> None:
        """A ValueError if the name is code that is not allowed."""
        allowed = {identity(item.strip()) for item in environment.get(self.variable, "").split(",")}
        code = ":" in name or self.whole(name) is not None
        if code and identity(name) not in allowed:
            quoted = shlex.quote(name)
            raise ValueError(
                f"the {self.word} {shown(name)} is code, which is not run merely because a file "
                f"names it; if you trust it, name it yourself: --{self.word} {quoted}, or for "
                f"nodes and workers {self.variable}={quoted} in the environment"
            )

    def offered(self) -> list[str]:
        """The names of what is installed, ours first."""
        from importlib.metadata import entry_points  # a tenth of a short command's time

        others = {entry.name for entry in entry_points(group=self.group)} - set(self.shipped)
        return [*self.shipped, *sorted(others)]

    def complete(
        self, name: str, found: object, base: type = object, members: Sequence[str] = ()
    ) -> type:
        """What was found, if it is a class of this base that defines all of it; else ValueError."""
        kind, api = getattr(found, "__name__", repr(found)), f"pdeloop.{self.word.capitalize()}"
        if not (isinstance(found, type) and issubclass(found, base)):
            derived = "" if base is object else f" derived from {api}"
            raise ValueError(f"{self.word} {name!r}: {kind} must be a class{derived}")
        missing = [own for own in members if not hasattr(found, own)]
        missing += sorted(getattr(found, "__abstractmethods__", ()))
        if missing:
            what = ", ".join(missing)
            raise ValueError(f"{self.word} {name!r}: {kind} does not define {what}; see {api}")
        return found

    def load(self, name: str) -> Any:
        """The object that a name stands for. This executes code, whatever its origin.

        ValueError if nothing of that name can be loaded.
        """
        if name in self.shipped:
            return self.shipped[name]
        if (self.word, name) in _handed_over:
            return _handed_over[self.word, name]
        if (load := self.whole(name)) is not None:
            return load(name)
        source, separator, name_in_it = name.rpartition(":")
        if not separator:
            return self._load_entry_point(name)
        module = self._load_file(source) if source.endswith(".py") else self._load_module(source)
        found = getattr(module, name_in_it, None)
        if found is None:
            raise ValueError(
                f"{self.word} {shown(name)}: there is no {shown(name_in_it)} in {source}"
            )
        return found

    def whole(self, name: str) -> Callable[[str], Any] | None:
        """What loads a name that is code as a whole."""
        for end, load in self.files.items():
            if name.endswith(end) or name.startswith(end):
                return load
        return None

    def _load_entry_point(self, name: str) -> Any:
        from importlib.metadata import entry_points  # a tenth of a short command's time

        found = {entry.value: entry for entry in entry_points(group=self.group, name=name)}
        if not found and name.endswith(".py"):
            whole = shown(f"{name}:ClassName")
            raise ValueError(
                f"{self.word} {shown(name)} is a file; name the class in it as well, as {whole}"
            )
        if not found:
            known = self.offered()
            one_of = f"one of {', '.join(known)}, or " if known else ""
            raise ValueError(
                f"unknown {self.word} {shown(name)}: give {one_of}"
                "'package.module:ClassName', or 'path/to/file.py:ClassName'"
            )
        if len(found) > 1:
            raise ValueError(
                f"{self.word} {shown(name)} is offered by several installed packages "
                f"({', '.join(found)}): remove one, or give 'package.module:ClassName'"
            )
        (entry,) = found.values()
        try:
            return entry.load()
        except FAILURES as error:
            raise ValueError(
                f"{self.word} {shown(name)}: {entry.value} cannot be loaded: {error}"
            ) from error

    def _load_module(self, dotted: str) -> ModuleType:
        try:
            return importlib.import_module(dotted)
        except FAILURES as error:
            raise ValueError(
                f"the {self.word} module {shown(dotted)} cannot be imported: {error}"
            ) from error

    def _load_file(self, path: str) -> ModuleType:
        try:
            return load_file(Path(path), self.word)
        except FileNotFoundError:
            raise ValueError(f"the {self.word} file {shown(path)} does not exist") from None


def identity(name: str) -> tuple[str, str]:
    """Module or file, and the name in it: equal for equal code."""
    if name.startswith(PROCESS):
        return PROCESS + absolute_words(name.removeprefix(PROCESS), Path.cwd()), ""
    if name.endswith(FMU):
        return str(Path(name).resolve()), ""
    module, _, name_in_it = name.rpartition(":")
    return (str(Path(module).resolve()) if module.endswith(".py") else module), name_in_it


def absolute_words(command: str, folder: Path) -> str:
    """A command whose words that are files in a folder have whole paths; ValueError for a bad one."""
    if "," in command:
        raise ValueError(f"the command {shown(command)} must have no comma: put it into a script")
    words = shlex.split(command)
    return shlex.join(str(folder / word) if (folder / word).is_file() else word for word in words)


def name_of(kind: type) -> str:
    """The name by which another process can load a class of this one, from its module or file."""
    module = sys.modules.get(kind.__module__)
    if module is None:  # executed without being registered, as by importlib's module_from_spec
        raise ValueError(
            f"the class {kind.__qualname__} is from the module {shown(kind.__module__)}, which is "
            f"not in sys.modules; give its name instead, 'path/to/file.py:{kind.__qualname__}'"
        )
    importable = bool(getattr(module, "__package__", "")) and module.__name__ != "__main__"
    file = getattr(module, "__file__", None)
    source = module.__name__ if importable or not file else file
    return f"{source}:{kind.__qualname__}"


_SHIPPED = ("pdeloop", "pde_sim_node", "tuner_node", "controller_node")
FAILURES = Exception, SystemExit
"""Exceptions that count as a failure of the user's own code, calls of exit among them."""


def called(name: str, function: Callable[..., Any], *given: Any, module: str = "") -> Any:
    """The result of a call of user code; a long call is reported while it runs.

    name: as the sentence has it, Class.method; module: see `located`.
    OwnCodeError if it fails; one sentence with the line.
    """
    try:
        if (getattr(function, "__module__", None) or "").partition(".")[0] in _SHIPPED:
            return function(*given)  # known not to take long
        with LONG_CALLS.during(name):
            return function(*given)
    except FAILURES as error:
        raise OwnCodeError(f"{name} fails: {located(error, module)}") from error


def located(error: BaseException, module: str = "") -> str:
    """An exception in one line, with the last line that ran in one file.

    It is that of the module, or the file that the `try` block called where that did not run.
    """
    frames = [
        (frame.f_globals.get("__name__"), frame.f_code.co_filename, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
    ][1:]
    if not frames:
        return in_one_line(error)
    own = [(file, line) for name, file, line in frames if name == module]
    file, line = own[-1] if own else [f for f in frames if f[1] == frames[0][1]][-1][1:]
    return f"{file}, line {line}: {in_one_line(error)}"


def in_one_line(error: BaseException) -> str:
    """Kind and text of an exception."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def load_file(path: Path, word: str) -> ModuleType:
    """Execute a file as a module, once for each content: an edited file is a new module.

    FileNotFoundError, or ValueError if it cannot be executed.
    """
    if not path.is_file():
        raise FileNotFoundError(path)
    path, source = path.resolve(), path.read_bytes()
    # Numba keys its cache by the module's name: a name made of path and content is the same in the
    # next process, and another one after an edit.
    digest = hashlib.sha256(str(path).encode() + b"\0" + source).hexdigest()[:16]
    module = ModuleType(f"{word}_{path.stem}_{digest}")
    if module.__name__ in sys.modules:
        return sys.modules[module.__name__]
    module.__file__ = str(path)
    sys.modules[module.__name__] = module
    try:
        with _being_executed(path):
            exec(compile(source, path, "exec"), vars(module))
    except FAILURES as error:
        del sys.modules[module.__name__]
        remedy = ""
        if isinstance(error, ModuleNotFoundError):
            remedy = f"; install what it imports for the Python that runs pdeloop, {sys.executable}"
        raise ValueError(
            f"the {word} file {shown(str(path))} cannot be executed: {error}{remedy}"
        ) from error
    for kind in vars(module).values():
        own = isinstance(kind, type) and kind.__module__ == module.__name__
        if own and kind.__reduce_ex__ is object.__reduce_ex__:
            copyreg.pickle(kind, _reduced)  # by its file: no other process can import the module
    return module


def refuse_while_executed(what: str) -> None:
    """RuntimeError if a file of user code, being executed for a name that it defines, does `what`.

    A program that trains its own plant over topics would otherwise start itself again in each node.
    """
    if _executing:
        raise RuntimeError(
            f"{_executing[-1]} {what} while it is being imported; put that below `if __name__ == "
            "'__main__':`"
        )


@contextmanager
def _being_executed(path: Path) -> Iterator[None]:
    """Meanwhile it finds modules next to it, after all installed ones, which they cannot hide."""
    _executing.append(path)
    finder = _Beside(str(path.parent))
    sys.meta_path.append(finder)
    try:
        yield
    finally:
        _executing.pop()
        sys.meta_path.remove(finder)


class _Beside(MetaPathFinder):
    """Finds modules in a folder once no other finder has, those of editable packages among them.

    At the end of `sys.path` the folder would come before those: one that holds a checkout has a
    folder `pdeloop`, which Python takes for a package without content.
    """

    def __init__(self, folder: str) -> None:
        self._folder = folder

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return PathFinder.find_spec(name, [self._folder]) if path is None else None


def _reduced(thing: Any) -> tuple[Any, ...]:
    """Pickle support for objects whose class came from a file, by another constructor."""
    reduced: Any = object.__reduce_ex__(thing, 2)
    _, (kind, *arguments), *rest = reduced
    module = sys.modules[kind.__module__]
    word = module.__name__.partition("_")[0]
    return (
        _bare,
        (str(module.__file__), word, module.__name__, kind.__qualname__, *arguments),
        *rest,
    )


def _bare(file: str, word: str, module: str, name: str, *arguments: Any) -> Any:
    """The unpickled object without its state; ValueError if its file is another one by now."""
    try:
        found = load_file(Path(file), word)
    except FileNotFoundError:
        raise ValueError(f"the {word} file {shown(file)} does not exist") from None
    if found.__name__ != module:
        raise ValueError(
            f"the {word} file {shown(file)} has changed since the plant was pickled: make the "
            "plant again"
        )
    kind: Callable[..., Any] = vars(found)[name]
    return kind.__new__(kind, *arguments)  # type: ignore[arg-type]
