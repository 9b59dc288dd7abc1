# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A training from the matrices of a model: its law for the plant's target, in a file of the run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from controller_node.identification import DesignSettings
from controller_node.policy import ProjectedLaw
from pde_sim_node.plant import Plant
from pdeloop.messages.array_files import packed_arrays, read_arrays
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows, pack
from pdeloop.messages.spec import ParameterError
from pdeloop.method.design import lqt
from pdeloop.method.laws.registry import law_kind
from pdeloop.method.reduce.reduced_model import ReducedModel

FILE = "model.npz"
"""In the folder of a run that was given the matrices of a model."""


def file_of_gains(model: object) -> str:
    """The path of a file that has gains besides the model; empty if that is no such file.

    ValueError if it is a file that cannot be read.
    """
    if not isinstance(model, str | Path) or not str(model):
        return ""
    arrays = read_arrays(Path(model))
    return "" if "model" not in arrays and {"A", "B"} <= {*arrays} else str(model)


def with_gains(model: object, plant: Plant, values: Mapping[str, Any]) -> bytes:
    """A model with its LQ-tracking gains, as `pdeloop identify --out` writes it.

    model (ReducedModel, state-space system or path): see `ReducedModel.of` and `ReducedModel.load`;
    plant: for its target and what it measures; values: the parameters of the training, for the cost and
    the sampling time. ParameterError if it is not a model of this plant, or the law needs more than A
    and B. DesignError if it has no stabilising gains.
    """
    known = (
        ReducedModel.load(model)
        if isinstance(model, str | Path)
        else ReducedModel.of(model, values["sample_time"])
    )
    settings = DesignSettings.of(values)
    if known.n_z != plant.state_size or known.n_a != plant.n_a:
        few = known.C is not None and len(known.C) == plant.state_size
        why = (
            "; its outputs do not determine its state, for which a law needs a filter: identify one "
            "with --identification subspace"
            if few
            else "; give U with a row for each number of the state"
            if known.n_a == plant.n_a
            else ""
        )
        raise ParameterError(
            f"the model is of a state of {known.n_z} numbers and {known.n_a} inputs, but the plant has "
            f"{plant.state_size} and {plant.n_a}{why}"
        )
    if law_kind(settings.law, settings.constants).filtered:
        raise ParameterError(
            f"the law '{settings.law}' uses a filter gain, which A and B alone do not have: take the "
            "law affine or feedforward, or a model of 'pdeloop identify --identification subspace'"
        )
    gains = lqt.track(
        known,
        state_weight=settings.state_weight,
        action_weight=settings.action_weight,
        cost=Cost.parse(settings.measured_cost),
    )
    s_r = ProjectedLaw([known.U], plant.target).reduced_targets[0]
    try:
        K_a, K_b = np.hsplit(gains.policy_for(s_r), 2)
    except ValueError as error:
        raise ParameterError(str(error)) from error
    rows = ModelRows(known.A, known.B, known.U, K_a, K_b, s_r)
    arrays: dict[str, Any] = {"sample_time": np.array(values["sample_time"])}
    return packed_arrays(arrays | {"model": pack(rows)[np.newaxis], "d": known.d, **rows.arrays})
