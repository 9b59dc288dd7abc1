# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""docs/reference/settings.md has every constant that can be set."""

from __future__ import annotations

from pdeloop.messages.spec import (
    FIELD_MODEL_SETTINGS,
    IDENTIFICATION_SETTINGS,
    OPTIMIZER_SETTINGS,
)
from pdeloop.method.adapt import ModelBased, TwoPoint
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from pdeloop.method.models import FieldModelSettings
from pdeloop.method.reduce.reduced_model import IdentificationSettings
from tests.support.interpreter import ROOT

OPTIMIZERS = (ModelBased, TwoPoint)


def test_the_tables_of_settings_are_those_of_the_classes() -> None:
    """One table for each method on one page, with every constant that can be set."""
    assert {kind.name for kind in OPTIMIZERS} == set(OWN_OPTIMIZERS.shipped)
    tables = [
        (f"`{IDENTIFICATION_SETTINGS}NAME`", IdentificationSettings),
        (f"`{FIELD_MODEL_SETTINGS}NAME`", FieldModelSettings),
        *((f"`{OPTIMIZER_SETTINGS}NAME` of `{kind.name}`", kind.Settings) for kind in OPTIMIZERS),
    ]
    tables = [(title, kind) for title, kind in tables if kind.specs()]
    text = (ROOT / "docs" / "reference" / "settings.md").read_text()
    documented = {}
    for section in text.split("\n## ")[1:]:
        rows = [
            [cell.strip(" `") for cell in line.split("|")[1:-1]] for line in section.splitlines()
        ]
        if settings := [tuple(row) for row in rows if len(row) == 4][2:]:
            documented[section.splitlines()[0]] = settings
    assert documented == {
        title: [
            (
                spec.name,
                str(spec.default),
                spec.range.partition("from ")[2],
                spec.description,
            )
            for spec in kind.specs()
        ]
        for title, kind in tables
    }
