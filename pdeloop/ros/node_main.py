# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The `main` of a node: its ROS context, its signals, its exit code."""

import contextlib
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args, try_shutdown

from pdeloop.messages.long_calls import LONG_CALLS
from pdeloop.messages.own_code import OwnCodeError
from pdeloop.messages.parameter_file import read_parameter_file
from pdeloop.messages.spec import ParameterError
from pdeloop.process.isolation import PROFILE, check_profile, is_confined, outside_sockets
from pdeloop.process.ros_environment import prepared, with_log_folder
from pdeloop.process.start import on_signals
from pdeloop.ros.node_loop import NodeLoop
from pdeloop.ros.observer import EventLoop
from pdeloop.ros.parameters import require_parameters, take_over
from pdeloop.ros.suspend_watchdog import SuspendWatchdog

CRASHED = 70
"""Exit code after a bug; 1 means that the node was asked for something it cannot do."""


class ConfigurationError(RuntimeError):
    """A node cannot start as it was asked to; the text is one sentence for the user."""


@contextlib.contextmanager
def ros_node(
    name: str, args: list[str] | None, make_loop: Callable[[Node], Any] = NodeLoop
) -> Iterator[tuple[Node, Any]]:
    """A node with its event loop, which SIGINT, SIGTERM and SIGHUP end; leaves nothing behind.

    make_loop: NodeLoop for a node of the loop, Observer for one that observes it.
    """
    signals: list[str] = []
    loop: Any = None

    def stop(name: str) -> None:
        signals.append(name)
        if loop is not None:
            loop.stop(name)

    on_signals(stop)
    with SuspendWatchdog() as watchdog:  # peers may forget it from here on
        try:
            prepare_process(name)
            check_profile()
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        except Exception as error:  # rcl raises bare RuntimeErrors and its own types
            raise ConfigurationError(_first_line(error)) from error
        node = None
        try:
            node = _make_node(name)
            loop = make_loop(node)
            if isinstance(loop, EventLoop):
                loop.watchdog = watchdog
            for name_of_signal in signals:  # before there was a loop
                loop.stop(name_of_signal)
            yield node, loop
        finally:
            if node is not None:
                node.destroy_node()
            try_shutdown()


def _make_node(name: str) -> Node:
    """A node; its process uses the loopback interface only, if it is to."""
    try:
        node = Node(name, start_parameter_services=True)
    except Exception as error:
        raise ConfigurationError(_first_line(error)) from error
    LONG_CALLS.tell = node.get_logger().warning  # type: ignore[method-assign]
    if is_confined() and (outside := outside_sockets()):
        node.destroy_node()
        raise ConfigurationError(
            f"the Fast DDS profile {os.environ[PROFILE]} did not take effect (UDP sockets at "
            f"{', '.join(outside)}); expected the loopback interface only, or PDELOOP_NETWORK=1"
        )
    return node


def prepare_process(name: str) -> None:
    """Make this process's environment one in which a node works; report what is removed from it.

    RosEnvironmentError where none does.
    """
    found, remarks = prepared(os.environ)
    found, more = with_log_folder(found)
    for variable in set(os.environ) - set(found):
        del os.environ[variable]
    os.environ.update(found)
    for remark in (*remarks, *more):
        print(f"{name}: {remark}", file=sys.stderr)


class NodeBody(Protocol):
    """The body of a node: made with its parameters and topics, then run."""

    def join(self, node: Node, loop: Any) -> None:
        """Wire the topics on another `node`, which has the parameters of the one before."""

    def run(self) -> int:
        """Work until the loop stops; returns the exit code, of no meaning if it was suspended."""


def node_main(
    name: str,
    args: list[str] | None,
    make: Callable[[Node, Any], NodeBody],
    make_loop: Callable[[Node], Any] = NodeLoop,
) -> int:
    """The `main` of a node: makes its body, runs it and returns the exit code.

    A process that was suspended for long joins again, as a new participant. 1 with one line on
    stderr when the node cannot start as it was asked to: a ConfigurationError,
    or a ValueError while it is made (a parameter out of range, a plant that cannot be built); and when
    code of the user's own fails.
    """
    try:
        files = [read_parameter_file(path) for path in parameter_files(args)]
        _reject_unknown_arguments(name, args)
        body: NodeBody | None = None
        former: Node | None = None
        while True:
            with ros_node(name, args, make_loop) as (node, loop):
                try:
                    if body is None or former is None:
                        require_parameters(node, files)
                        body = make(node, loop)
                    else:
                        take_over(node, former)
                        body.join(node, loop)
                        node.get_logger().warning("was suspended; joined the network again")
                except ValueError as error:
                    raise ConfigurationError(str(error)) from error
                code = body.run()
                if not loop.suspended:
                    return code
                former = node
    except (ConfigurationError, OwnCodeError, ParameterError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except Exception:  # a bug: say where, and let a supervisor start the node again
        traceback.print_exc()
        return CRASHED


def parameter_files(args: Sequence[str] | None) -> list[Path]:
    """The parameter files among the arguments of a node, None: of the process.

    >>> parameter_files(["--ros-args", "--params-file", "a.yaml", "--", "--params-file"])
    [PosixPath('a.yaml')]
    """
    words, found, of_ros = iter(sys.argv[1:] if args is None else args), [], False
    for word in words:
        of_ros = word == "--ros-args" or (of_ros and word != "--")
        if of_ros and word == "--params-file":
            found += [Path(file) for file in [next(words, "")] if file]
    return found


def _reject_unknown_arguments(name: str, args: list[str] | None) -> None:
    """Reject words that are not ROS arguments, which rclpy ignores silently; `--help` among them."""
    try:
        words = remove_ros_args(args)[1:] if args is None else remove_ros_args(args)
    except Exception as error:  # a parameter file that is not there, a rule that cannot be read
        raise ConfigurationError(_first_line(error)) from error
    if any(word in ("-h", "--help") for word in words):
        print(
            f"usage: {name} [--ros-args -p PARAMETER:=VALUE ... --params-file FILE -r __ns:=/NAME]"
            "\n\nParameters: docs/parameters.md; topics: docs/protocol.md;"
            " with ROS tools: ros2 param describe."
        )
        raise SystemExit(0)
    if words:
        raise ConfigurationError(
            f"unexpected argument '{words[0]}'; parameters are given as --ros-args -p NAME:=VALUE"
        )


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
