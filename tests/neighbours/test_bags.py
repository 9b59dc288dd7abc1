# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Bags in a reader whose container and whose messages are both read by code of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.neighbours.test_models import needs
from tests.recorder.test_readers_of_others import (
    Row,
    agree,
    empty_arrays,
    few_sensors,
    row,
    two_pairs,
)
from tests.support.recorded_here import record_run


def training(folder: Path) -> Path:
    record_run(folder / "run")
    return folder / "run" / "bag"


def by_small_mcap(bag: Path) -> list[Row]:
    from mcap_ros2_support_fast.decoder import DecoderFactory
    from small_mcap import read_message_decoded

    with (bag / "bag.mcap").open("rb") as file:
        return [
            row(found.message.log_time, found.channel.topic, found.decoded_message)
            for found in read_message_decoded(file, decoder_factories=[DecoderFactory()])
            if found.schema.name == "std_msgs/msg/Float64MultiArray"
        ]


@needs("mcap_ros2_support_fast", "mcap-ros2-support-fast")
@pytest.mark.parametrize("kind", [training, few_sensors, two_pairs, empty_arrays])
def test_small_mcap_reads_the_same_numbers_in_the_same_order(
    kind: Callable[[Path], Path], tmp_path: Path
) -> None:
    assert agree(kind(tmp_path), by_small_mcap)
