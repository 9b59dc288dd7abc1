# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Large states as coordinates: what is inside of the basis is exact, what is outside makes it grow."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pdeloop.messages.cost import Cost
from pdeloop.method.adapt import Context, ModelBased, RolloutResult, Trajectory
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.adapt.trajectories import (
    CAPACITY,
    LARGE,
    CostInCoordinates,
    InCoordinates,
    LowRankTrajectory,
    SnapshotBasis,
    kept,
)
from pdeloop.method.models.base import FieldModelSettings
from tests.support.small import same_bits

N_Z, RANK, N_A, N_S, T = LARGE + 52, 9, 2, 4, 12
RNG = np.random.default_rng(5)
SPACE = np.linalg.qr(RNG.standard_normal((N_Z, RANK)))[0].T
"""Rows that all states of the plant below are in."""
A = np.diag(np.linspace(1.01, 0.6, RANK))
B = RNG.standard_normal((RANK, N_A))


def states_of(count: int) -> Any:
    return RNG.standard_normal((count, RANK)) @ SPACE


def rolled_out(policy: Any, seed: int) -> RolloutResult:
    """A rollout of the linear plant x' = A x + B a, z = x SPACE, from the field of the seed."""
    rng = np.random.default_rng(seed)
    x, states, actions, cost = rng.standard_normal(RANK), [], [], 0.0
    for _ in range(T):
        z = x @ SPACE
        a = policy[:, :N_S] @ (CONTEXT.U.T @ z)
        states.append(z)
        actions.append(a)
        cost += z @ z + a @ a
        x = A @ x + B @ a
    trajectory = kept(np.array([*states, x @ SPACE]), np.array(actions))
    return RolloutResult(cost / T, trajectory=trajectory)


