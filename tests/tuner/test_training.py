# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One seed, one policy: in any batch, after any interruption, and never anything but finite."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdeloop.in_process import LocalPair, train
from pdeloop.messages.model_rows import unpack
from pdeloop.messages.topics import COMPLETED, CostColumn, StartColumn
from pdeloop.method.reduce.regression import study_orders
from tests.support.small import CHECKED, FEW_STEPS, parameters, same_bits, train_here
from tuner_node import checkpoint, training_state
from tuner_node.batch import Batch, BatchResult, ContradictionError
from tuner_node.build import build_training
from tuner_node.chunk import Chunk, gathered
from tuner_node.narration import Narration


def test_a_seed_has_one_policy_alone_and_beside_others_and_however_episodes_are_cut():
    together = train_here(parameters(seeds=3, iterations=4))
    for offset in range(3):
        alone = train_here(parameters(seed=offset, iterations=4))
        assert same_bits(alone.policies()[0], together.policies()[offset])
        assert same_bits(alone.evaluation[0], together.evaluation[offset])
    cut = train_here(parameters(seeds=3, iterations=4), max_batch=1)
    assert same_bits(cut.policies(), together.policies())
    assert cut.history == together.history


def test_training_moves_the_policy_and_zero_starts_from_zero():
    trained = train_here(parameters(iterations=3))
    assert not np.array_equal(trained.policies(), trained.warm_starts())
    zero = build_training(parameters(iterations=3, start="zero"))
    pair = LocalPair(parameters())
    while zero.phase != "adapt":
        result = pair.run(zero.next_batch())
        zero.finish(result)
        if result.models is not None:
            pair.use_models(zero.models)
    assert (zero.policies() == 0).all()
    plus, minus = zero.next_batch().policies
    assert np.allclose(plus, -minus)
    assert np.isclose(np.linalg.norm(plus), 0.1)


def test_a_bad_warm_start_is_identified_again_and_only_that_one():
    values = parameters(seeds=2, iterations=1)
    training, pair = build_training(values), LocalPair(values)
    first = training.next_batch()
    training.finish(pair.run(first))
    pair.use_models(training.models)
    kept = training.models[0].copy()
    check = pair.run(training.next_batch())
    check.costs[3, 0] = check.costs[2, 0] + 1.0  # the second seed's LQT law loses to no control
    rows = training.finish(check)
    assert [row["accepted"] for row in rows] == [True, False]
    again = training.next_batch()
    assert again.exploratory
    assert again.rows[:, StartColumn.MODEL].tolist() == [1.0]
    assert not np.array_equal(again.rows[0, :2], first.rows[1, :2])
    training.finish(pair.run(again))
    assert same_bits(training.models[0], kept)
    pair.use_models(training.models)
    check = pair.run(training.next_batch())
    training.finish(check)
    assert training.phase == "adapt"
    # Both begin with the law that was measured to be better than no control.
    assert same_bits(training.starts(), training.warm_starts())


def test_of_a_basis_that_is_given_up_only_rollouts_without_control_are_kept():
    values = parameters(optimizer=CHECKED, rollouts=18, identification_attempts=2)
    training, pair = build_training(values), LocalPair(values)
    for _ in range(2):
        result = pair.run(training.next_batch())
        if training.phase == "check":
            result.costs[1, CostColumn.MEAN] = result.costs[0, CostColumn.MEAN] + 1.0
        training.finish(result)
        pair.follow(training)
    assert training.phase == "identify" and len(training.measured[0]) == 2
    training.finish(pair.run(training.next_batch()))
    assert training.phase == "check"  # of the law on another basis
    (kept,) = training.measured[0]
    assert not kept.actions.any()


