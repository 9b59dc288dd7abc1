# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model from the arrays that it was written as."""

from __future__ import annotations

from collections.abc import Callable

from loop_method.models.base import Arrays, FieldModel, text_of
from loop_method.models.coarse import CoarseModel
from loop_method.models.finite_difference import FiniteDifferenceModel
from loop_method.models.linear import LinearModel
from loop_method.models.low_rank import LowRankModel
from loop_method.models.polynomial import PolynomialModel
from loop_method.models.readings import ReadingsModel
from loop_method.models.sensed import SensedModel
from loop_method.models.spectral import SpectralModel

FORMS: dict[str, Callable[[Arrays], FieldModel]] = {
    "spectral": SpectralModel.from_arrays,
    "finite-difference": FiniteDifferenceModel.from_arrays,
    "coarse": CoarseModel.from_arrays,
    "linear": LinearModel.from_arrays,
    "low-rank": LowRankModel.from_arrays,
    "polynomial": PolynomialModel.from_arrays,
    "readings": ReadingsModel.from_arrays,
    "sensed": SensedModel.from_arrays,
}


def model_of(arrays: Arrays) -> FieldModel:
    """The model whose `arrays` these are, the same to the bit; ValueError for no such form."""
    form = text_of(arrays, "form")
    if form not in FORMS:
        raise ValueError(f"a field model is of the form {form!r}; expected one of {list(FORMS)}")
    return FORMS[form](arrays)
