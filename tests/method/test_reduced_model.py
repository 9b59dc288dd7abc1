# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models that are given as matrices: coordinates, systems of other libraries, files, refusals."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy  # whose signal module loads when it is used
from scipy import linalg

from pdeloop.method.design.lqt import track
from pdeloop.method.reduce.reduced_model import ReducedModel

RNG = np.random.default_rng(1)
A = np.diag([0.9, 0.7, 0.5]) + 0.1 * RNG.standard_normal((3, 3))
B = RNG.standard_normal((3, 2))
D = np.array([0.3, -0.2, 0.1])
V = RNG.standard_normal((6, 3)) * [0.1, 1.0, 10.0]
"""A basis that is not orthonormal, in mixed units."""
ACTIONS = RNG.standard_normal((20, 2))


def along(z: np.ndarray) -> np.ndarray:
    """z_0 .. z_N of z = V s."""
    s, states = linalg.lstsq(V, z)[0], [V @ linalg.lstsq(V, z)[0]]
    for a in ACTIONS:
        s = A @ s + B @ a + D
        states.append(V @ s)
    return np.array(states)


def test_a_basis_that_is_not_orthonormal_is_made_so_and_the_model_stays_the_same() -> None:
    C = RNG.standard_normal((2, 3))
    model = ReducedModel(A, B, V, D, C)
    np.testing.assert_allclose(model.U.T @ model.U, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(
        np.sort(model.poles), np.sort(linalg.eigvals(A).astype(complex)), rtol=1e-9
    )
    expected = along(V @ [1.0, 2.0, 3.0])
    states, outputs = model.simulate(V @ [1.0, 2.0, 3.0], ACTIONS)
    np.testing.assert_allclose(states, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        outputs, linalg.lstsq(V, expected.T)[0].T @ C.T, rtol=1e-8, atol=1e-9
    )


def test_an_orthonormal_basis_keeps_its_bits_and_none_is_the_identity() -> None:
    U = linalg.qr(V, mode="economic")[0]
    model = ReducedModel(A, B, U)
    assert np.array_equal(model.A, A) and np.array_equal(model.U, U) and not model.d.any()
    assert np.array_equal(ReducedModel(A, B).U, np.eye(3))


def test_outputs_that_determine_the_state_are_its_basis() -> None:
    model = ReducedModel(A, B, C=V)
    assert model.n_z == 6 and model.C is not None
    np.testing.assert_allclose(model.C, model.U @ (model.U.T @ model.C), atol=1e-9)
    few = ReducedModel(A, B, C=V[:2])
    assert few.n_z == 3 and np.array_equal(few.U, np.eye(3))


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"A": A + 0j}, "A of a reduced model must be an array of real numbers, got complex"),
        ({"B": B * 1j}, "B of a reduced model must be an array of real numbers, got complex"),
        ({"U": V + 0j}, "U of a reduced model must be an array of real numbers"),
        ({"A": A[:2]}, "must be square"),
        ({"A": [["a"]]}, "must be an array of real numbers"),
        ({"B": B[:, 0]}, "B of a reduced model must be a non-empty matrix"),
        ({"B": np.ma.masked_greater(B, 0.0)}, "B of a reduced model has masked values"),
        ({"U": V[:, [0, 1, 1]]}, "columns of U of a reduced model must be independent"),
        ({"U": V[:2]}, "columns of U of a reduced model must be independent"),
        ({"d": D[:2]}, "d of a reduced model must be 3 finite numbers, .* got shape .2,."),
        ({"d": D * np.nan}, "d of a reduced model must be 3 finite numbers"),
        ({"C": V[:, :2]}, "needs C with 3 columns"),
    ],
)
def test_what_is_no_model_is_refused(parts: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        ReducedModel(**{"A": A, "B": B, **parts})


def test_a_system_in_continuous_time_is_sampled_with_held_inputs() -> None:
    rates = linalg.logm(linalg.expm(0.1 * A)).real
    system = scipy.signal.StateSpace(rates, B, np.eye(3), np.zeros((3, 2)))
    held = scipy.signal.cont2discrete((rates, B, np.eye(3), np.zeros((3, 2))), 0.25)
    model = ReducedModel.of(system, 0.25)
    np.testing.assert_allclose(model.A, held[0], rtol=1e-12)
    np.testing.assert_allclose(model.B, held[1], rtol=1e-12)
    with pytest.raises(ValueError, match="in continuous time: give the sample_time"):
        ReducedModel.of(system)


def test_a_system_in_discrete_time_is_taken_as_it_is() -> None:
    nothing = np.zeros((3, 2))
    model = ReducedModel.of(scipy.signal.StateSpace(A, B, np.eye(3), nothing, dt=0.5), 0.5)
    assert np.array_equal(model.A, A) and np.array_equal(model.B, B)
    for system, words in (
        (scipy.signal.StateSpace(A, B, np.eye(3), nothing, dt=0.4), "0.4 s; expected 0.5 s"),
        (scipy.signal.StateSpace(A, B, np.eye(3), nothing + 1, dt=0.5), "D of the system is not 0"),
        (
            SimpleNamespace(A=A, B=B, C=A, D=nothing, dt=None, isctime=None),
            "dt of the system is None",
        ),
        (3, "model is 3; expected a ReducedModel"),
    ):
        with pytest.raises(ValueError, match=words):
            ReducedModel.of(system, 0.5)


def test_a_model_is_the_same_after_saving_and_loading(tmp_path: Path) -> None:
    model = ReducedModel(A, B, V, D, V[:2])
    model.save(tmp_path / "own.npz")
    found = ReducedModel.load(tmp_path / "own.npz")
    for name in "ABUdC":
        np.testing.assert_array_equal(getattr(found, name), getattr(model, name))
    np.savez(tmp_path / "other.npz", A=A, F=B)
    with pytest.raises(ValueError, match=r"no array B; expected A and B, .* got A, F"):
        ReducedModel.load(tmp_path / "other.npz")
    np.savez(tmp_path / "other.npz", A=A + 0j, B=B)
    with pytest.raises(ValueError, match=r"other.npz: A of .* real numbers"):
        ReducedModel.load(tmp_path / "other.npz")


def test_the_constant_part_of_the_law_is_the_best_one_with_a_drift() -> None:
    """The average cost in the steady state has no slope in b."""
    s_r, q, r = np.array([1.0, -2.0, 0.5]), 2.0, 0.3
    gains = track(ReducedModel(A, B, d=D), state_weight=q, action_weight=r)
    b = gains.K_b @ s_r + gains.b
    into = linalg.inv(np.eye(3) - A - B @ gains.K_a)

    def cost(b: np.ndarray) -> float:
        s = into @ (B @ b + D)
        return float(q * (s - s_r) @ (s - s_r) + r * ((gains.K_a @ s + b) ** 2).sum())

    for way in np.eye(2):
        assert abs(cost(b + 1e-4 * way) - cost(b - 1e-4 * way)) < 1e-8 * cost(b)
    assert cost(gains.K_b @ s_r) > 1.001 * cost(b)