def test_a_diverged_rollout_never_reaches_the_policy():
    values = parameters(iterations=4)
    training, pair = build_training(values), LocalPair(values)
    while training.phase != "adapt":
        result = pair.run(training.next_batch())
        training.finish(result)
        if result.models is not None:
            pair.use_models(training.models)
    before = training.policies()
    diverged = BatchResult(
        np.array([[1e9, 3e10, 7.0], [2.0, 60.0, COMPLETED]]), plant=training.plant
    )
    (row,) = training.finish(diverged)
    assert row["diverged"] == 1
    assert not row["updated"]
    assert same_bits(training.policies(), before)
    while (batch := training.next_batch()) is not None:
        training.finish(pair.run(batch))
    assert np.isfinite(training.policies()).all()


def test_a_rollout_that_diverges_is_marked_and_the_training_goes_on():
    # A bound just above the initial fields: what the perturbed policies do exceeds it now and then.
    training = train_here(parameters(divergence_bound=1.1, smoothing_radius=5.0, iterations=12))
    assert sum(row["diverged"] for row in training.history) > 0
    assert np.isfinite(training.policies()).all()


def test_a_plant_with_other_parameters_does_not_continue_a_training():
    values = parameters(iterations=2)
    training, pair = build_training(values), LocalPair(values)
    training.finish(pair.run(training.next_batch()))
    pair.use_models(training.models)
    other = replace(pair.run(training.next_batch()), plant=5)
    with pytest.raises(ValueError, match="the plant has other parameters"):
        training.finish(other)


def restored(path):
    """The array 'a' of what was handed over, and what was passed over."""
    taken = []
    found, passed_over = checkpoint.restore(path, lambda arrays: taken.append(arrays["a"].tolist()))
    assert found == bool(taken)
    return taken, passed_over


def test_damaged_checkpoints_are_passed_over(tmp_path):
    path = tmp_path / "checkpoint"
    checkpoint.save(path, {"a": np.arange(3)})
    checkpoint.save(path, {"a": np.arange(4)})
    good = path.read_bytes()
    for damaged in (good[:-1], good[:40], b"", b"PK\3\4" + good, good[:-9] + b"X" + good[-8:]):
        path.write_bytes(damaged)
        (found,), passed_over = restored(path)
        assert found == [0, 1, 2]
        assert len(passed_over) == 1
    # The damaged one is not kept in place of the good one before it.
    checkpoint.save(path, {"a": np.arange(5)})
    path.write_bytes(good[:40])
    assert restored(path)[0] == [[0, 1, 2]]
    path.write_bytes(good[:40])
    checkpoint.previous(path).unlink()
    found, (passed_over,) = restored(path)
    assert not found and "is not a checkpoint" in passed_over


def rows_file(path, model, name="model"):
    with path.open("wb") as file:
        np.savez(file, **{name: model})
    return str(path)


def test_a_given_model_of_another_plant_is_refused_with_the_sizes_of_both(tmp_path):
    found = train_here(parameters(iterations=1, optimizer="two_point")).models
    path = tmp_path / "model.npz"
    np.savez(path, model=found, B=np.zeros((4, 3)))
    values = parameters(model=str(path))
    with pytest.raises(ValueError, match="has 3 actuators, the plant has 4"):
        build_training(values)
    values = parameters(model=rows_file(path, found), n_z=64)
    with pytest.raises(ValueError, match="of a state of 32 numbers, but the target has"):
        train_here(values)
    with pytest.raises(ValueError, match="for a state of 32 numbers, but the plant's state has 64"):
        train_here({**values, "optimizer": "model_based"})


