# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Inputs that could be taken for something else are refused where they are given, in one sentence."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import pdeloop
from pdeloop.messages.arrays import float_array
from pdeloop.messages.documents import parse_yaml
from pdeloop.messages.parameters import table
from pdeloop.messages.spec import ParameterError, Spec

NUMBERS = [spec for spec in table() if spec.type is float]


@pytest.mark.parametrize("spec", NUMBERS, ids=lambda spec: spec.name)
def test_a_number_that_no_file_gives_back_is_refused(spec: Spec) -> None:
    """A subnormal one is a text to YAML readers; 0 and the least normal number are numbers."""
    for number in (1e-310, -5e-324):
        with pytest.raises(ParameterError, match=f"'{spec.name}' is .*; expected"):
            spec.check(number)
    if not spec.minimum:
        assert spec.check(sys.float_info.min) == sys.float_info.min


def test_a_key_that_stands_twice_in_a_map_is_refused_with_its_line() -> None:
    assert parse_yaml("a: {b: 1}\nc: {b: 2}") == {"a": {"b": 1}, "c": {"b": 2}}
    for text in ("a: 1\nb: 2\na: 3", "x:\n  a: 1\n  a: 1\n"):
        with pytest.raises(ValueError, match=r"'a' stands twice in one map; .*, in line 3"):
            parse_yaml(text)


def test_masked_entries_are_no_numbers() -> None:
    values = np.ma.masked_array([1.0, 2.0], mask=[False, True])
    with pytest.raises(ValueError, match="states has masked entries, which have no value"):
        float_array("states", values)
    whole = np.ma.masked_array([1.0, 2.0], mask=[False, False])
    assert float_array("states", whole).tolist() == [1.0, 2.0]


def test_a_name_that_is_nearly_one_of_ours_is_asked_about() -> None:
    with pytest.raises(ParameterError, match="unknown problem 'burger'; did you mean 'burgers'"):
        pdeloop.problem("burger")
    with pytest.raises(ParameterError, match="unknown problem 'rocket'; expected one of"):
        pdeloop.problem("rocket")


def test_the_interface_is_what_dir_shows() -> None:
    assert set(dir(pdeloop)) == {*pdeloop.__all__, "__version__"}
    assert pdeloop.__version__[0].isdigit()
