# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An equation of the user's own: its solution, its compilation, its flaws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pde_sim_node.equations import OWN_EQUATIONS
from tests.support.interpreter import python
from tests.support.spectral_plants import FISHER, FISHER_GRID, make, unforced


def test_an_equation_of_the_users_own(tmp_path: Path) -> None:
    """u' = r u (1 - s u): u(t) = 1 / (s + (1/u0 - s) exp(-r t)); an edit of s must not go unnoticed."""
    path = tmp_path / "fisher.py"
    for strength in (1.0, 2.0):
        path.write_text(FISHER.replace("1.0", str(strength), 1))
        z = unforced(make(OWN_EQUATIONS.load(f"{path}:Fisher")(), **FISHER_GRID), 1)
        exact = 1 / (strength + (10 - strength) * np.exp(-1.0))
        np.testing.assert_allclose(z, exact, atol=1e-8)


def test_a_users_equation_is_compiled_once_for_all_processes(tmp_path: Path) -> None:
    path = tmp_path / "fisher.py"
    program = (
        "import sys; from pde_sim_node.equations import OWN_EQUATIONS;"
        "from pdeloop.solver.pointwise import pointwise_loop;"
        "pointwise_loop(OWN_EQUATIONS.load(sys.argv[1]).nonlinearity)"
    )

    def compiles() -> bool:
        cache = tmp_path / "cache"
        before = set(cache.rglob("*.nbc"))
        python("-c", program, f"{path}:Fisher", NUMBA_CACHE_DIR=str(cache))
        return set(cache.rglob("*.nbc")) != before

    path.write_text(FISHER)
    assert [compiles(), compiles()] == [True, False]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("return STRENGTH * u**2", "return open(u)", r"Numba .*flawed.py, line \d+: .*open"),
        (
            "return STRENGTH * u**2",
            "return np.linalg.qq(u)",
            r"Numba .*flawed.py, line 22: Attr.* 'qq'",
        ),
        (
            "nonlinearity(u)",
            "nonlinearity(self, u)",
            r"function u -> g\(u\) .*flawed.py, line 20: Type",
        ),
        ("np.full_like(k, -self.rate)", "-self.rate", "multiplier of the equation must return"),
        (
            "np.full_like(k, -self.rate)",
            "np.full_like(k, np.nan)",
            "17 finite .* got NaN or infinity$",
        ),
        ("np.full_like(k, -self.rate)", "k[:3]", r"got shape \(3,\)$"),
        (
            "np.full_like(k, -self.rate)",
            "k[99]",
            r"multiplier .* fails: .*flawed.py, line 18: Index",
        ),
        ("self.rate - 0.01 * k**2", "k / 0 * 1j", "linear_operator of the equation must return"),
        ("self.rate - 0.01 * k**2", "1e6 + k", "growth rate"),
        ("np.ones_like(x)", "np.ones(3)", "target of the equation must return"),
        ("np.ones_like(x)", "x @ 'a'", r"target of the equation fails: .*flawed.py, line 28: UF"),
        (
            "def target(self, x)",
            "def supports(self, *_): ...\n    def target(self, x)",
            "supports of the",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:(divide|invalid):RuntimeWarning")
def test_a_flawed_equation_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "flawed.py"
    assert old in FISHER
    path.write_text(FISHER.replace(old, new))
    with pytest.raises(ValueError, match=words) as refused:
        make(OWN_EQUATIONS.load(f"{path}:Fisher")(), **FISHER_GRID)
    assert "\n" not in str(refused.value)
