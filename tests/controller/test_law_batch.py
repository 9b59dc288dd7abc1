# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law of many environments: the bits of each alone, the compiled form, and the memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from controller_node.law_batch import LawBatch, MemoryUnknownError
from controller_node.policy import ProjectedLaw
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.model_rows import ModelRows
from pdeloop.messages.own_code import OwnCodeError
from pdeloop.method.laws import Affine, FeedForward, Law, Observer
from pdeloop.method.laws.base import Parts
from pdeloop.method.laws.registry import along, laws_of
from tests.support.small import same_bits

N_Z, N_S, N_A, T = 24, 3, 2, 6
TARGET = np.cos(np.arange(N_Z))


def models(count: int) -> list[ModelRows]:
    rng = np.random.default_rng(0)
    found = []
    for _ in range(count):
        U = np.linalg.qr(rng.standard_normal((N_Z, N_S)))[0]
        A, B = 0.3 * rng.standard_normal((N_S, N_S)), rng.standard_normal((N_S, N_A))
        K_a, K_b = 0.3 * rng.standard_normal((2, N_A, N_S))
        L = 0.5 * np.eye(N_S) + 0.1 * rng.standard_normal((N_S, N_S))
        found.append(ModelRows(A=A, B=B, U=U, K_a=K_a, K_b=K_b, s_r=U.T @ TARGET, L=L))
    return found


def made(kind: type[Law], limit: float = 0.0, count: int = 2) -> LawBatch:
    return LawBatch(laws_of(kind, models(count), T), TARGET, ActionSet(limit=limit))