@pytest.mark.parametrize("optimizer", ["two_point", "model_based"])
def test_a_given_model_is_the_warm_start_of_every_seed(tmp_path, optimizer):
    found = train_here(parameters(seed=3, iterations=2, optimizer="two_point")).models
    given = {"model": rows_file(tmp_path / "model.npz", found)}
    few = FEW_STEPS if optimizer == "model_based" else {}
    values = parameters(seed=7, seeds=2, rollouts=13, optimizer=optimizer, **given, **few)
    training = build_training(values)
    first = training.next_batch()
    assert first.exploratory == (optimizer == "model_based"), (
        "only an optimiser may want to explore"
    )
    training = train_here(values)
    assert training.phase == "done"
    assert same_bits(training.models, np.repeat(found, 2, axis=0))
    n_a = values["n_a"]
    assert same_bits(training.warm_starts()[1], unpack(found[0], n_a).policy)
    costs = training.evaluation.mean(axis=2)
    assert costs[0, 1] == costs[1, 1], "the same law on the same fields"
    assert not same_bits(training.policies()[0], training.policies()[1])


def test_a_given_model_survives_a_restart(tmp_path):
    found = train_here(parameters(seed=3, iterations=2, optimizer="two_point")).models
    given = {"model": rows_file(tmp_path / "model.npz", found)}
    values = parameters(seed=7, iterations=6, optimizer="two_point", **given)
    whole = train_here(values)
    half = build_training(values)
    pair = LocalPair(values)
    pair.use_models(half.models)
    for _ in range(3):
        half.finish(pair.run(half.next_batch()))
    again = build_training(values)
    training_state.restore(again, training_state.arrays_of(half))
    train(again, LocalPair(values), lambda row: None)
    assert same_bits(again.policies(), whole.policies())


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "holds no reduced model; expected a file of 'pdeloop identify --out'"),
        ({"name": "other"}, "holds no reduced model"),
        ({"model": np.full((1, 40, 4), np.nan)}, "must be one array of finite rows"),
        ({"model": np.zeros((2, 40, 4))}, "must be one array of finite rows"),
        ({"model": np.zeros((1, 9, 4))}, "holds the model of another plant: .* leaves"),
    ],
)
def test_a_file_that_is_no_model_is_refused(tmp_path, content, words):
    path = tmp_path / "model.npz"
    if content is not None:
        rows_file(path, content.get("model", np.zeros((1, 40, 4))), content.get("name", "model"))
    with pytest.raises(ValueError, match=words):
        build_training(parameters(model=str(path)))


def test_a_model_of_another_plant_is_refused(tmp_path):
    path = rows_file(tmp_path / "model.npz", np.ones((1, 500, 4)))
    for optimizer in ("two_point", "model_based"):
        with pytest.raises(ValueError, match=r"state"):
            train_here(parameters(model=path, optimizer=optimizer))


@pytest.mark.parametrize("limit", [0.0, 0.05])
def test_model_based_refuses_actions_that_are_not_those_of_the_law(limit):
    values = parameters(optimizer="model_based", rollouts=20, action_limit=limit, **FEW_STEPS)
    assert train_here(values).law_seen
    assert not train_here(parameters(rollouts=11)).law_seen  # two_point sees costs only
    training, pair = build_training(values), LocalPair(values)
    while training.phase != "adapt":
        training.finish(pair.run(training.next_batch()))
        pair.follow(training)
    result = pair.run(training.next_batch())
    bent = [replace(t, actions=np.tanh(t.actions)) for t in result.trajectories]
    before = training.budget.by_purpose()
    words = r"not those of the law .* choose an optimizer that learns from costs alone"
    with pytest.raises(ValueError, match=words):
        training.finish(replace(result, trajectories=bent))
    assert training.budget.by_purpose() == before


def test_the_order_may_be_that_which_the_data_suggest_and_another_one_the_second_time():
    values = parameters(reduced_order=0, optimizer=CHECKED, rollouts=20, **FEW_STEPS)
    training, pair = build_training(values), LocalPair(values)
    explored = pair.run(training.next_batch())
    ((states, actions),) = [(t.states, t.actions) for t in explored.trajectories]
    order = explored.models.shape[2]
    assert order == study_orders([(states, actions)]).suggested
    training.finish(explored)
    pair.use_models(training.models)
    check = pair.run(training.next_batch())
    check.costs[1, 0] = check.costs[0, 0] + 1.0  # the law loses to no control
    training.finish(check)
    training.finish(LocalPair({**values, "reduced_order": order + 1}).run(training.next_batch()))
    train(training, pair, lambda row: None)
    assert training.policies().shape == (1, values["n_a"], 2 * (order + 1))


