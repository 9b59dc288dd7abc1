"""The command line `pdeloop`: its commands, and what becomes of their errors."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from bringup.commands import bag, bench, evaluate, monitor, problems, reproduce, secure, train

_EXTRAS = {"rosbags": "record", "mcap": "record", "matplotlib": "report", "aiohttp": "monitor"}
"""Modules that only some commands need, and the extra that installs them."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Console script. Every error a user can cause is one line on stderr and exit code 1 or 2."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        code: int = options.command(options)
        return code
    except (ValueError, RuntimeError) as error:
        # RunFolderError, CheckpointError, ParameterError, DomainError, NodeError and the plant's
        # and controller's refusals; anything else is a bug and shows its traceback.
        print(f"pdeloop: {error}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get((error.name or "").split(".")[0])
        if extra is None:
            raise
        print(f"pdeloop: needs {error.name}: pip install 'pdeloop[{extra}]'", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("pdeloop: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        print(f"pdeloop: {error.strerror or error}{where}", file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pdeloop",
        description="Reduce, design and adapt controllers of PDEs over ROS 2 topics.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in (train, evaluate, bag, monitor, reproduce, bench, secure, problems):
        module.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
