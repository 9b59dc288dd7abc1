# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Nodes with few descriptors and little shared memory: they train, or end with one sentence."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest

from tests.support.loop_harness import Processes
from tests.support.small import SMALL
from tests.support.small_loop import LIMIT, assert_same_training, in_process

pytestmark = pytest.mark.topics


WITH_LIMIT = """
import contextlib, resource, sys
from pdeloop.cli import main
from tests.support.mounts import own_mounts, run
kind, limit = int(sys.argv[1]), int(sys.argv[2])
with contextlib.suppress(OSError):  # only root can
    own_mounts()
    run("mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", "/dev/shm")
resource.setrlimit(kind, (limit, limit))  # which the nodes inherit
sys.argv = ["pdeloop", *sys.argv[3:]]
sys.exit(main())
"""


def train(loop: Processes, kind: int, limit: int, out: Path, code: int = 0) -> str:
    words = ("train", str(SMALL), "--iterations", "2", "--out", str(out))
    started = loop.start("-c", WITH_LIMIT, str(kind), str(limit), *words, name="limited")
    return loop.wait(started, LIMIT, code)


def test_thirty_two_descriptors_and_little_shared_memory_are_enough_for_every_node(
    loop: Processes, tmp_path: Path
) -> None:
    train(loop, resource.RLIMIT_NOFILE, 32, tmp_path / "run")
    assert_same_training(tmp_path / "run", in_process(iterations=2))


def test_a_node_without_a_descriptor_for_its_files_says_so(loop: Processes, tmp_path: Path) -> None:
    told = train(loop, resource.RLIMIT_NOFILE, 12, tmp_path / "run", code=1)
    assert told.strip().endswith("Too many open files") and "Traceback" not in told
