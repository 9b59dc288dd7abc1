# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws: their parameters, what they answer, their derivatives, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.messages.own_code import OwnCodeError
from pdeloop.method.laws import Affine, FeedForward, Law, Observer
from pdeloop.method.laws.base import differentiable
from pdeloop.method.laws.registry import (
    MAX_NUMBER,
    OWN_LAWS,
    action,
    along,
    law_kind,
    laws_of,
    updated,
)

N_Z, N_S, N_A, T = 7, 3, 2, 5
SHIPPED = list(OWN_LAWS.shipped.values())
RNG = np.random.default_rng(4)
U = np.linalg.qr(RNG.standard_normal((N_Z, N_S)))[0]
A, B = RNG.standard_normal((N_S, N_S)), RNG.standard_normal((N_S, N_A))
K_a, K_b = RNG.standard_normal((2, N_A, N_S))
MODEL = ModelRows(A=A, B=B, U=U, K_a=K_a, K_b=K_b, s_r=RNG.standard_normal(N_S))
MOVING = Cost(N_Z, N_A, T, target=np.sin(np.arange(T * N_Z)).reshape(T, N_Z))


def trajectory(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((T, N_Z)), rng.standard_normal((T, N_A))


@pytest.mark.parametrize("kind", SHIPPED)
def test_the_parts_of_theta_are_the_whole_of_it(kind: type[Law]) -> None:
    law = kind(MODEL, T)
    theta = np.arange(law.size, dtype=np.float64)
    parts = law.parts(theta)
    assert sum(part.size for part in parts.values()) == law.size == np.prod(law.shape)
    assert np.array_equal(law.vector(parts), theta)
    start = law.parts(law.theta_start)
    for name, part in law.start().items():
        assert np.array_equal(start[name], part)


@pytest.mark.parametrize("kind", [Affine, FeedForward, Observer])
def test_these_laws_start_as_the_law_of_lq_tracking(kind: type[Law]) -> None:
    """Without a filter gain the observer believes what is measured, whatever it predicted."""
    states, actions = trajectory()
    law = kind(MODEL, T)
    expected = states @ U @ K_a.T + K_b @ MODEL.s_r
    np.testing.assert_allclose(along(law, law.theta_start, states, actions), expected, atol=1e-12)


@pytest.mark.parametrize("kind", [kind for kind in SHIPPED if kind.needs_model])
def test_a_law_that_an_optimiser_identifies_a_model_for_begins_as_another_one(
    kind: type[Law],
) -> None:
    own, (states, actions) = kind(MODEL, T), trajectory()
    plain = (Observer if own.filtered else Affine)(MODEL, T)
    expected = along(plain, plain.theta_start, states, actions)
    assert expected.any() and own.has_gains(own.theta_start) == plain.compiled
    assert np.array_equal(along(own, own.theta_start, states, actions), expected)


def test_a_feed_forward_is_added_at_its_step_and_the_last_one_stays() -> None:
    law = FeedForward(MODEL, T)
    b = np.arange(2.0 * T).reshape(T, N_A)
    theta = {"K": np.zeros((N_A, N_S)), "b": b}
    found = [law.action(theta, np.ones(N_Z), np.zeros(0), k) for k in range(T + 3)]
    assert np.array_equal(found, [*b, b[-1], b[-1], b[-1]])


def test_the_observer_of_a_plant_that_it_knows_predicts_what_it_does_not_measure() -> None:
    """With L = 0 the estimate is the model's state: exact, if the plant is the model."""
    law = Observer(replace(MODEL, K_b=0.0 * K_b, L=np.zeros((N_S, N_S))), T)
    theta = law.parts(law.theta_start)
    s, memory = RNG.standard_normal(N_S), law.memory_start()
    for k in range(4):
        measured = U @ s if k == 0 else RNG.standard_normal(N_Z)  # noise alone
        a = law.action(theta, measured, memory, k)
        np.testing.assert_allclose(a, K_a @ s, rtol=1e-9)
        memory = law.memory_update(theta, measured, memory, a, k)
        s = A @ s + B @ a


def numeric(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(df/dx)^T y by central differences."""
    steps = 1e-6 * np.eye(x.size)
    slopes = [(f(x + d.reshape(x.shape)) - f(x - d.reshape(x.shape))) @ y / 2e-6 for d in steps]
    return np.reshape(slopes, x.shape)


@pytest.mark.parametrize("k", [0, 1, T])
@pytest.mark.parametrize(
    ("kind", "cost"), [(Affine, None), (FeedForward, None), (Observer, None), (Observer, MOVING)]
)
def test_derivatives_agree_with_finite_differences(
    kind: type[Law], cost: Cost | None, k: int
) -> None:
    law, rng = kind(MODEL, T), np.random.default_rng(k)
    law.cost = cost
    theta = law.theta_start + 0.3 * rng.standard_normal(law.size)
    z, memory = rng.standard_normal(N_Z), rng.standard_normal(law.memory_size)
    y, a = rng.standard_normal((2, N_A))
    assert differentiable(kind)

    def agree(found: Any, expected: np.ndarray) -> None:
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7)

    of_theta, of_z, of_memory = law.pull_back(law.parts(theta), z, memory, k, y)
    agree(
        law.vector(of_theta),
        numeric(lambda t: law.action(law.parts(t), z, memory, k), theta, y),
    )
    agree(of_z, numeric(lambda x: law.action(law.parts(theta), x, memory, k), z, y))
    if law.memory_size:
        parts, w = law.parts(theta), rng.standard_normal(law.memory_size)
        agree(of_memory, numeric(lambda m: law.action(parts, z, m, k), memory, y))
        of_theta, of_z, of_memory, of_a = law.pull_back_memory(parts, z, memory, a, k, w)
        update = law.memory_update
        agree(
            law.vector(of_theta),
            numeric(lambda t: update(law.parts(t), z, memory, a, k), theta, w),
        )
        agree(of_z, numeric(lambda x: update(parts, x, memory, a, k), z, w))
        agree(of_memory, numeric(lambda m: update(parts, z, m, a, k), memory, w))
        agree(of_a, numeric(lambda u: update(parts, z, memory, u, k), a, w))


class Own(Law):
    """A law that tests make wrong in one way."""

    def start(self):
        return {"K": self.model.K_a}

    def action(self, theta, z, memory, k):
        return theta["K"] @ self.reduced(z)


def changed(**members: Any) -> type[Law]:
    return type("Changed", (Own,), members)


def test_a_law_that_gives_no_derivative_has_none() -> None:
    assert not differentiable(Own)
    only_action = changed(
        pull_back=Affine.pull_back, memory_size=1, memory_update=lambda self, *given: np.zeros(1)
    )
    assert not differentiable(only_action)
    assert Own.name == "Own" and not Own.compiled


def test_numbers_that_are_not_finite_count_as_large_ones() -> None:
    law = changed(
        memory_size=3,
        action=lambda self, theta, z, memory, k: np.array([np.nan, -np.inf]),
        memory_update=lambda self, theta, z, memory, a, k: np.array([np.inf, 1e300, 2.0]),
    )(MODEL, T)
    parts, memory = law.parts(law.theta_start), law.memory_start()
    a = action(law, parts, np.ones(N_Z), memory, 0)
    assert np.array_equal(a, [MAX_NUMBER, -MAX_NUMBER])
    assert np.array_equal(
        updated(law, parts, np.ones(N_Z), memory, a, 0), [MAX_NUMBER, MAX_NUMBER, 2.0]
    )


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ({"start": lambda self: {}}, "start must return finite numbers, at least one"),
        ({"start": lambda self: {"K": np.full((N_A, N_S), np.nan)}}, "start must return finite"),
        (
            {"start": lambda self: 1 / 0},
            r"Changed.start fails: .*test_laws.py, line \d+: ZeroDivisionError",
        ),
        ({"compiled": True}, "Changed.gains fails: .*NotImplementedError"),
        ({"compiled": True, "gains": lambda self, t: t}, r"shape \(6,\); expected \(2, 6\)"),
        (
            {
                "compiled": True,
                "gains": lambda self, t: np.hstack([2 * t.reshape(N_A, N_S), 0 * K_b]),
            },
            "must be .* of the law that Changed.action computes",
        ),
        ({"action": lambda self, *given: np.ones(N_A)}, "non-zero action for theta = 0"),
        ({"action": lambda self, *given: np.zeros(3)}, r"shape \(3,\); expected 2 numbers"),
        ({"action": lambda self, *given: None}, "not an array of real numbers; expected 2 numbers"),
        ({"action": lambda self, *given: [][0]}, "Changed.action fails: .*IndexError"),
        ({"memory_start": lambda self: 1 / 0}, "Changed.memory_start fails"),
    ],
)
def test_a_law_that_cannot_be_used_is_refused_in_one_sentence(members, words) -> None:
    with pytest.raises(OwnCodeError, match=words) as refused:
        laws_of(changed(**members), [MODEL], T)
    assert "\n" not in str(refused.value)


def test_the_registry_knows_ours_and_refuses_what_is_no_law(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv(OWN_LAWS.variable, "")
    assert OWN_LAWS.offered()[: len(SHIPPED)] == [kind.name for kind in SHIPPED]
    assert [law_kind(kind.name) for kind in SHIPPED] == SHIPPED
    assert OWN_LAWS.take(Affine) == "affine"
    with pytest.raises(ValueError, match="unknown law 'afine': give one of affine, feedforward"):
        law_kind("afine")
    with pytest.raises(ValueError, match=r"is code, .* name it yourself: --law .*PDELOOP_LAWS="):
        law_kind(f"{__file__}:Own")
    assert law_kind(OWN_LAWS.take(Own)) is Own
    (tmp_path / "own.py").write_text("import pdeloop\nclass Half(pdeloop.Law): pass\nNo = dict\n")
    for name, words in (("No", "must be a class derived from"), ("Half", "define action, start")):
        with pytest.raises(ValueError, match=words):
            law_kind(OWN_LAWS.allow(f"{tmp_path}/own.py:{name}"))


def test_an_installed_package_offers_its_laws_by_name(monkeypatch, tmp_path) -> None:
    source = "from pdeloop.method.laws import Affine\nclass Tanh(Affine): name = 'tanh'\n"
    (tmp_path / "packaged_law.py").write_text(source)
    about = tmp_path / "packaged-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: packaged\nVersion: 1.0\n")
    entries = ["[pdeloop.laws]", "tanh = packaged_law:Tanh", "affine = packaged_law:Tanh"]
    (about / "entry_points.txt").write_text("\n".join(entries))
    monkeypatch.syspath_prepend(str(tmp_path))
    assert law_kind("tanh").name == "tanh" and "tanh" in OWN_LAWS.offered()
    assert law_kind("affine") is Affine, "no package takes a name of ours"