def test_an_order_from_the_data_is_of_one_seed():
    with pytest.raises(
        ValueError, match="'reduced_order' is 0 and 'seeds' is 2; expected one seed"
    ):
        build_training(parameters(reduced_order=0, seeds=2))


@pytest.mark.parametrize("optimizer", ["model_based", "two_point"])
def test_all_episodes_of_a_run_have_as_many_steps_also_after_a_restart(optimizer):
    values = parameters(optimizer=optimizer)
    former, training = build_training(values), build_training(values)
    pair, horizon = LocalPair(values), values["horizon"]
    former.finish(pair.run(former.next_batch()))
    training_state.restore(training, training_state.arrays_of(former))
    pair.follow(training)
    result = pair.run(training.next_batch())
    for steps in ({3}, {3, horizon}):
        with pytest.raises(ContradictionError, match=f"after 3 and {horizon} steps, expected one"):
            training.finish(replace(result, steps=frozenset(steps)))
    training.finish(result)
    assert training.phase != "identify"


def test_an_exploration_whose_inputs_cannot_be_told_apart_is_refused_whoever_drew_them():
    """As of a controller of somebody's own, which proposes a law and explores by itself."""
    values = parameters(optimizer=CHECKED, rollouts=20)
    training, pair = build_training(values), LocalPair(values)
    result = pair.run(training.next_batch())
    (explored,) = result.trajectories

    def with_actions(actions):
        own = [replace(explored, actions=actions)]
        return replace(result, trajectories=own)

    dead, coupled, close = (explored.actions.copy() for _ in range(3))
    dead[:, 1] = 0.0
    coupled[:, 1] = -2.0 * coupled[:, 0]
    close[:, 1] = close[:, 0] + 1e-3 * close[:, 1]
    for actions, words in ((dead, "a2 never moved"), (coupled, "a1 and a2 always moved together")):
        with pytest.raises(ValueError, match=words):
            training.finish(with_actions(actions))
    remark, *rows = training.finish(with_actions(close))
    assert remark["event"] == "excitation" and "a1 and a2" in remark["remark"]
    assert rows[0]["event"] == "designed"
    assert Narration(0, 1).lines(remark) == [f"  seed 0: {remark['remark']}"]


def test_model_based_explores_from_two_fields_for_one_model():
    values = parameters(optimizer="model_based", rollouts=10, seeds=2, identification="field")
    training = build_training(values)
    batch = training.next_batch()
    assert batch.exploratory and batch.together == 2
    assert batch.rows[:, StartColumn.MODEL].tolist() == [0.0, 0.0, 1.0, 1.0]
    for column in (StartColumn.SEED, StartColumn.EXCITATION):
        assert len(set(batch.rows[:, column])) == 4
    result = LocalPair(values).run(batch, max_batch=2)
    assert same_bits(result.models[0], result.models[1]), "they are of both explorations"
    assert not same_bits(result.models[0], result.models[2])
    alone = LocalPair(values).run(Batch(batch.rows[:2], None, True, 2))
    assert same_bits(alone.models[0], result.models[0]), "whatever else is in the batch"
    training.finish(result)
    assert training.phase == "adapt", "it judges the first law itself"
    assert training.budget.paid.tolist() == [2, 2]
    assert [len(further) for further in training.further] == [1, 1]
    again = build_training(values)
    training_state.restore(again, training_state.arrays_of(training))
    for one, other in zip(training.further, again.further, strict=True):
        assert same_bits(one[0].states, other[0].states)


