"""A machine clock that jumps by days changes nothing: every wait uses the monotonic clock."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.loop_harness import Processes, until
from tests.small import SMALL
from tests.topics.test_loop import (
    LIMIT,
    assert_same_training,
    in_process,
    iterations_done,
    tuner_arguments,
)

pytestmark = pytest.mark.topics


def test_a_clock_that_jumps_forth_and_back_changes_nothing(loop: Processes, tmp_path: Path):
    found = list(Path("/usr/lib").glob("*/faketime/libfaketime.so.1"))
    assert found, "libfaketime is not installed; `make packages` installs Debian's faketime"
    library = found[0]
    offset = tmp_path / "offset"
    offset.write_text("+0d\n")
    loop.environment |= {
        "LD_PRELOAD": str(library),
        "FAKETIME_TIMESTAMP_FILE": str(offset),
        "FAKETIME_NO_CACHE": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        "FAKETIME_DONT_RESET": "1",
    }
    for name in ("pde_sim_node", "controller_node"):
        loop.node(name, "--params-file", str(SMALL))
    out = tmp_path / "run"
    tuner = loop.node(
        "tuner_node", "--params-file", str(SMALL), *tuner_arguments(out, iterations=150)
    )
    for count, jump in ((20, "+2d"), (60, "-3d"), (100, "+0d")):
        until(lambda n=count: iterations_done(out) >= n, LIMIT, f"iteration {count}")
        offset.write_text(f"{jump}\n")
    loop.wait(tuner, LIMIT)
    assert_same_training(out, in_process(iterations=150))
    times = [
        float(line.split('"time": ')[1].split(",")[0])
        for line in (out / "progress.jsonl").read_text().splitlines()
    ]
    assert max(times) - min(times) > 4 * 86400  # the processes did see the jumps
