# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`import pdeloop`: the same bits as the command line, arrays in and out, refusals in one sentence."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pdeloop
from controller_node.law_batch import MemoryUnknownError
from pdeloop.cli import main
from pdeloop.interruption import Interruption
from pdeloop.method.seeds import Purpose, derive
from tests.support.interpreter import python
from tests.support.small import SMALL, same_bits

TWO_POINT = {"optimizer": "two_point", "rollouts": 7, "evaluation_fields": 3, "seed": 5}


@pytest.fixture(scope="module")
def run() -> pdeloop.FinishedRun:
    return pdeloop.train(str(SMALL), **TWO_POINT)


@pytest.fixture(scope="module")
def small() -> pdeloop.Problem:
    return pdeloop.problem(SMALL)


def test_importing_it_is_cheap_and_needs_no_ros() -> None:
    program = (
        "import sys; sys.modules['rclpy'] = None\n"
        "import pdeloop\n"
        "assert not {'numpy', 'numba', 'scipy', 'pdeloop.api'} & set(sys.modules)\n"
        "for name in pdeloop.__all__: assert getattr(pdeloop, name).__doc__, name\n"
        "pdeloop.problem('burgers', n_z=32, horizon=5).explore()\n"
    )
    python("-c", program)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        pdeloop.nothing  # noqa: B018


def test_a_training_has_the_bits_of_the_command_line(run, tmp_path: Path) -> None:
    words = ["--optimizer", "two-point", "--rollouts", "7", "--seed", "5", "--in-process"]
    assert main(["train", str(SMALL), *words, "--out", str(tmp_path / "there")]) == 0
    there = pdeloop.load_run(tmp_path / "there")
    assert same_bits(run.policies, there.policies)
    assert same_bits(run.warm, there.warm)
    kept = pdeloop.train(pdeloop.problem(SMALL, horizon=9), out=tmp_path / "kept", **TWO_POINT)
    assert kept.values["horizon"] == 9
    assert same_bits(kept.policies, pdeloop.load_run(tmp_path / "kept").policies)
    with pytest.raises(ValueError, match="already holds a run"):
        pdeloop.train(str(SMALL), out=tmp_path / "kept")


@pytest.mark.parametrize(
    ("source", "given"),
    [
        (SMALL, {}),
        (SMALL, {"sensors": 8, "law": "observer", "measurement_noise": 0.1}),
        # Of two components, both of which a sensor measures.
        ("wave", {"n_z": 32, "horizon": 40, "sensors": 4, "law": "observer", "reduced_order": 4}),
    ],
)
def test_a_law_of_a_run_acts_as_in_its_evaluation(source: str, given: dict[str, object]) -> None:
    problem = pdeloop.problem(source, **given)
    run = pdeloop.train(problem, **TWO_POINT)
    assert run.models[0].U.shape == (problem.plant().state_size, len(run.models[0].A))
    plant = problem.plant()
    for which, costs in ((["adapted"], "adapted"), (["lqt", 5], "lqt")):
        law = run.law(*which)
        for _ in range(2):  # its memory begins anew
            episode = pdeloop.rollout(plant, law, *run.evaluation)
            assert same_bits(episode.costs.mean, run.costs[costs][0])
    for which, seed, told in (("none", None, "one of adapted, lqt"), ("lqt", 6, "no seed 6")):
        with pytest.raises(ValueError, match=told):
            run.law(which, seed)
    begun, z = run.law("lqt"), np.ones((2, len(run.models[0].U)))
    if run.values["law"] == "affine":  # which needs no step before
        assert same_bits(run.law("lqt")(3, z), begun(0, z))
        assert same_bits(begun(4, z[:1]), begun(0, z)[:1])
    else:
        with pytest.raises(MemoryUnknownError, match="before step 3 are unknown"):
            begun(3, z)
    alone, together = run.law("lqt"), run.law("lqt")
    for k, seen in enumerate(episode.states[:3, 0]):  # of one plant, as of a batch of one
        assert same_bits(alone(k, seen), together(k, seen[None])[0])
    for wrong in (z[:, 1:], z[0, 1:], z[None], z[:0], 1.0):
        with pytest.raises(ValueError, match=rf"of M plants, \(M, {z.shape[1]}\), or of one, \("):
            run.law()(0, wrong)
    # A machine that was trained with the parameters of a problem may have another target.
    model = replace(run.models[0], s_r=run.models[0].s_r + 1.0)
    machine = replace(run, result={**run.result, "plant": 7}, models=[model])
    z = np.ones((1, len(model.U)))
    a = model.K_a @ model.U.T @ z[0] + model.K_b @ model.s_r
    if run.values["law"] == "affine":
        np.testing.assert_allclose(machine.law("lqt")(0, z)[0], a, rtol=1e-9)


