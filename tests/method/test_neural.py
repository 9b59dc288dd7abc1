# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The law with a network: what its theta holds, its derivatives, its training, and its exports."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import pdeloop
from controller_node.law_batch import LawBatch
from pdeloop.evaluation import evaluate
from pdeloop.export import law_of
from pdeloop.law_form import law_form
from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.cost import Cost
from pdeloop.messages.spec import ParameterError
from pdeloop.method.adapt.improve import mixtures
from pdeloop.method.adapt.network import ModelBasedNeural, Network, NetworkTraining
from pdeloop.method.laws import FeedForward, Law, Neural, plans
from pdeloop.method.laws.neural import Layers, NeuralSettings
from pdeloop.method.laws.plans import Planner, simulated
from pdeloop.model_files import matlab, onnx
from tests.method.test_plans import N_A, N_Z, T, spectral
from tests.method.test_predictive import (
    ROWS,
    STATES,
    U,
    actions_of,
    measured,
    start,
)
from tests.method.test_predictive import (
    optimizer as planned,
)
from tests.support.planned import PROBLEM, trained
from tests.tools.test_law_gradients import SEEDS, Cubic
from tests.tools.test_law_gradients import law_of as law_of_cubic
from tuner_node.narration import closing_lines

H = 4
RNG = np.random.default_rng(3)


def with_network(law: Neural, scale: float = 0.3) -> np.ndarray:
    rng, n_a, n_s = np.random.default_rng(5), law.n_a, len(law.model.s_r)
    shapes = (H, n_s + n_a * law.depends_on_step), (H,), (n_a, H), (n_a,)
    layers = Layers(*(scale * rng.standard_normal(shape) for shape in shapes))
    return law.theta_of(law.theta_start, law.model.K_a, layers)


def test_zeros_at_the_end_of_theta_mean_nothing() -> None:
    own = Neural(ROWS, T)
    whole = with_network(own)
    acted = actions_of(own, whole)
    assert own.acting(whole) == "neural" and not own.has_gains(whole)
    assert np.array_equal(actions_of(own, np.append(whole, np.zeros(9))), acted)
    m = own.matrices(whole)
    s = STATES @ U
    expected = s @ m["K"].T + m["c"] + np.tanh(s @ m["W"].T + m["w"]) @ m["D"].T
    np.testing.assert_allclose(acted, expected, rtol=1e-12)
    assert not np.allclose(acted, actions_of(own, own.theta_start))


def moving(law: type[Law] = Neural) -> Law:
    """Of a target that moves."""
    made = law(ROWS, T)
    waves = np.sin(np.arange(T)[:, None] / 5.0 + np.arange(N_Z))
    made.cost = Cost(N_Z, N_A, T, action_weight=0.5, target=waves)
    return made


def test_where_the_target_moves_the_network_knows_what_each_step_asks_for() -> None:
    own, plain = moving(), moving(FeedForward)
    assert isinstance(own, Neural) and np.array_equal(own.theta_start, plain.theta_start)
    steps = range(len(STATES))
    parts = plain.parts(plain.theta_start)
    expected = [plain.action(parts, z, np.zeros(0), k) for k, z in enumerate(STATES)]
    assert np.array_equal(actions_of(own, own.theta_start), expected)
    whole = with_network(own)
    m, acted = own.matrices(whole), actions_of(own, whole)
    assert m["w"].shape == (T, H) and np.ptp(m["w"], axis=0).min() > 0.0
    hidden = np.tanh(STATES @ U @ m["W"].T + m["w"][steps])
    np.testing.assert_allclose(acted, STATES @ U @ m["K"].T + m["c"][steps] + hidden @ m["D"].T)
    y, k, parts = RNG.standard_normal(N_A), 4, own.parts(whole)
    by_theta, by_z, _ = own.pull_back(parts, STATES[0], np.zeros(0), k, y)
    d, e = 1e-6 * RNG.standard_normal(len(whole)), 1e-6 * RNG.standard_normal(N_Z)
    d[own.without.size] = 0.0  # the number of neurons
    up, down = (
        own.action(own.parts(whole + s * d), STATES[0] + s * e, np.zeros(0), k) for s in (1, -1)
    )
    assert y @ (up - down) / 2.0 == pytest.approx(own.vector(by_theta) @ d + by_z @ e, rel=1e-6)


