# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Which optimiser a name stands for, what it declares, and its settings as parameters."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from pdeloop.messages.spec import ParameterError
from pdeloop.method.adapt import ModelBased, Optimizer, TwoPoint
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS, optimizer_kind
from pdeloop.method.settings import Settings, setting
from tests.support.small import parameters, same_bits, train_here
from tuner_node.optimizer_parameters import training_parameters

FOREIGN = """
from pdeloop.method.adapt.two_point import TwoPoint

class Halved(TwoPoint):
    name = "halved"
    preferences = {"identification": "field"}

    def tell(self, results):
        return super().tell(results) | {"halved": True}

class Whole(TwoPoint):
    name = "whole"

class Partial:
    name = "partial"

NUMBER = 3
"""


def offer(folder: Path, package: str, *entries: str) -> None:
    """What an installation of a package leaves: its metadata, with entry points."""
    about = folder / f"{package}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("\n".join(["[pdeloop.optimizers]", *entries]))


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "foreign.py").write_text(FOREIGN)
    monkeypatch.syspath_prepend(str(tmp_path))
    entries = "halved = foreign:Halved", "two_point = foreign:Whole", "partial = foreign:Partial"
    offer(tmp_path, "first", *entries, "lost = foreign:Lost", "number = foreign:NUMBER")
    yield tmp_path
    sys.modules.pop("foreign", None)


def test_ours_are_offered_as_those_of_others_are() -> None:
    assert optimizer_kind("model_based") is ModelBased
    assert optimizer_kind("two_point") is TwoPoint


def test_an_installed_package_offers_its_optimisers_by_name(installed: Path) -> None:
    assert optimizer_kind("halved").name == "halved"
    assert optimizer_kind("two_point") is TwoPoint, "no package takes a name of ours"
    assert {"halved", "two_point", "model_based"} <= set(OWN_OPTIMIZERS.offered())
    offer(installed, "second", "halved = foreign:Whole")
    with pytest.raises(ValueError, match="'halved' is offered by several installed packages"):
        optimizer_kind("halved")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "adam",
            "unknown optimizer 'adam': give one of model_based, two_point, halved, .*",
        ),
        ("gauss_newton", "'gauss_newton' was removed: use model_based, or two_point"),
        ("lost", "'lost': foreign:Lost cannot be loaded: .*Lost"),
        ("number", "'number': 3 must be a class"),
        ("partial", "'partial': Partial does not define ask, tell, .*needs_trajectories"),
    ],
)
def test_what_is_no_optimiser_is_refused_in_a_sentence(installed: Path, name, words) -> None:
    with pytest.raises(ValueError, match=words) as refused:
        optimizer_kind(name)
    assert "\n" not in str(refused.value)


def test_one_of_another_package_trains_with_what_it_declares(installed: Path) -> None:
    """It is TwoPoint by another name, and comes to the same policy."""
    own = train_here(parameters(optimizer="halved", iterations=3))
    assert all(row["halved"] for row in own.history)
    ours = train_here(parameters(optimizer="two_point", iterations=3))
    assert same_bits(own.policies(), ours.policies())
    assert training_parameters("burgers", {"optimizer": "halved"})["identification"] == "field"


def test_settings_know_their_ranges() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Own(Settings):
        step: float = setting(0.1, "length of a step", 1e-6, 10.0, unit="m")
        norm: str = setting("l2", "norm of a step", choices=("l1", "l2"))

    assert Own(step=2) == Own(step=2.0)
    for wrong, words in (({"step": 11.0}, "from 1e-06 to 10 \\(m\\)"), ({"norm": "l3"}, "l1, l2")):
        with pytest.raises(ParameterError, match=words):
            Own(**wrong)
    assert [spec.name for spec in Own.specs()] == ["step", "norm"]
    assert Optimizer.Settings.specs() == ()
