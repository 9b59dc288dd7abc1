# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What a model's signature depends on: all that a controller designs its law from."""

from __future__ import annotations

import struct
from dataclasses import asdict
from hashlib import blake2b

import pytest

from controller_node.identification import DesignSettings
from pdeloop.messages.grid import Axis, Grid
from pdeloop.messages.protocol import DESIGN, design_digest, digest_of

N_A, N_S = 4, 3


@pytest.mark.parametrize("name", DESIGN)
def test_a_model_that_is_identified_otherwise_has_another_signature(name):
    known = asdict(DesignSettings(N_A, N_S, 1.0, 1.0))
    other = "dmdc" if name == "identification" else known[name] + 1
    assert design_digest(known | {name: other}) != design_digest(known)
    # An action has the first of these, D the second, the next count where they are not empty or 0, and
    # the last two with another law than the affine one.
    own = {
        "n_a",
        "input_delay",
        "action_set",
        "measurement_noise",
        "grid",
        "cost",
        "constants",
        "law",
        "horizon",
        "sensors",
        "sensor_delays",
    }
    assert {*DESIGN, *own} == {*known}
    assert design_digest(known | {"cost": ["another"]}) != design_digest(known | {"cost": []})


def test_sensors_count_where_a_cost_is_seen_through_them():
    known = asdict(DesignSettings(N_A, N_S, 1.0, 1.0))
    for cost, count in ((["one"], 3), ([], 1)):
        own = [
            known | {"cost": cost, "sensors": n, "sensor_delays": d}
            for n, d in ((0, 1), (3, 1), (3, 2))
        ]
        assert len({design_digest(values) for values in own}) == count


def test_a_digest_is_the_first_53_bits_of_blake2b_as_a_stand_in_computes_it():
    raw = struct.pack("<3d", 1.0, -2.5, 3.0)
    first = int.from_bytes(blake2b(raw, digest_size=8).digest(), "big") // 2**11
    assert digest_of([1.0, -2.5], 3.0) == first < 2**53


def test_the_noise_counts_where_a_model_is_fitted_for_it():
    known = asdict(DesignSettings(N_A, N_S, 1.0, 1.0))
    field = known | {"identification": "field"}
    digests = {design_digest(field | {"measurement_noise": noise}) for noise in (0.0, 0.1, 0.2)}
    assert len(digests) == 3
    assert design_digest(known | {"measurement_noise": 0.1}) == design_digest(known)


def test_the_axes_count_where_there_are_several_and_a_field_on_them_is_fitted():
    known = asdict(DesignSettings(N_A, N_S, 1.0, 1.0))
    plates = [Grid((Axis("y", 1.0, 4), Axis("x", 1.0, n))).text for n in (6, 8)]
    for identification, count in (("field", 3), ("regression", 1)):
        own = known | {"identification": identification}
        grids = ("", Grid((Axis("x", 2.0, 24),)).text, Grid.vector(3).text, *plates)
        assert len({design_digest(own | {"grid": grid}) for grid in grids}) == count


@pytest.mark.parametrize("name", ["identification_settings.energy", "law_settings.gain"])
def test_a_model_that_is_identified_with_other_constants_has_another_signature(name):
    known = asdict(DesignSettings(N_A, N_S, 1.0, 1.0))
    digests = {design_digest(known | {"constants": {name: value}}) for value in (0.25, 0.5)}
    assert len(digests | {design_digest(known)}) == 3
    values = {n: v for n, v in known.items() if n != "constants"}  # as the tuner has them
    assert design_digest(values | {name: 0.25, "run": 7}) in digests


def test_constants_of_field_models_count_where_a_law_is_designed_from_one():
    known = asdict(DesignSettings(N_A, N_S, 1.0, 1.0))
    for identification, count in (("field", 2), ("regression", 1)):
        own = known | {"identification": identification}
        constants = ({"field_model_settings.folds": folds} for folds in (2, 3))
        assert len({design_digest(own | {"constants": given}) for given in constants}) == count


def test_a_model_for_another_law_has_another_signature_and_the_affine_one_that_without_a_name():
    known = asdict(DesignSettings(N_A, N_S, 1.0, 1.0))
    nameless = {name: value for name, value in known.items() if name not in ("law", "horizon")}
    own = [
        design_digest(known | {"law": law, "horizon": T})
        for law, T in (("own.py:A", 3), ("own.py:A", 4), ("own.py:B", 3), ("feedforward", 3))
    ]
    assert design_digest(known | {"horizon": 3}) == design_digest(nameless)
    assert len({design_digest(nameless), *own}) == 5
    assert design_digest(known | {"law": "/elsewhere/own.py:A", "horizon": 3}) == own[0]
