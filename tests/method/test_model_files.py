# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models of the field come back from their arrays, or not at all: compiled code looks at no length."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.models import FieldModel
from pdeloop.method.models.base import FORMS, MAX_SUBSTEPS, model_of
from pdeloop.method.models.finite_difference import (
    features_of,
    neighbour_features,
    of_features,
)
from pdeloop.method.models.linear import LinearModel, ProjectedModel, ReadingsModel
from pdeloop.method.models.polynomial import PolynomialModel
from pdeloop.method.models.sensed import (
    Actuators,
    SensedModel,
    grid_points,
    unknowns,
)
from pdeloop.method.models.spectral import SpectralModel

N_Z, N_A = 8, 2
RNG = np.random.default_rng(0)


def numbers(*shape: int) -> np.ndarray:
    return RNG.standard_normal(shape)


def spectral(n_z: int) -> dict[str, object]:
    modes = n_z // 2 + 1
    return {
        "kind": "k",
        "linear": numbers(modes) + 0j,
        "multipliers": numbers(2, modes) + 0j,
        "polynomials": numbers(2, 1),
        "B": numbers(n_z, N_A),
        "constant": numbers(n_z),
        "substeps": 4,
        "fewer": np.array([[1.0, 2.0]]),
    }


SENSORS = 4
MODELS: dict[str, FieldModel] = {
    "spectral": SpectralModel(**spectral(N_Z)),  # type: ignore[arg-type]
    "finite-difference": of_features(
        "k",
        features_of(1),
        numbers(len(features_of(1)), 1, N_Z),
        numbers(N_Z, N_A),
        numbers(N_Z),
        4,
    ),
    "projected": ProjectedModel(
        of_features(
            "k",
            features_of(1, axes=2),
            numbers(len(features_of(1, axes=2)), 1, N_Z),
            numbers(N_Z, N_A),
            numbers(N_Z),
            4,
            (2, N_Z // 2),
        ),
        numbers(N_Z, 2 * N_Z),
        numbers(2 * N_Z, N_Z),
    ),
    "linear": LinearModel("k", numbers(N_Z, N_Z), numbers(N_Z, N_A), numbers(N_Z)),
    "polynomial": PolynomialModel(
        "k",
        numbers(N_Z, 3),
        numbers(N_Z),
        numbers(N_A),
        np.linspace(0.5, 1.0, N_A),
        np.array([[0, 0], [0, 3]]),
        numbers(1 + 3 + N_A + 2, N_Z),
    ),
    "readings": ReadingsModel(
        "k",
        numbers(3, 3),
        numbers(3, N_A),
        numbers(3),
        numbers(2, 3),
        numbers(3, 2),
        numbers(N_Z, 2),
        innovations=np.eye(2),
    ),
    "sensed": SensedModel(
        **spectral(grid_points(SENSORS)),  # type: ignore[arg-type]
        shared=numbers(unknowns(N_A)),
        actuators=Actuators(numbers(N_A), np.linspace(0.1, 0.2, N_A)),
        sensors=SENSORS,
    ),
}


NEIGHBOURS = "neighbours"
MODELS[NEIGHBOURS] = of_features(
    "k",
    neighbour_features(1),
    numbers(len(neighbour_features(1)), 1, N_Z),
    numbers(N_Z, N_A),
    numbers(N_Z),
    4,
)


SHIFTS = np.isin(np.arange(8), range(4, 7)).astype(np.int64)
"""Where a table has the shifts of factors."""


@pytest.mark.parametrize("form", [*FORMS, NEIGHBOURS])
def test_a_model_comes_back_from_its_arrays(form: str) -> None:
    arrays = MODELS[form].arrays()
    again = model_of(arrays).arrays()
    assert again.keys() == arrays.keys()
    assert all(np.array_equal(again[name], arrays[name]) for name in arrays)


def test_a_model_has_no_actuators_of_negative_width() -> None:
    with pytest.raises(ValueError, match=r"width -0\.1"):
        model_of({**MODELS["sensed"].arrays(), "widths": np.full(N_A, -0.1)})


@pytest.mark.parametrize("form", [*FORMS, NEIGHBOURS])
def test_arrays_that_do_not_fit_together_are_no_model(form: str) -> None:
    arrays = MODELS[form].arrays()
    # Axes that nothing else tells the length of; the sensed model has a centre for each actuator.
    free = {"fewer": 0, "polynomials": 1, "U": 0, "V": 0, "inner.B": 1}
    free |= {} if form == "sensed" else {"B": 1}
    for name, array in arrays.items():
        for axis in range(array.ndim):
            if free.get(name) != axis:
                with pytest.raises(ValueError):
                    model_of(arrays | {name: np.concatenate([array, array], axis=axis)})
        if array.dtype.kind in "fc":
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
        (NEIGHBOURS, "table", MODELS[NEIGHBOURS].arrays()["table"] + N_Z * SHIFTS),
        ("sensed", "sensors", np.array(-1)),
        ("sensed", "sensors", np.array(SENSORS + 1)),
        ("linear", "form", np.array("quantum")),
    ],
)
def test_numbers_that_no_model_has_are_refused(form: str, name: str, value: np.ndarray) -> None:
    with pytest.raises(ValueError):
        model_of(MODELS[form].arrays() | {name: value})