def test_a_controller_that_gives_each_exploration_a_model_of_its_own_goes_on_working():
    """As one does that was written before there were several: the first one is taken."""
    values = parameters(optimizer="model_based", rollouts=10)
    training = build_training(values)
    batch = training.next_batch()
    own = [LocalPair(values).run(Batch(batch.rows[i : i + 1], None, True)) for i in range(2)]
    models = np.concatenate([result.models for result in own])
    assert not same_bits(models[0], models[1])
    together = LocalPair(values).run(batch)
    training.finish(replace(together, models=models))
    assert same_bits(training.models, models[:1])


def test_explorations_of_one_plant_part_where_it_has_one_environment():
    values = parameters(optimizer="model_based", rollouts=10)
    training = build_training(values)
    batch = training.next_batch()
    assert batch.together == 2
    result = LocalPair(values).run(batch, max_batch=1)
    first = LocalPair(values).run(Batch(batch.rows[:1], None, True))
    assert same_bits(result.models[:1], first.models)
    training.finish(result)
    assert same_bits(training.models, first.models) and len(training.further[0]) == 1


def test_explorations_that_part_may_suggest_different_orders():
    values = parameters(optimizer="model_based", rollouts=10, reduced_order=0, seed=1)
    training = build_training(values)
    batch = training.next_batch()
    own = [LocalPair(values).run(Batch(row[None], None, True)).models for row in batch.rows]
    assert own[0].shape != own[1].shape
    result = LocalPair(values).run(batch, max_batch=1)
    training.finish(result)
    assert same_bits(training.models, own[0]) and len(result.models) == 2
    # Over topics the chunks are joined likewise, also those of several seeds.
    parted = replace(batch, rows=np.tile(batch.rows, (2, 1))).within(1)
    same = [*own, own[0], own[1]]
    chunks = [
        Chunk(slice(i, i + 1), costs=result.costs[:1], models=models, trajectories=[])
        for i, models in enumerate(same)
    ]
    assert same_bits(gathered(chunks, parted, 1, None).models, np.concatenate(4 * [own[0]]))


def test_model_based_continues_with_the_same_bits_from_any_batch():
    values = parameters(optimizer="model_based", rollouts=10, identification="field")
    whole = build_training(values)
    pair, states = LocalPair(values), []
    train(
        whole,
        pair,
        lambda row: None,
        after_batch=lambda: states.append(training_state.arrays_of(whole)),
    )
    assert whole.budget.paid.tolist() == [10]
    for state in states[:-1]:
        again = build_training(values)
        training_state.restore(again, state)
        train(again, LocalPair(values), lambda row: None)
        assert same_bits(again.policies(), whole.policies())
        assert again.history == whole.history
    assert whole.history[-1]["reason"]


def test_an_affine_law_of_few_delayed_readings_is_improved():
    """On a model of the readings as they are, which are no field."""
    values = parameters(
        optimizer="model_based", rollouts=9, sensors=8, sensor_delays=2, **FEW_STEPS
    )
    training = train_here(values)
    _, first, adapted = training.evaluation[0].mean(axis=1)
    assert adapted < first


def test_what_explorations_and_checks_cost_is_told_before_anything_is_made_of_it():
    values = parameters(seeds=2, iterations=1)
    training, pair = build_training(values), LocalPair(values)
    while training.phase in ("identify", "check"):
        phase, before = training.phase, training.budget.paid.copy()
        result = pair.run(training.next_batch())
        told = training.batch_costs(result)
        training.finish(result)
        pair.follow(training)
        assert [row["rollouts"] for row in told] == training.budget.paid.tolist()
        count = training.budget.paid[0] - before[0]
        for row, own in zip(told, result.costs.reshape(2, count, -1), strict=True):
            assert row["event"] == "measured" and row["phase"] == phase and not row["diverged"]
            assert row["cost"] == pytest.approx(own[:, CostColumn.MEAN].mean(), rel=1e-12)
    assert training.batch_costs(pair.run(training.next_batch())) == []  # two_point tells at once
