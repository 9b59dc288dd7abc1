# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The example of a cell of PyBaMM: physics, the same bits, limits, and a law that is trained on it."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pdeloop

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pybamm") is None, reason="PyBaMM is not installed: extra battery"
)
EXAMPLE = Path(__file__).parents[2] / "examples" / "plants" / "cell_pybamm.py"


@pytest.fixture(scope="module")
def module(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("PYBAMM_DISABLE_TELEMETRY", "true")
        spec = importlib.util.spec_from_file_location("cell_pybamm", EXAMPLE)
        assert spec is not None and spec.loader is not None
        made = importlib.util.module_from_spec(spec)
        patched.setitem(sys.modules, "cell_pybamm", made)
        spec.loader.exec_module(made)
        yield made


def charged(plant: Any, actions: Any, seed: int = 0) -> Any:
    z = [plant.initial_state(np.random.default_rng(seed))]
    for a in actions:
        z.append(plant.step(z[-1], np.asarray(a)))
    return np.array(z)


@pytest.mark.parametrize("chemistry", ["Chen2020", "Marquis2019", "Ecker2015"])
def test_charge_is_conserved_and_an_episode_has_the_same_bits(module: Any, chemistry: str) -> None:
    plant, currents = module.Cell(chemistry), [1.0, 0.5, 0.0, 1.5]
    z = charged(plant, [(c, 1.0) for c in currents])
    np.testing.assert_allclose(np.diff(z[:, 0]), np.array(currents) / 60.0, atol=1e-6)
    assert np.array_equal(charged(plant, [(c, 1.0) for c in currents]), z)
    assert (z[:, 3:] == 0.0).all() or chemistry == "Chen2020"


def test_cooling_cools_and_limits_are_exceeded_by_what_they_say(module: Any) -> None:
    plant = module.Cell(warmest=5.0)
    warm, cool = (charged(plant, [(3.0, h)] * 12) for h in (0.5, 5.0))
    assert (cool[1:, 1] < warm[1:, 1]).all()
    np.testing.assert_allclose(warm[:, 3], np.maximum(warm[:, 1] - 0.5, 0.0), atol=1e-12)
    highest = 4.2 - 3.5
    np.testing.assert_allclose(warm[:, 4], np.maximum(warm[:, 2] - highest, 0.0), atol=1e-12)
    assert (warm[:, 3] > 0.0).any() and (warm[:, 4] > 0.0).any()


def test_another_chemistry_is_refused(module: Any) -> None:
    with pytest.raises(
        ValueError, match="'Lead'; expected one of Chen2020, Marquis2019, Ecker2015"
    ):
        module.Cell("Lead")


def test_a_law_charges_it(module: Any, tmp_path: Path) -> None:
    """By measured rollouts: no linear model of 60 samples knows limits that act on one side."""
    run = pdeloop.train(plant=module.Cell(), evaluation_fields=2, out=tmp_path / "run")
    none, first, adapted = (run.costs[name].mean() for name in ("none", "lqt", "adapted"))
    assert adapted < 0.1 * none and adapted < first < none