def episode(kind: type[Law], M: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Policies, their models and states (T, M, n_z)."""
    law, rng = kind(models(1)[0], T), np.random.default_rng(1)
    index = np.arange(M) % 2
    return rng.standard_normal((M, *law.shape)), index, rng.standard_normal((T, M, N_Z))


@pytest.mark.parametrize("kind", [Affine, FeedForward, Observer])
def test_the_layout_of_states_changes_no_bit(kind: type[Law]) -> None:
    """A node has them from a message, row by row, and a plant in this process in any order."""
    policies, index, states = episode(kind, 5)
    one, other = made(kind), made(kind)
    for law in (one, other):
        law.set(policies, index)
    for k, z in enumerate(states):
        assert same_bits(one.actions(k, z), other.actions(k, np.asfortranarray(z)))


@pytest.mark.parametrize("kind", [Affine, FeedForward, Observer])
def test_an_environment_is_bit_identical_in_any_batch_and_is_the_law(kind: type[Law]) -> None:
    policies, index, states = episode(kind, 5)
    whole = made(kind, limit=2.0)
    whole.set(policies, index)
    actions = np.stack([whole.actions(k, z) for k, z in enumerate(states)])
    assert (np.abs(actions) == 2.0).any() and np.abs(actions).max() == 2.0
    for m in (3, 0, 4):
        alone = made(kind, limit=2.0)
        alone.set(policies[m : m + 1], index[m : m + 1])
        own = np.stack([alone.actions(k, z[m : m + 1])[0] for k, z in enumerate(states)])
        assert same_bits(own, actions[:, m].copy())
        law = kind(models(2)[index[m]], T)
        expected = along(law, policies[m].ravel(), states[:, m], actions[:, m])
        np.testing.assert_allclose(own, np.clip(expected, -2.0, 2.0), atol=1e-12)


@pytest.mark.parametrize(("kind", "remembers"), [(Affine, False), (Observer, True)])
def test_a_law_of_one_model_remembers_as_its_kind_does(kind: type[Law], remembers: bool) -> None:
    assert made(kind, count=1).remembers is remembers


def test_the_affine_law_has_the_bits_of_its_compiled_form() -> None:
    policies, index, states = episode(Affine, 5)
    batch, projected = made(Affine), ProjectedLaw([m.U for m in models(2)], TARGET)
    batch.set(policies, index)
    projected.set(policies, index)
    assert batch.compiled is not None and batch.nbytes == 0
    assert same_bits(batch.actions(3, states[0]), projected.actions(states[0]))


def test_what_is_asked_for_twice_is_answered_from_what_was_answered() -> None:
    policies, index, states = episode(Observer, 3)
    once, twice = made(Observer), made(Observer)
    for batch in (once, twice):
        batch.set(policies, index)
    expected = [once.actions(k, z) for k, z in enumerate(states)]
    for k, z in enumerate(states):
        assert same_bits(twice.actions(k, z), expected[k])
        assert same_bits(twice.actions(k, z), expected[k])
        assert same_bits(twice.actions(0, states[0]), expected[0])
    # A plant that was started again runs its episode from the beginning.
    for k, z in enumerate(states):
        assert same_bits(twice.actions(k, z), expected[k])


def test_a_law_without_memory_answers_any_step_and_keeps_nothing() -> None:
    policies, index, states = episode(FeedForward, 3)
    batch = made(FeedForward)
    batch.set(policies, index)
    late = batch.actions(3, states[3])
    for k in range(3):
        batch.actions(k, states[k])
    assert same_bits(batch.actions(3, states[3]), late) and batch.nbytes == 0


class Counting(FeedForward):
    """Adds how many steps it remembers to its actions, where theta is not zero."""

    memory_size = 1

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        return super().action(theta, z, memory, k) + memory[0] * theta["b"][0]

    def memory_update(self, theta: Parts, z: Array, memory: Array, action: Array, k: int) -> Array:
        return memory + 1.0


def test_answers_count_in_bytes_and_a_begun_episode_begins_with_the_first_memory() -> None:
    policies, index, states = episode(Counting, 3)
    batch = made(Counting)
    batch.set(policies, index)
    expected = [batch.actions(k, z) for k, z in enumerate(states)]
    assert batch.nbytes == 8 * T * 3 * N_A
    batch.forget_answers()
    assert batch.nbytes == 8 * 3 * N_A
    again = [batch.actions(k, z) for k, z in enumerate(states)]
    assert all(map(same_bits, again, expected)) and batch.nbytes == 8 * T * 3 * N_A


def test_a_memory_that_is_not_known_is_never_made_up() -> None:
    policies, index, states = episode(Observer, 3)
    batch = made(Observer)
    batch.set(policies, index)
    with pytest.raises(MemoryUnknownError, match="before step 2 are unknown"):
        batch.actions(2, states[2])
    first = batch.actions(0, states[0])
    with pytest.raises(MemoryUnknownError, match="before step 2 are unknown"):
        batch.actions(2, states[2])
    batch.actions(1, states[1])
    with pytest.raises(MemoryUnknownError, match="two different states arrived for step 1"):
        batch.actions(1, states[1] + 1e-9)
    batch.forget_answers()
    with pytest.raises(MemoryUnknownError, match=r"step \d"):
        batch.actions(3, states[3])
    # Another state 0 begins the episode anew, as a machine does that cannot repeat one.
    other = batch.actions(0, states[0] + 1.0)
    assert not np.array_equal(other, first)
    assert same_bits(batch.actions(0, states[0]), first)


def test_a_policy_of_another_law_is_refused() -> None:
    policies, index, states = episode(FeedForward, 3)
    batch = made(FeedForward)
    words = r"shape \(environments, 18\) for the law 'feedforward' of these models, .* \(3, 2, 6\)"
    with pytest.raises(ValueError, match=words):
        batch.set(np.zeros((3, N_A, 2 * N_S)))
    with pytest.raises(ValueError, match="finite"):
        batch.set(np.full_like(policies, np.inf))
    with pytest.raises(ValueError, match=r"must lie in 0 \.\. 1"):
        batch.set(policies, index + 1)
    batch.set(policies, index)
    with pytest.raises(ValueError, match="states must be of 3 environments"):
        batch.actions(0, states[0, :2])


@pytest.mark.parametrize("kind", [FeedForward, Observer])
def test_where_a_model_a_policy_or_a_state_lies_in_memory_does_not_matter(kind: type[Law]) -> None:
    """Numbers in a message lie at an odd address, for which a product rounds otherwise."""

    def moved(array: np.ndarray | None) -> Any:
        if array is None:
            return None
        raw = np.frombuffer(b"\0\0\0\0" + array.tobytes(), np.uint8)
        return raw[4:].view(np.float64).reshape(array.shape)

    policies, index, states = episode(kind, 4)
    here, there = made(kind), [ModelRows(*map(moved, vars(m).values())) for m in models(2)]
    elsewhere = LawBatch(laws_of(kind, there, T), moved(TARGET))
    here.set(policies, index)
    elsewhere.set(moved(policies), index)
    for k, z in enumerate(states):
        assert same_bits(elsewhere.actions(k, moved(z)), here.actions(k, z))


def test_a_law_that_changes_its_own_parameters_is_refused() -> None:
    class Changing(FeedForward):
        def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
            if k:
                theta["b"] += 1.0
            return super().action(theta, z, memory, k)

    policies, index, states = episode(Changing, 3)
    batch = made(Changing)
    batch.set(policies, index)
    batch.actions(0, states[0])
    with pytest.raises(
        OwnCodeError, match=r"action fails: .*test_law_batch\.py, line \d+: .*read-only"
    ):
        batch.actions(1, states[1])