def test_its_parts_make_what_the_training_made(run, small) -> None:
    """Exploration, identification, design and rollouts one by one."""
    values = run.values
    method = {"method": values["identification"], "p": values["dmdc_rank"]}
    model = pdeloop.identify(
        small.explore(seed=5), n_s=len(run.models[0].A), constant=None, **method
    )
    for name in ("A", "B", "U"):
        assert same_bits(getattr(model, name), getattr(run.models[0], name))
    weights = {name: values[name] for name in ("state_weight", "action_weight")}
    gains = pdeloop.track(model, **weights)
    assert same_bits(gains.policy, run.warm[0])
    plant = small.plant(batch=2)
    assert plant.states.shape == (2, plant.n_z)
    fields = [derive(0, Purpose.EVALUATION_FIELD, i) for i in range(3)]
    for policy, costs in ((gains.policy, run.costs["lqt"]), (run.policies, run.costs["adapted"])):
        policies = np.repeat(policy, 3, axis=0) if policy.ndim == 3 else policy
        law = pdeloop.projected_law(plant, model.U, policies)
        assert same_bits(pdeloop.rollout(plant, law, fields).costs.mean, costs[0])


def test_what_a_session_shows_of_an_object_is_one_line(run, small) -> None:
    plant, trajectory = small.plant(), small.explore()
    model = pdeloop.identify(trajectory, n_s=2)
    gains = pdeloop.track(model, state_weight=1.0, action_weight=1.0)
    still = pdeloop.rollout(plant, lambda k, z: np.zeros((1, plant.n_a)), [0])
    for shown, words in (
        (pdeloop.problem("kdv", n_z=64), "Problem('kdv', n_z=64)"),
        (plant, "SpectralPlant(burgers: state of "),
        (model, "ReducedModel(order 2: "),
        (gains, f"Gains(K_a and K_b of {plant.n_a} x 2, closed loop of spectral radius 0."),
        (pdeloop.study_orders([trajectory]), "OrderStudy(order "),
        (still, f"EpisodeRecord({plant.horizon} steps of 1 environments, mean cost "),
        (run, "FinishedRun(small, 1 seeds, mean costs: none "),
    ):
        assert repr(shown).startswith(words)
        assert "\n" not in repr(shown) and len(repr(shown)) < 120


def test_a_law_saturates_where_the_plant_does() -> None:
    plant = pdeloop.problem(SMALL, action_limit=0.2).plant()
    law = pdeloop.projected_law(plant, np.eye(plant.n_z)[:, :2], np.full((plant.n_a, 4), 9.0))
    assert np.abs(pdeloop.rollout(plant, law, [0]).actions).max() == 0.2


