"""`pdeloop completion`: what makes a shell complete the commands, made by shtab from the parser."""

from __future__ import annotations

import argparse
from typing import Any

from loop_interfaces.problem import shipped_problems
from pdeloop.commands.common import Commands, command

SHELLS = ("bash", "zsh", "fish")


def add(commands: Commands) -> None:
    """The command `completion`."""
    completion = command(
        commands,
        "completion",
        _completion,
        help="print a completion script for bash, zsh or fish",
        description="Print a script that makes a shell complete pdeloop's commands, options, "
        "problems and files. For bash or zsh (after compinit), put the example into the shell's "
        "start-up file; for fish: pdeloop completion fish > "
        "~/.config/fish/completions/pdeloop.fish",
        example='eval "$(pdeloop completion bash)"',
    )
    completion.add_argument("shell", choices=SHELLS, help="the shell")


def _completion(options: argparse.Namespace) -> int:
    import shtab

    _say_what_follows(options.root, shtab)
    print(shtab.complete(options.root, shell=options.shell))
    return 0


def _say_what_follows(parser: argparse.ArgumentParser, shtab: Any) -> None:
    """Tell shtab, from the metavar of an argument, whether a file, folder or problem follows."""
    follows = {"DIR": shtab.DIRECTORY, "BAG": shtab.DIRECTORY, "FILE": shtab.FILE}
    follows |= {"PYTHON": shtab.FILE, "PROBLEM": _problems()}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for choice in action.choices.values():
                _say_what_follows(choice, shtab)
        elif action.metavar in follows:
            action.complete = follows[str(action.metavar)]  # type: ignore[attr-defined]


def _problems() -> dict[str, Any]:
    """A shipped problem, or a YAML file."""
    names = " ".join(shipped_problems())
    function = "_pdeloop_problem"
    bash = f"""
{function}() {{
  compgen -W "{names}" -- "$1"
  compgen -f -X '!*.yaml' -- "$1"
  compgen -d -- "$1"
}}
"""
    zsh = f"""
{function}() {{
  _alternative 'problems:problem:({names})' 'files:file:_files -g "*.yaml"'
}}
"""
    fish = f"""
function {function}
  printf '%s\\n' {names}
  __fish_complete_suffix .yaml
end
"""
    return {
        **{"bash": function, "zsh": function, "fish": f"({function})"},
        "preamble": {"bash": bash, "zsh": zsh, "fish": fish},
    }