def test_numbers_that_are_no_network_are_refused() -> None:
    own = Neural(ROWS, T)
    whole = with_network(own)
    for size, wrong in ((own.size + 9, whole[own.size]), (len(whole), 0.5), (len(whole), 1e9)):
        broken = whole[:size].copy()
        broken[own.size] = wrong
        with pytest.raises(ValueError, match="its network has"):
            own.layers(own.parts(broken)["network"])


def test_its_derivatives_agree_with_finite_differences() -> None:
    law = law_of_cubic(Neural)
    assert isinstance(law, Neural)
    theta, gradients = with_network(law), pdeloop.Gradients(Cubic())
    fields, count = gradients.plant.reset(SEEDS).copy(), law.size
    found = gradients.of_theta(law, theta, fields)
    assert found.gradient[count] == 0.0
    for _ in range(3):
        d, e = RNG.standard_normal(len(theta)), RNG.standard_normal(fields.shape)
        d[count] = 0.0  # the number of neurons
        up, down = (gradients.of_theta(law, theta + h * d, fields).cost for h in (1e-5, -1e-5))
        assert (up - down) / 2e-5 == pytest.approx(found.gradient @ d, rel=1e-6)
        up, down = (gradients.of_theta(law, theta, fields + h * e).cost for h in (1e-5, -1e-5))
        assert (up - down) / 2e-5 == pytest.approx((found.of_fields * e).sum(), rel=1e-6)


QUICK = {"iterations": 1, "first": 5, "starts": 1}


def training(
    allowed: ActionSet, law: Neural, noise: float = 0.0
) -> tuple[NetworkTraining, Network, np.ndarray]:
    K, b = law.feedback(law.parts(law.theta_start))
    cost = law.cost or Cost(N_Z, N_A, T, action_weight=0.5, target=np.full(N_Z, 0.3))
    planner = Planner(
        spectral(), cost, allowed, K @ U.T, b, around=True, steps=6, terminal=True, **QUICK
    )
    fields = np.stack([start(seed) for seed in range(6)])
    states = simulated(planner, fields, plans.planned(planner))[1].reshape(-1, N_Z)
    curvature = np.array([[2.0, 0.3], [0.3, 1.0]])
    network = Network.of(U, K, b, states, curvature, 3.0, H)
    made = NetworkTraining(network, planner, fields, [1, 2], mixtures, noise)
    return made, network, fields


@pytest.mark.parametrize(
    "allowed",
    [ANY_ACTION, ActionSet(N_A, -0.05, 0.04), ActionSet(N_A, -0.5, 0.5, rate=[0.02, np.inf])],
    ids=["free", "bounded", "rated"],
)
@pytest.mark.parametrize(("k", "law"), [(0, Neural(ROWS, T)), (3, moving())])
def test_the_gradient_through_the_model_agrees_with_finite_differences(
    allowed: ActionSet, k: int, law: Neural
) -> None:
    made, network, fields = training(allowed, law)
    made._part, rng = T - k, np.random.default_rng(7)
    first = network.first(rng)
    numbers = first + 0.02 * rng.standard_normal(len(first))
    _, found = made.gradient(numbers, fields, k)
    for _ in range(3):
        d = rng.standard_normal(len(numbers))
        up, down = (made.gradient(numbers + h * d, fields, k)[0] for h in (1e-6, -1e-6))
        assert (up - down) / 2e-6 == pytest.approx(found @ d, rel=1e-5, abs=1e-7)