def test_what_does_not_fit_is_refused_in_one_sentence(small) -> None:
    plant, (states, actions) = small.plant(), small.explore()
    n_z, n_a = plant.n_z, plant.n_a
    basis, gradients = np.eye(n_z)[:, :2], pdeloop.Gradients(plant)
    holes = np.where(np.arange(n_a) < 1, np.nan, np.zeros((plant.horizon, 1, n_a)))
    for refused, words in (
        (lambda: pdeloop.problem("burgerz"), "unknown problem 'burgerz'; did you mean 'burgers'?"),
        (lambda: pdeloop.problem(n_zz=4), "n_zz"),
        (lambda: pdeloop.problem(physical={"viscousity": 1.0}), "unknown parameter 'physical"),
        (lambda: pdeloop.problem(physical={"viscosity": np.nan}), "must lie between .* got nan"),
        (lambda: small.plant(batch=0), "batch is 0; expected a whole number of at least 1"),
        (lambda: small.plant(batch="2"), "batch is '2'; expected a whole number"),
        (
            lambda: pdeloop.identify((states, actions), n_s=2.5),
            "n_s is 2.5; expected a whole number",
        ),
        (lambda: pdeloop.identify((states + 1j, actions), n_s=2), "real numbers, got complex128"),
        (
            lambda: pdeloop.identify(("a", actions), n_s=2),
            "states must be an array of real numbers",
        ),
        (
            lambda: pdeloop.identify(([[1, 2], [3]], actions), n_s=2),
            "got rows of different lengths",
        ),
        (lambda: pdeloop.study_orders([]), "a list of trajectories"),
        (lambda: pdeloop.identify(n_s=2), "one trajectory or more"),
        (lambda: pdeloop.identify((states[1:], actions), n_s=2), "actions belong to"),
        (lambda: pdeloop.identify((np.nan * states, actions), n_s=2), "must be finite"),
        (lambda: pdeloop.identify((states, actions), n_s=2, method="dmd"), "expected 'regression'"),
        (lambda: pdeloop.projected_law(plant, basis[1:], np.zeros((n_a, 4))), "U must have shape"),
        (lambda: pdeloop.projected_law(plant, basis, np.zeros((n_a, 3))), "policy must have shape"),
        (lambda: pdeloop.study_orders((states, actions)), "a list of trajectories"),
        (lambda: pdeloop.problem(physical=3), "physical is 3; expected a dict"),
        (lambda: pdeloop.train(3), "problem is 3; expected a Problem or its name"),
        (lambda: pdeloop.load_run(3), "folder is 3; expected the path"),
        (lambda: pdeloop.identify(3, n_s=2), "each a tuple .states, actions."),
        (lambda: pdeloop.study_orders(3), "a list of trajectories"),
        (
            lambda: pdeloop.study_orders([(states, actions)], orders="ab"),
            "orders holds 'a'; expected whole numbers",
        ),
        (
            lambda: pdeloop.track(3, state_weight=1.0, action_weight=1.0),
            "model is 3; expected a ReducedModel",
        ),
        (lambda: pdeloop.rollout(3, lambda k, z: z, [0]), "plant is 3; expected a Plant"),
        (lambda: pdeloop.rollout(plant, 3, [0]), "law is 3; expected a function"),
        (lambda: pdeloop.rollout(plant, lambda k, z: z, [0]), "actions must have shape"),
        (lambda: pdeloop.rollout(plant, lambda k, z: z, 0), "must be M seeds, .* or an array"),
        (
            lambda: pdeloop.rollout(plant, lambda k, z: z, states[0]),
            "must be M seeds, .* or an array",
        ),
        (lambda: gradients.of_actions(np.zeros((3, 1, n_a)), [0]), "actions must have shape"),
        (lambda: gradients.of_actions(holes, [0]), "actions must be finite"),
        (lambda: gradients.of_actions(np.zeros_like(holes), 0), "must be M seeds, .* or an array"),
        (lambda: gradients.of_policy(basis.T, np.zeros((n_a, 4)), [0]), "U must have shape .*n_s"),
        (lambda: gradients.of_policy(basis, np.zeros((n_a, 5)), [0]), "policy must have shape"),
        (lambda: pdeloop.Gradients(pdeloop.problem(sensors=4).plant()), "without noise, limits"),
        (lambda: pdeloop.train(small, optimizer="adam"), "unknown optimizer 'adam'"),
        (lambda: pdeloop.train(small, over_topics=True), "needs a folder .* give out"),
        (lambda: pdeloop.load_run("/nowhere"), "no run in /nowhere"),
        (lambda: pdeloop.identify(states, actions, n_s=2), "each a tuple .states, actions."),
        (lambda: small.explore(-1), "'seed' is -1; expected a whole number"),
        (lambda: pdeloop.read_measurements("nothing.csv"), "nothing.csv"),
    ):
        with pytest.raises(ValueError, match=words) as caught:
            refused()
        assert "\n" not in str(caught.value)


def test_numbers_of_numpy_serve_as_parameters() -> None:
    given = {"horizon": np.int64(5), "process_noise": np.float32(0.5)}
    made = pdeloop.problem("burgers", physical={"viscosity": np.int64(1)}, **given)
    assert [type(made.values[name]) for name in given] == [int, float]
    assert made.values["physical.viscosity"] == 1.0


