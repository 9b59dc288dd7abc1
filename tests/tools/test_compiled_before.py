# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What a training calls is compiled before it begins."""

from __future__ import annotations

from typing import Any

import pytest

from pdeloop.solver import polynomial_step
from pdeloop.training_run import load_compiled, resolve
from tests.support.small import SMALL


@pytest.mark.parametrize(
    ("options", "loaded"),
    [
        ({"optimizer": "model_based"}, True),
        ({"optimizer": "two_point", "identification": "field"}, True),
        ({"optimizer": "two_point"}, False),
        ({"optimizer": "model_based", "sensors": 8}, False),
    ],
)
def test_what_the_fits_of_a_training_call_is_compiled_before_it(
    options: dict[str, Any], loaded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[None] = []
    monkeypatch.setattr(polynomial_step, "load_compiled", lambda: calls.append(None))
    values = resolve(str(SMALL), options)
    load_compiled(values)
    assert not calls
    load_compiled(values, fits=True)
    assert bool(calls) == loaded
