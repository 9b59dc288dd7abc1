# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models of the field come back from their arrays, or not at all: compiled code looks at no length."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.models.base import FORMS, MAX_SUBSTEPS, model_of
from pdeloop.method.models.finite_difference import features_of
from tests.support.field_models import MODELS

NEIGHBOURS = "neighbours"
SHIFTS = np.isin(np.arange(8), range(4, 7)).astype(np.int64)
"""Where a table has the shifts of factors."""


def test_a_model_has_no_actuators_of_negative_width() -> None:
    with pytest.raises(ValueError, match=r"width -0\.1"):
        model_of({**MODELS["sensed"]().arrays(), "widths": np.full(3, -0.1)})


@pytest.mark.parametrize("form", [*FORMS, NEIGHBOURS])
def test_arrays_that_do_not_fit_together_are_no_model(form: str) -> None:
    arrays = MODELS[form]().arrays()
    # Axes that nothing else tells the length of; the sensed model has a centre for each actuator, and
    # 64 points are also the grid of 16 sensors.
    free = {"fewer": 0, "polynomials": 1, "U": 0, "V": 0, "inner.B": 1, "places": 0}
    free |= {} if form == "sensed" else {"B": 1}
    for name, array in arrays.items():
        for axis in range(array.ndim):
            if free.get(name) != axis:
                with pytest.raises(ValueError):
                    model_of(arrays | {name: np.concatenate([array, array], axis=axis)})
        if array.size and array.dtype.kind in "fc":
            with pytest.raises(ValueError):
                model_of(arrays | {name: np.full_like(array, np.nan)})
        with pytest.raises(ValueError):
            model_of(arrays | {name: np.zeros((2,) * (array.ndim + 1), array.dtype)})


@pytest.mark.parametrize(
    ("form", "name", "value"),
    [
        ("spectral", "substeps", np.array(0)),
        ("spectral", "substeps", np.array(MAX_SUBSTEPS + 1)),
        ("spectral", "fewer", np.array([[1.0, 5.0]])),
        ("spectral", "fewer", np.array([[1.0, 0.0]])),
        ("finite-difference", "substeps", np.array(2**62)),
        ("finite-difference", "table", np.full((len(features_of(1)), 8), 9)),
        ("finite-difference", "table", np.full((len(features_of(1)), 8), -9)),
        (NEIGHBOURS, "table", MODELS[NEIGHBOURS]().arrays()["table"] + 7 * SHIFTS),
        *(("projected", "inner.axes", np.array(n)) for n in ((6, 9), (48,), (-6, -8), (6, 0))),
        ("polynomial", "products", np.array([[0, 99]])),
        ("polynomial", "action_scale", np.zeros(2)),
        ("polynomial", "coefficients", np.zeros((2, 8))),
        ("sensed", "coefficients", np.zeros((3, 2, 64))),
        ("sensed", "places", np.zeros(0)),
        ("sensed", "places", np.zeros(9)),
        ("linear", "form", np.array("quantum")),
    ],
)
def test_numbers_that_no_model_has_are_refused(form: str, name: str, value: np.ndarray) -> None:
    with pytest.raises(ValueError):
        model_of(MODELS[form]().arrays() | {name: value})