def test_a_training_that_is_stopped_by_a_service_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise Interruption("request")

    monkeypatch.setattr("pdeloop.api.carry_out", stopped)
    with pytest.raises(RuntimeError, match=r"stopped by request; continue with: .*/run"):
        pdeloop.train(str(SMALL), over_topics=True, out=tmp_path / "run")


def test_figures_show_what_the_arrays_hold(run, small) -> None:
    for draw in (
        pdeloop.plot_costs,
        pdeloop.plot_training,
        pdeloop.plot_behaviour,
        pdeloop.plot_gains,
        pdeloop.plot_spectrum,
    ):
        assert draw(run).axes
    learning = pdeloop.plot_training(run).axes[0].get_legend_handles_labels()
    crosses = dict(zip(learning[1], learning[0], strict=True))["exploration"]
    explored = [row["cost"] for row in run.measured if row["phase"] == "identify"]
    assert explored and np.array_equal(np.sort(crosses.get_ydata()), np.sort(explored))
    assert np.max(crosses.get_xdata()) <= 0.0
    plant = small.plant()
    episode = pdeloop.rollout(plant, lambda k, z: np.full((2, plant.n_a), k), [0, 1])
    field, actions, _ = pdeloop.plot_episode(plant, episode, environment=1).axes
    assert np.array_equal(field.images[0].get_array(), episode.fields[:, 1].T)
    assert np.array_equal(actions.lines[0].get_ydata()[:-1], np.arange(plant.horizon))
    with pytest.raises(ValueError, match="environment is 2; expected one of the 2"):
        pdeloop.plot_episode(plant, episode, environment=2)


def test_the_trajectories_of_a_recorded_run_are_the_plants_own(tmp_path: Path) -> None:
    small, out = pdeloop.problem(SMALL), tmp_path / "run"
    run = pdeloop.train(small, out=out, **TWO_POINT)
    changed = replace(run, policies=run.policies + 1.0)
    with pytest.raises(ValueError, match="was not recorded, and gave another policy"):
        list(changed.trajectories())
    shutil.copytree(Path(__file__).parents[1] / "data" / "bag_0_1", out / "bag")
    first, *others = pdeloop.load_run(out).trajectories()
    plant, lengths = small.plant(), set()
    for episode in (first, *others):
        again = pdeloop.rollout(plant, lambda k, z, a=episode.actions: a[k], episode.states[0])
        np.testing.assert_allclose(again.states, episode.states, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(again.costs.mean, episode.costs.mean, rtol=1e-9)
        assert (episode.costs.diverged_step == -1).all()
        lengths.add(len(episode.actions))
    assert lengths == {small.values["horizon"]} and len(others) > 3
    pdeloop.identify((first.states[:, 0], first.actions[:, 0]), n_s=2)


@pytest.mark.parametrize("call", [pdeloop.problem, pdeloop.train])
@pytest.mark.parametrize(
    ("problem", "given", "meant"),
    [
        ("burgers", {"viscosity": 2e-3}, "physical={'viscosity': 0.002}"),
        ("allen-cahn", {"diffusivty": 1}, "physical={'diffusivity': 1}"),
        ("wave", {"speed": 2.0}, "physical={'speed': 2.0}"),
    ],
)
def test_a_parameter_of_the_equation_is_told_where_it_belongs(call, problem, given, meant) -> None:
    with pytest.raises(ValueError, match=re.escape(f"did you mean the equation's own, {meant}?")):
        call(problem, **given)


def test_a_training_takes_the_equations_parameters_as_a_problem_does() -> None:
    physical = {"viscosity": 2e-3}
    run = pdeloop.train(str(SMALL), physical=physical, **TWO_POINT)
    other = pdeloop.train(pdeloop.problem(SMALL, physical=physical), **TWO_POINT)
    assert run.values["physical.viscosity"] == 2e-3 and same_bits(run.policies, other.policies)
    with pytest.raises(ValueError, match="physical is 3; expected a dict of names and numbers"):
        pdeloop.train(str(SMALL), physical=3)
