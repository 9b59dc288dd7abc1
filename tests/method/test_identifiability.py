# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What data cannot tell apart is refused by name, in any units; what they can is not.

The plant is z_{k+1} = A z_k + B a_k with known A and B, so that it is known what an experiment says of
them: inputs that are white determine B, and an input that is constant, a combination of other inputs or
a function of the state does not.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from controller_node.identification import DesignSettings, design_each, identify
from pdeloop.messages.arrays import Array
from pdeloop.method.reduce import regression
from pdeloop.method.reduce.channels import Channels
from pdeloop.method.reduce.identifiability import (
    CLOSE,
    NotIdentifiableError,
    examine,
)
from pdeloop.method.reduce.regression import exact_regression, study_orders

N_Z, N_A, STEPS = 5, 3, 120
A = np.diag([0.9, 0.8, 0.85, 0.95, 0.7]) + 0.1 * np.eye(N_Z, k=1) - 0.05 * np.eye(N_Z, k=-2)
B = np.random.default_rng(1).normal(size=(N_Z, N_A))

Law = Callable[[int, Array, np.random.Generator], Array]
"""The inputs (n_a,) of step k in the state z."""


def white(k: int, z: Array, rng: np.random.Generator) -> Array:
    return rng.normal(size=N_A)


def with_input(j: int, of: Callable[[int, Array, Array], float]) -> Law:
    """White inputs, of which a_j is a function of step, state and the others."""

    def law(k: int, z: Array, rng: np.random.Generator) -> Array:
        a = white(k, z, rng)
        a[j] = of(k, z, a)
        return a

    return law


def experiment(law: Law, seed: int = 0, steps: int = STEPS) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    z, a = [rng.normal(size=N_Z)], []
    for k in range(steps):
        a.append(law(k, z[-1], rng))
        z.append(A @ z[-1] + B @ a[-1])
    return np.array(z), np.array(a)


gain = np.array([0.05, -0.1, 0.02, 0.05, -0.04])

UNDETERMINED: dict[str, tuple[Law, str]] = {
    "an input that is zero": (with_input(1, lambda k, z, a: 0.0), "the input a2 never moved"),
    "an input that is constant": (
        with_input(1, lambda k, z, a: 0.7),
        r"the input a2 never moved \(constant at 0.7\)",
    ),
    "two inputs that are constant": (
        lambda k, z, rng: np.array([0.1, rng.normal(), 0.3]),
        "the inputs a1 and a3 never moved",
    ),
    "an input that is another one": (
        with_input(2, lambda k, z, a: a[0]),
        r"the inputs a1 and a3 always moved together \(a3 = 1 a1\)",
    ),
    "an input that is a multiple, with an offset": (
        with_input(2, lambda k, z, a: 0.5 - 3 * a[0]),
        r"the inputs a1 and a3 always moved together \(a3 = -3 a1 \+ 0.5\)",
    ),
    "an input that is a combination of two": (
        with_input(2, lambda k, z, a: 2 * a[0] - a[1]),
        r"a1, a2 and a3 always moved together \(a3 = 2 a1 - 1 a2\)",
    ),
    "three inputs that are one": (
        lambda k, z, rng: np.repeat(rng.normal(), N_A),
        r"a1 and a2 always moved together .* a1 and a3 always moved together",
    ),
    "feedback": (with_input(0, lambda k, z, a: gain @ z), "the input a1 always followed from"),
    "affine feedback": (
        with_input(0, lambda k, z, a: gain @ z + 0.4),
        "the input a1 always followed from the state",
    ),
    "feedback in all inputs": (
        lambda k, z, rng: np.array([gain @ z, gain[::-1] @ z, z[0] * 0.02]),
        "a combination of the inputs a1, a2 and a3 always followed|a1 always followed",
    ),
    "a sum of inputs that is feedback": (
        with_input(2, lambda k, z, a: gain @ z - a[0]),
        "a combination of the inputs a1 and a3 always followed from the state",
    ),
}


