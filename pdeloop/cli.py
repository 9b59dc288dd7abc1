# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The command line `pdeloop`: its commands, and what becomes of their errors.

Exit codes: docs/command-line.md.
"""

from __future__ import annotations

import argparse
import importlib
import os
import shlex
import sys
import traceback
from collections.abc import Callable, Sequence

from pdeloop.interruption import Interruption
from pdeloop.output import complain, drop_unwritable
from pdeloop.process.start import STOPPED_BY_SIGNAL, begin, what_to_install

DONE, FAILED, CRASHED, INTERRUPTED, NOBODY_READS = 0, 1, 70, STOPPED_BY_SIGNAL, 141
"""Exit codes; 2, a command that is not understood, is argparse's."""
COMMANDS = (
    "train",
    "evaluate",
    "identify",
    "bag",
    "monitor",
    "reproduce",
    "report",
    "animate",
    "compare",
    "export",
    "study",
    "problems",
    "new",
    "check",
)
"""The modules of `pdeloop.commands`, in the order of the help."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Console script `pdeloop`."""
    if arguments is None:  # the process is this command's own
        begin("pdeloop")
    if "_ARGCOMPLETE" in os.environ:  # called by a shell, to complete a line
        import argcomplete

        argcomplete.autocomplete(parser())
    return run(parser, arguments)


def run(
    make_parser: Callable[[], argparse.ArgumentParser], arguments: Sequence[str] | None = None
) -> int:
    """Exit code of the command in `arguments`. Every error a user can cause is one line on stderr."""
    try:
        return _run(make_parser, arguments)
    finally:
        drop_unwritable()


def _run(
    make_parser: Callable[[], argparse.ArgumentParser], arguments: Sequence[str] | None
) -> int:
    try:
        parser = make_parser()
        options, unknown = parser.parse_known_args(arguments)
        if unknown:
            refuse = getattr(options, "refuse", parser.error)
            asked = getattr(options, "prog", parser.prog)
            refuse(f"unrecognized arguments: {shlex.join(unknown)}; see `{asked} --help`")
        code: int = options.command(options)
        sys.stdout.flush()  # here, where a missing reader can still be reported
        return code
    except (ValueError, RuntimeError) as error:
        # RunFolderError, FileError, ParameterError, DomainError, NodeError and the plant's
        # and controller's refusals.
        return _failed(_sentence(error))
    except ImportError as error:
        needed = what_to_install(error)
        return _crashed() if needed is None else _failed(needed)
    except (KeyboardInterrupt, Interruption) as reason:
        complain(f"stopped by {str(reason) or 'SIGINT'}")
        return INTERRUPTED
    except BrokenPipeError:
        return NOBODY_READS
    except MemoryError as error:
        return _failed(
            f"not enough memory{f' ({error})' if str(error) else ''}: use a smaller problem, or run "
            "fewer at once"
        )
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        return _failed(f"{error.strerror or error}{where}")
    except Exception:
        return _crashed()


def _sentence(error: Exception) -> str:
    """The text of an error; NumPy's errors of linear algebra name a routine, not the cause."""
    if type(error).__name__ != "LinAlgError":  # of NumPy, which not every command imports
        return str(error)
    return (
        "these numbers lead to a singular matrix, so there is no unique result: check the data "
        "for states or actions that are constant, equal or badly scaled, and the weights for "
        "extreme values"
    )


def _failed(text: str) -> int:
    complain(text)
    return FAILED


def _crashed() -> int:
    """A bug: the only case of a traceback."""
    traceback.print_exc()
    return CRASHED


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    root = argparse.ArgumentParser(
        prog="pdeloop",
        description="Identify, design and adapt controllers for PDEs, in one process or over ROS 2 "
        "topics.",
        epilog="example: pdeloop train burgers (every command has an example in its --help)",
    )
    root.add_argument(
        "--version",
        action=_Version,
        nargs=0,
        default=argparse.SUPPRESS,
        help="show program's version number and exit",
    )
    commands = root.add_subparsers(required=True, metavar="COMMAND")
    for name in COMMANDS:
        # Imported here, where `main` catches Ctrl-C: it takes most of a short command's time.
        importlib.import_module(f"pdeloop.commands.{name}").add(commands)
    return root


class _Version(argparse.Action):
    """Looks the version up when it is asked for; argparse's own action has to be given it."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print(f"pdeloop {_version()}")
        parser.exit()


def _version() -> str:
    from importlib import metadata

    try:
        return metadata.version("pdeloop")
    except metadata.PackageNotFoundError:  # run from its sources
        return "(not installed)"


if __name__ == "__main__":
    sys.exit(main())
