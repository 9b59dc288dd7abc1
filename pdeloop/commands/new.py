# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop new NAME`: a folder with a working PDE or plant, as a template."""

from __future__ import annotations

import argparse
import builtins
import re
from importlib.util import find_spec
from keyword import iskeyword
from pathlib import Path
from shutil import rmtree
from string import Template

from pdeloop.commands.common import Commands, command
from pdeloop.messages.files import FileError, write_atomically
from pdeloop.messages.problem import shipped_problems
from pdeloop.messages.spec import ParameterError

_NAME = re.compile(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*")

_TEMPLATES = Path(__file__).parent / "template"


def write(name: str, into: Path, *, plant: bool = False) -> tuple[list[Path], str]:
    """Write class, YAML and test of a PDE into a new folder; the files, and what --equation names.

    plant: of a plant instead, which --plant names.

    name: of the problem and its folder, lower-case letters, digits, '-' and '_'; into: where the
    folder goes. ParameterError for another name, one that a shipped problem, Python, pytest or the
    class's own file uses, and a folder that exists.
    """
    if len(name) > 60 or not _NAME.fullmatch(name):
        raise ParameterError(
            f"'{name[:80]}' cannot be the name of a problem; expected lower-case letters, digits, "
            "'-' and '_', beginning with a letter, such as my-pde"
        )
    module = name.replace("-", "_")
    words = module.split("_")
    kind = "".join(word.capitalize() for word in words)
    _refuse_taken(name, module, kind, plant=plant)
    filled = {"name": name, "module": module, "kind": kind, "title": " ".join(words).capitalize()}
    folder = into / name
    try:
        folder.mkdir()
    except FileExistsError:
        raise ParameterError(f"{folder} already exists; choose another name") from None
    own = ("plant.py", "plant.yaml", "test_plant.py")
    templates = own if plant else ("equation.py", "problem.yaml", "test.py")
    names = (f"{module}.py", f"{name}.yaml", f"test_{module}.py")
    files = {file: f"{template}.txt" for file, template in zip(names, templates, strict=True)}
    try:
        for file, template in files.items():
            text = Template((_TEMPLATES / template).read_text()).substitute(filled)
            write_atomically(folder / file, text.encode())
    except OSError as error:
        rmtree(folder, ignore_errors=True)
        raise FileError(f"cannot write to {folder}: {error.strerror}") from error
    return [folder / file for file in files], f"{folder / module}.py:{kind}"


def _refuse_taken(name: str, module: str, kind: str, *, plant: bool) -> None:
    """ParameterError if a problem or plant, its module or its class cannot have this name."""
    another = "; choose another name"
    if plant:
        from pde_sim_node.plants.loading import PLANTS

        if name in PLANTS:
            raise ParameterError(f"'{name}' is a shipped plant{another}")
    if module in {problem.replace("-", "_") for problem in shipped_problems()}:
        raise ParameterError(f"'{name}' is a shipped problem{another}")
    known = find_spec(module)  # a folder without code does not count
    if iskeyword(module) or (known is not None and known.origin is not None):
        raise ParameterError(f"Python already has '{module}'{another}")
    if iskeyword(kind) or hasattr(builtins, kind):
        raise ParameterError(f"its class would be '{kind}', which Python already has{another}")
    imports = re.findall(r"import (.+)", (_TEMPLATES / "equation.py.txt").read_text())
    if kind in ", ".join(imports).split(", "):
        raise ParameterError(f"its class would be '{kind}', which its own file imports{another}")
    if module == "conftest" or module.startswith("test_"):
        raise ParameterError(f"pytest would take {module}.py for a file of its own{another}")


def add(commands: Commands) -> None:
    """The command `new`."""
    new = command(
        commands,
        "new",
        _new,
        help="write a template for a PDE or plant of your own: class, YAML file and test",
        description="Write a folder with the class, YAML file and test of a working PDE, or of any "
        "other plant, as a template for your own (docs/bring-your-own.md).",
        example="pdeloop new my-pde",
    )
    new.add_argument("name", metavar="NAME", help="name of the problem and of its new folder")
    new.add_argument(
        "--plant",
        action="store_true",
        help="a plant, with any solver, instead of a periodic spectral PDE",
    )


def _new(options: argparse.Namespace) -> int:
    files, named = write(options.name, Path(), plant=options.plant)
    flag = "--plant" if options.plant else "--equation"
    for file in files:
        print(file)
    print(f"next: pdeloop check {files[1]} {flag} {named} --picture {options.name}.png")
    print(f"      pdeloop train {files[1]} {flag} {named}")
    return 0