@pytest.mark.parametrize("kind", UNDETERMINED)
@pytest.mark.parametrize("z_unit", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("a_unit", [1e-9, 1.0, 1e9])
def test_what_cannot_be_told_apart_is_refused_in_any_unit(
    kind: str, z_unit: float, a_unit: float
) -> None:
    law, words = UNDETERMINED[kind]
    states, actions = experiment(law)
    if "=" in words or "constant at" in words:
        words = words.split(r" \(")[0] if a_unit != 1.0 else words
    data = [(z_unit * states, a_unit * actions)]
    for refuse in (
        lambda: exact_regression(data, n_s=N_Z),
        lambda: regression.truncated_dmdc(data, p=2, n_s=2),
        lambda: study_orders(data),
        lambda: identify(data, method="regression", n_s=0),
    ):
        with pytest.raises(NotIdentifiableError, match=words) as refused:
            refuse()
        assert "\n" not in str(refused.value) and "or add a log" in str(refused.value)


@pytest.mark.parametrize("kind", UNDETERMINED)
def test_inputs_are_refused_by_their_names_where_each_has_a_unit_of_its_own(kind: str) -> None:
    law, _ = UNDETERMINED[kind]
    states, actions = experiment(law)
    units = np.array([1e-9, 1.0, 1e9])
    names = Channels(inputs=["pump", "valve", "heater"])
    with pytest.raises(NotIdentifiableError, match=r"pump|valve|heater"):
        exact_regression([(states, units * actions)], n_s=N_Z, channels=names)


def test_white_inputs_determine_the_model_in_any_unit() -> None:
    states, actions = experiment(white)
    for z_unit in (1e-9, 1.0, 1e9):
        for a_units in (1e-9, 1.0, 1e9, np.array([1e-9, 1.0, 1e9])):
            data = [(z_unit * states, a_units * actions)]
            model = exact_regression(data, n_s=N_Z)
            found = examine(data, model.U)
            assert found.faults == found.remarks == ()
            assert found.rank == found.unknowns == N_Z + N_A
            assert found.smallest_singular_value > 0.1
            assert (found.independence > 0.7).all()
            np.testing.assert_allclose(
                model.U @ model.B * a_units / z_unit, B, rtol=1e-9, atol=1e-9
            )


def test_the_state_may_be_wider_than_the_log_is_long() -> None:
    onto = np.random.default_rng(2).normal(size=(400, N_Z))
    states, actions = experiment(white)
    assert examine([(states @ onto.T, actions)], np.eye(400)[:, :N_Z]).faults == ()
    states, actions = experiment(with_input(0, lambda k, z, a: gain @ z))
    with pytest.raises(NotIdentifiableError, match="a1 always followed"):
        exact_regression(
            [(states @ onto.T, actions)], n_s=2
        )  # feedback of what two modes leave out


def test_feedback_of_noisy_measurements_is_feedback() -> None:
    states, actions = experiment(white)
    measured = states + 0.1 * np.random.default_rng(3).normal(size=states.shape)
    with pytest.raises(NotIdentifiableError, match="always followed"):
        exact_regression([(measured, np.c_[actions[:, :2], measured[:-1] @ gain])], n_s=N_Z)


@pytest.mark.parametrize("kind", ["a copy", "feedback"])
def test_inputs_that_are_close_to_it_are_remarked(kind: str) -> None:
    share = 0.02

    def close(k: int, z: Array, a: Array) -> float:
        return share * a[1] + (a[0] if kind == "a copy" else 3.0 * float(gain @ z))

    data = [experiment(with_input(1, close))]
    model = exact_regression(data, n_s=N_Z)
    found = examine(data, model.U)
    (remark,) = found.remarks
    assert "a2" in remark and "excite each input by itself" in remark
    assert 0.0 < found.independence[1] < CLOSE


@pytest.mark.parametrize("digits", [5, 3, 1])
def test_a_rounded_copy_or_rounded_feedback_is_refused(digits: int) -> None:
    for law in (
        with_input(1, lambda k, z, a: 0.7 * a[0]),
        with_input(1, lambda k, z, a: float(gain @ z)),
    ):
        states, actions = experiment(law)
        actions[:, 1] = np.round(actions[:, 1], digits)
        with pytest.raises(NotIdentifiableError, match="a2"):
            exact_regression([(states, actions)], n_s=N_Z)


def test_whole_numbers_and_switched_inputs_are_taken() -> None:
    rng = np.random.default_rng(4)
    for actions in (
        rng.integers(-20, 21, size=(STEPS, N_A)),
        rng.integers(0, 2, size=(STEPS, N_A)),
        (rng.random(size=(STEPS, N_A)) < 0.1).astype(np.int64),
    ):
        z = [np.zeros(N_Z)]
        for a in actions:
            z.append(A @ z[-1] + B @ a)
        states = np.round(100 * np.array(z)).astype(np.int64)
        assert examine([(states, actions)], np.eye(N_Z)).faults == ()
        coupled = actions.copy()
        coupled[:, 2] = coupled[:, 0] + coupled[:, 1]
        with pytest.raises(NotIdentifiableError, match="always moved together"):
            exact_regression([(states, coupled)], n_s=2)


def test_a_log_that_is_there_twice_counts_once() -> None:
    short = experiment(white, steps=N_Z + N_A - 1)
    with pytest.raises(ValueError, match="needs at least 8 steps, but there are 7"):
        exact_regression([short, short, short], n_s=N_Z)
    one, other = experiment(white, seed=1), experiment(white, seed=2)
    twice, once = (exact_regression(data, n_s=N_Z) for data in ([one, other, one], [one, other]))
    assert np.array_equal(twice.A, once.A) and np.array_equal(twice.B, once.B)
    assert np.array_equal(
        study_orders([one, other, one]).one_step, study_orders([one, other]).one_step
    )
    (remark,) = examine([one, other, one], once.U).remarks
    assert "2 repeats 0" in remark


def test_a_log_at_rest_says_nothing() -> None:
    states, actions = np.ones((STEPS + 1, N_Z)), np.zeros((STEPS, N_A))
    with pytest.raises(NotIdentifiableError, match="a1, a2 and a3 never moved"):
        exact_regression([(states, actions)], n_s=1)
    moving = experiment(white)
    rested = exact_regression([moving, (0 * states, actions)], n_s=N_Z)
    np.testing.assert_allclose(rested.U @ rested.B, B, atol=1e-9)


def test_steps_that_repeat_each_other_are_too_few() -> None:
    """Ten steps, of which five begin and end alike: the rank counts, not the number."""
    states, actions = experiment(white, steps=4)
    pieces = [(states[k : k + 2], actions[k : k + 1]) for k in range(4)]
    doubled = [(2 * z, 2 * a) for z, a in pieces]
    with pytest.raises(NotIdentifiableError):
        exact_regression(pieces + doubled, n_s=4)


def test_the_state_is_told_by_channel() -> None:
    states, actions = experiment(white)
    cases = {
        "z3 never moved": states * [1, 1, 0, 1, 1],
        "z5 is always -2 times z1": np.c_[states[:, :4], -2 * states[:, 0]],
        "choose units in which they are of similar size": states * [1, 1, 1e-9, 1, 1e9],
    }
    for words, measured in cases.items():
        with pytest.raises(ValueError, match=f"n_s is 5: .*{words}.*; lower n_s"):
            exact_regression([(measured, actions)], n_s=N_Z)
        model = exact_regression([(measured, actions)], n_s=2)
        assert any(words in remark for remark in examine([(measured, actions)], model.U).remarks)
    names = Channels(states=["T1", "T2", "p", "x", "v"])
    with pytest.raises(ValueError, match="p never moved"):
        exact_regression([(states * [1, 1, 0, 1, 1], actions)], n_s=N_Z, channels=names)


def test_the_controller_refuses_an_exploration_that_excites_nothing() -> None:
    states, actions = experiment(with_input(1, lambda k, z, a: 0.0))
    settings = DesignSettings(N_A, N_Z, 1.0, 1.0)
    for identification in ("regression", "field", "dmdc"):
        own = DesignSettings(**{**vars(settings), "identification": identification})
        with pytest.raises(ValueError, match="the input a2 never moved"):
            design_each(states[:, None], actions[:, None], [0], np.zeros(N_Z), own)
