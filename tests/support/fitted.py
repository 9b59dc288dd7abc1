# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models that are selected by the errors on whole rollouts alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pdeloop.method.models import FittedModel, Measured, Selection


def fit_field_model(
    rollouts: Sequence[Measured], target: np.ndarray, *, first: str = "", **given: Any
) -> FittedModel | None:
    """The model of `Selection.fit`."""
    return Selection(target=target, **given).fit(rollouts, first=first)
