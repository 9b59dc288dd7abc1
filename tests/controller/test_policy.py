# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The projected law: the formula, bit identity over batches, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from controller_node.law import control, load_compiled
from controller_node.policy import ProjectedLaw, excitation

N_Z, N_S, N_A = 64, 5, 3


def bases(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [np.linalg.qr(rng.standard_normal((N_Z, N_S)))[0] for _ in range(count)]


def batch(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((count, N_A, 2 * N_S)), rng.standard_normal((count, N_Z))


TARGET = np.cos(2 * np.pi * np.arange(N_Z) / N_Z)


def test_is_the_law() -> None:
    models = bases(2)
    policies, states = batch(7)
    index = np.array([0, 1, 1, 0, 1, 0, 0])
    law = ProjectedLaw(models, TARGET)
    law.set(policies, index)
    for m, action in enumerate(law.actions(states)):
        U = models[index[m]]
        K_a, K_b = policies[m, :, :N_S], policies[m, :, N_S:]
        np.testing.assert_allclose(
            action, K_a @ U.T @ states[m] + K_b @ U.T @ TARGET, rtol=1e-12, atol=1e-12
        )
    np.testing.assert_allclose(law.reduced_targets, [U.T @ TARGET for U in models], atol=1e-13)


def test_states_of_a_message_and_of_this_process_are_one_type_to_the_compiler() -> None:
    load_compiled()
    law = ProjectedLaw(bases(1), TARGET)
    policies, states = batch(2)
    law.set(policies)
    expected = law.actions(states)
    states.setflags(write=False)
    assert np.array_equal(law.actions(states), expected)
    assert len(control.signatures) == 1


@pytest.mark.parametrize("count", [1, 2, 3, 8, 13])
def test_an_environment_is_bit_identical_in_any_batch(count: int) -> None:
    models = bases(3)
    policies, states = batch(13)
    index = np.arange(13) % 3
    whole = ProjectedLaw(models, TARGET)
    whole.set(policies, index)
    reference = whole.actions(states)
    order = np.random.default_rng(5).permutation(13)[:count]
    part = ProjectedLaw(models, TARGET)
    part.set(policies[order], index[order])
    assert np.array_equal(part.actions(states[order]), reference[order])
    # Nor does it matter which other models the law knows.
    for m in order:
        alone = ProjectedLaw([models[index[m]]], TARGET)
        alone.set(policies[m : m + 1])
        assert np.array_equal(alone.actions(states[m : m + 1])[0], reference[m])


def test_memory_layout_of_the_inputs_does_not_matter() -> None:
    policies, states = batch(4)
    law = ProjectedLaw(bases(1), TARGET)
    law.set(policies)
    reference = law.actions(states)
    turned = ProjectedLaw([np.asfortranarray(bases(1)[0])], TARGET)
    turned.set(np.asfortranarray(policies))
    assert np.array_equal(turned.actions(np.asfortranarray(states)), reference)
    spread = np.zeros((4, 2 * N_Z))
    spread[:, ::2] = states
    assert np.array_equal(law.actions(spread[:, ::2]), reference)


def test_results_are_the_callers() -> None:
    policies, states = batch(500)
    law = ProjectedLaw(bases(1), TARGET)
    law.set(policies)
    first = law.actions(states)
    kept = first.copy()
    law.actions(2 * states)
    assert np.array_equal(first, kept)


def test_the_law_keeps_its_own_copies() -> None:
    policies, states = batch(2)
    models, target = bases(1), TARGET.copy()
    law = ProjectedLaw(models, target)
    index = np.zeros(2, dtype=np.int64)
    law.set(policies, index)
    reference = law.actions(states)
    policies[:], models[0][:], target[:], index[:] = 9.0, 9.0, 9.0, 5
    assert np.array_equal(law.actions(states), reference)


def test_a_diverged_environment_does_not_disturb_the_others() -> None:
    policies, states = batch(3)
    law = ProjectedLaw(bases(1), TARGET)
    law.set(policies)
    reference = law.actions(states)
    states[1, 4] = np.nan
    actions = law.actions(states)
    assert np.array_equal(actions[[0, 2]], reference[[0, 2]])
    assert np.isnan(actions[1]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p, i: (p[0], i), "policies must have shape"),
        (lambda p, i: (p[:, :, :-1], i), f"actuators, {2 * N_S}"),
        (lambda p, i: (p[:0], i[:0]), "policies must have shape"),
        (lambda p, i: (p * np.nan, i), "policies must be finite"),
        (lambda p, i: (p * np.inf, i), "policies must be finite"),
        (lambda p, i: (p, i[:-1]), "model_index must be 3 integers"),
        (lambda p, i: (p, i + 0.5), "model_index must be 3 integers"),
        (lambda p, i: (p, i + 2), r"0 \.\. 1, but it holds 2"),
        (lambda p, i: (p, i - 1), r"0 \.\. 1, but it holds -1"),
    ],
)
def test_refuses_malformed_policies_and_stays_as_it_was(
    change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]], message: str
) -> None:
    policies, states = batch(3)
    index = np.array([0, 1, 0])
    law = ProjectedLaw(bases(2), TARGET)
    law.set(policies, index)
    reference = law.actions(states)
    with pytest.raises(ValueError, match=message):
        law.set(*change(policies, index))
    assert np.array_equal(law.actions(states), reference)


def test_refuses_malformed_states_and_buffers() -> None:
    policies, states = batch(3)
    law = ProjectedLaw(bases(1), TARGET)
    with pytest.raises(ValueError, match="no policies yet"):
        law.actions(states)
    law.set(policies)
    with pytest.raises(ValueError, match=r"states must have shape \(3, 64\)"):
        law.actions(states[:2])
    with pytest.raises(ValueError, match="states must have shape"):
        law.actions(states[:, :-1])


def test_refuses_malformed_models_and_targets() -> None:
    with pytest.raises(ValueError, match="models must be one or more"):
        ProjectedLaw([], TARGET)
    with pytest.raises(ValueError, match="models must be one or more"):
        ProjectedLaw([np.eye(N_Z)[:, :2], np.eye(N_Z)[:, :3]], TARGET)
    with pytest.raises(ValueError, match="a state of 64 numbers, but the target"):
        ProjectedLaw(bases(1), TARGET[:-1])
    with pytest.raises(ValueError, match="finite"):
        ProjectedLaw(bases(1), TARGET * np.nan)


def test_excitation_is_a_pure_function_with_the_variance_asked_for() -> None:
    assert np.array_equal(excitation(3, 17, 6, 0.1), excitation(3, 17, 6, 0.1))
    assert not np.array_equal(excitation(3, 17, 6, 0.1), excitation(3, 18, 6, 0.1))
    assert not np.array_equal(excitation(3, 17, 6, 0.1), excitation(4, 17, 6, 0.1))
    draws = np.concatenate([excitation(0, k, 10, 0.01) for k in range(2000)])
    # The standard error of the variance of n normal draws is variance sqrt(2 / n).
    assert draws.var() == pytest.approx(0.01, abs=4 * 0.01 * np.sqrt(2 / draws.size))
    assert abs(draws.mean()) < 4 * 0.1 / np.sqrt(draws.size)
    assert np.array_equal(excitation(2**53 - 1, 0, 2, 0.0), np.zeros(2))


def test_excitation_refuses_bad_arguments() -> None:
    for arguments in ((-1, 0, 2), (0, -1, 2), (0, 0, 0)):
        with pytest.raises(ValueError, match="excitation needs"):
            excitation(*arguments, 0.1)
    for variance in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="variance must be"):
            excitation(0, 0, 2, variance)