@pytest.fixture
def small_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a network is trained on is most of what its training costs."""
    for name, number in (("IMITATIONS", 300), ("LABELLED", 6), ("VISITED", 16), ("HELD_OUT", 8)):
        monkeypatch.setattr(f"pdeloop.method.adapt.network.{name}", number)


@pytest.mark.parametrize("own", [Neural(ROWS, T), moving()], ids=["fixed", "moving"])
@pytest.mark.usefixtures("small_samples")
def test_a_trained_network_costs_less_on_other_fields_and_is_the_law_of_its_theta(
    own: Neural,
) -> None:
    made, network, _ = training(ANY_ACTION, own)
    first = network.first(RNG)
    numbers, others = made.trained(25), np.stack([start(seed) for seed in range(20, 40)])
    before, after = (made.costs(each, others).mean() for each in (first, numbers))
    assert after < 0.97 * before
    theta = own.theta_of(own.theta_start, *network.folded(numbers))
    expected = network.forward(network.parts(numbers), STATES, np.arange(len(STATES)))[0]
    np.testing.assert_allclose(actions_of(own, theta), expected, atol=1e-10)


def optimizer() -> ModelBasedNeural:
    """Of a plant that is the spectral model, judged by rollouts of it."""
    made = planned(kind=Neural, constants=NeuralSettings(neurons=H, iterations=10))
    assert isinstance(made, ModelBasedNeural)
    return made


@pytest.mark.usefixtures("small_samples")
def test_an_optimiser_continues_from_its_state_to_the_bit() -> None:
    own, law, rows = optimizer(), Neural(ROWS, T), []
    while not own.done:
        results = [measured(law, rollout) for rollout in own.ask()]
        rows.append(own.tell(results))
        other = optimizer()
        other.restore(own.state())
        assert np.array_equal(other.policy, own.policy) and other.done == own.done
        assert all(
            np.array_equal(a.policy, b.policy) for a, b in zip(own.ask(), other.ask(), strict=True)
        )
        own = other
    assert rows[-1]["role"] == "judging" and rows[-1]["chosen"] in ("neural", "adapted")
    assert rows[-1]["cost"] == pytest.approx(rows[-1]["predicted"], rel=0.05)


def test_it_is_trained_evaluated_and_exported(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = trained(tmp_path_factory, "neural")
    run = pdeloop.load_run(out)
    *_, before, last = run.result["history"]
    assert last["chosen"] == "neural" and before["network_saves"] > 0.0
    assert run.costs["adapted"].mean() < run.costs["lqt"].mean()
    costs = evaluate(run, fields=2, seed=run.values["evaluation_seed"])
    assert np.array_equal(costs["adapted"], run.costs["adapted"])
    closing = "\n".join(closing_lines(PROBLEM, run.result, out))
    assert "the law that acts is neural (the law with a network costs" in closing
    states = RNG.standard_normal((5, 32))
    expected = actions_in_loop(run.laws[0], run.policies[0], ANY_ACTION, states)
    form = law_form(run)
    with pytest.raises(ParameterError, match="write it as C, an FMU or an ONNX model"):
        matlab(form)
    if importlib.util.find_spec("onnx") and importlib.util.find_spec("onnxruntime"):
        monkeypatch.setenv("TMPDIR", str(tmp_path))  # where its import leaves a file
        import onnxruntime

        session = onnxruntime.InferenceSession(onnx(form), providers=["CPUExecutionProvider"])
        found = [session.run(None, {"y": z})[0] for z in states]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    assert b"tanh" in law_of(run).c()


def actions_in_loop(
    law: Neural, theta: np.ndarray, allowed: ActionSet, states: np.ndarray
) -> np.ndarray:
    batch = LawBatch([law], np.ones(states.shape[1]), allowed)
    batch.set(theta[None])
    return np.stack([batch.actions(k, z[None])[0] for k, z in enumerate(states)])


def test_what_it_does_not_support_is_refused_in_a_sentence() -> None:
    with pytest.raises(ParameterError, match="acts on the whole state, but 8 sensors"):
        pdeloop.train("burgers", law="neural", sensors=8)
    with pytest.raises(ParameterError, match="at most 2,048 numbers, but the plant has 2,100"):
        pdeloop.train("burgers", law="neural", n_z=2100)
    with pytest.raises(ParameterError, match="choose model_based, or another law"):
        pdeloop.train("burgers", law="neural", optimizer="two_point")