def explored(seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    x, states, actions = rng.standard_normal(RANK), [], rng.standard_normal((T, N_A))
    for a in actions:
        states.append(x @ SPACE)
        x = A @ x + B @ a
    return kept(np.array([*states, x @ SPACE]), actions)


CONTEXT = Context(
    U=SPACE[:N_S].T.copy(),
    target=np.zeros(N_Z),
    state_weight=1.0,
    action_weight=1.0,
    horizon=T,
    exploration=explored(0),
    further=[explored(1)],
    line=False,
    periodic=False,
    field_models=FieldModelSettings(folds=2, largest_degree=2),
)


def made(context: Context) -> ModelBased:
    settings, start = ModelBasedSettings(mixtures=0), np.zeros((N_A, 2 * N_S))
    return ModelBased(start, seed=0, rollouts=7, settings=settings, context=context)


def optimizer() -> InCoordinates:
    return InCoordinates(made, CONTEXT)


def test_a_basis_grows_by_what_it_lacks_and_not_by_noise() -> None:
    basis = SnapshotBasis(SPACE[:3])
    basis.extend(states_of(5) + 1e-3 * RNG.standard_normal((5, N_Z)), noise=1e-3)
    # Five states lack five of the six directions that are left.
    assert len(basis.rows) == 8
    basis.extend(states_of(20))
    assert len(basis.rows) >= RANK
    np.testing.assert_allclose(basis.rows @ basis.rows.T, np.eye(len(basis.rows)), atol=1e-12)
    states = states_of(3)
    x = basis.coordinates(states)
    np.testing.assert_allclose(x[:, : len(basis.rows)] @ basis.rows, states, atol=1e-9)
    assert x.shape == (3, CAPACITY) and not x[:, len(basis.rows) :].any()


@pytest.mark.parametrize(
    "given",
    [
        {"state_weight": RNG.random(N_Z), "target": RNG.standard_normal(N_Z)},
        {"output": RNG.standard_normal((3, N_Z)), "target": RNG.standard_normal((T + 1, 3))},
        {"terminal_weight": 2.0, "action_target": 0.3, "action_weight": [[2.0, 0.5], [0.5, 1.0]]},
    ],
)
def test_a_cost_is_that_of_the_whole_states(given: dict[str, Any]) -> None:
    whole, basis = Cost(N_Z, N_A, T, **given), SnapshotBasis(SPACE[:5])
    own = CostInCoordinates(whole, basis)
    for _ in range(2):  # also after the basis has grown
        states, actions = states_of(4), RNG.standard_normal((4, N_A))
        basis.extend(states)
        own.make()
        x, wanted, found = basis.coordinates(states), np.zeros(4), np.zeros(4)
        for k in range(T):
            whole.add(wanted, states, actions, k)
            own.add(found, x, actions, k)
        whole.add_terminal(wanted, states)
        own.add_terminal(found, x)
        np.testing.assert_allclose(found, wanted, rtol=1e-9)
        J, on_z, on_a = (x[0] for x in whole.along(states[None], actions[None], 3))
        also_J, on_x, also_on_a = (part[0] for part in own.along(x[None], actions[None], 3))
        np.testing.assert_allclose(also_J, J, rtol=1e-9)
        np.testing.assert_allclose(on_x, basis.coordinates(on_z), atol=1e-8 * abs(on_z).max())
        np.testing.assert_allclose(also_on_a, on_a)
        (J, last), (also_J, also_last) = whole.at_end(states), own.at_end(x)
        np.testing.assert_allclose(also_J, J, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(also_last, basis.coordinates(last), atol=1e-8)


def test_an_optimiser_in_coordinates_finds_what_it_finds_in_the_space_of_the_states() -> None:
    def in_space(trajectory: Trajectory) -> Trajectory:
        return Trajectory(trajectory.states @ SPACE.T, trajectory.actions)

    explorations = [in_space(known) for known in CONTEXT.every_exploration]
    small = made(
        replace(
            CONTEXT,
            U=SPACE @ CONTEXT.U,
            target=np.zeros(RANK),
            exploration=explorations[0],
            further=explorations[1:],
        )
    )
    large = optimizer()
    while not large.done:
        for own in large, small:
            results = [rolled_out(r.policy, r.field_seed) for r in own.ask()]
            if own is small:
                results = [replace(r, trajectory=in_space(r.trajectory)) for r in results]
            own.tell(results)
    none, found, wanted = (
        np.mean([rolled_out(policy, seed).cost for seed in range(100, 120)])
        for policy in (np.zeros_like(small.policy), large.policy, small.policy)
    )
    assert found == pytest.approx(wanted, rel=1e-3) and found < 0.9 * none
    assert len(large.basis.rows) <= RANK  # no state is outside of it


def test_an_optimiser_in_coordinates_resumes_to_the_bit() -> None:
    whole, interrupted = optimizer(), optimizer()
    results = [rolled_out(r.policy, r.field_seed) for r in whole.ask()]
    for own in whole, interrupted:
        own.tell(results)
    again = optimizer()
    again.restore(interrupted.state())
    for one, other in zip(whole.ask(), again.ask(), strict=True):
        assert same_bits(one.policy, other.policy) and one.field_seed == other.field_seed
    results = [rolled_out(r.policy, r.field_seed) for r in whole.ask()]
    assert whole.tell(results) == again.tell(results)
    assert same_bits(whole.policy, again.policy) and same_bits(whole.basis.rows, again.basis.rows)


def test_a_checkpoint_is_refused_where_its_basis_does_not_fit() -> None:
    state = optimizer().state()
    with pytest.raises(ValueError, match="'basis'"):
        optimizer().restore(state | {"basis": np.zeros((CAPACITY + 1, N_Z))})
    with pytest.raises(ValueError, match="'basis'"):
        optimizer().restore(state | {"basis": np.zeros((3, N_Z - 1))})


def test_only_large_and_finite_states_are_kept_as_factors() -> None:
    states, actions = states_of(T + 1), np.zeros((T, N_A))
    assert isinstance(kept(states, actions), LowRankTrajectory)
    np.testing.assert_allclose(kept(states, actions).states, states, atol=1e-11)
    assert same_bits(kept(states[:, :LARGE], actions).states, states[:, :LARGE])
    states[-1, 3] = np.inf
    assert same_bits(kept(states, actions).states, states)
    diverged = replace(rolled_out(np.zeros((N_A, 2 * N_S)), 3), diverged=True)
    trained = optimizer()
    asked = len(trained.ask())
    broken = Trajectory(states, actions)
    assert trained.tell([replace(diverged, trajectory=broken)] * asked)["diverged"] == asked
