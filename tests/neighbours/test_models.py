# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models and laws of other libraries: the lines of docs/neighbours.md that convert them."""

from __future__ import annotations

import re
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
import scipy  # whose modules load when they are used

import pdeloop
from benchmarks.families.sindy import fitted
from pdeloop.method.design.lqg import kalman_filter
from pdeloop.method.design.lqt import DesignError
from pdeloop.method.reduce.subspace import subspace_model
from tests.support.interpreter import ROOT

A = 0.95 * np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.7]])
B = np.array([[0.0, 0.1], [1.0, 0.0], [0.5, 1.0]])
C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 1.0]])
pytestmark = [  # in the docstrings of PyDMD, when it is compiled
    pytest.mark.filterwarnings(f"ignore:invalid escape sequence:{kind}")
    for kind in ("DeprecationWarning", "SyntaxWarning")
]
EXACT = 1e-9
"""Tolerance of eigenvalues and matrices from data without noise."""


def needs(module: str, package: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(
        find_spec(module) is None, reason=f"{package} is not installed: extra neighbours"
    )


def trajectory(N: int, seed: int = 0) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """States (N + 1, 3) and actions (N, 2)."""
    rng = np.random.default_rng(seed)
    z, a = np.empty((N + 1, 3)), rng.standard_normal((N, 2))
    z[0] = rng.standard_normal(3)
    for k in range(N):
        z[k + 1] = A @ z[k] + B @ a[k]
    return z, a


def poles(matrix: Any) -> np.ndarray[Any, Any]:
    found: np.ndarray[Any, Any] = np.sort_complex(np.linalg.eigvals(np.asarray(matrix)))
    return found


def agrees(model: pdeloop.ReducedModel, z: Any, a: Any) -> None:
    """It has the plant's eigenvalues, as has the model that is identified here, and its trajectory."""
    own = pdeloop.identify((z, a), n_s=3)
    for matrix in (model.A, own.A):
        np.testing.assert_allclose(poles(matrix), poles(A), atol=EXACT)
    states, _ = model.simulate(z[0], a)
    np.testing.assert_allclose(states, z, atol=1e-8)


def test_the_plant_is_found_by_our_own_methods() -> None:
    z, a = trajectory(400)
    agrees(pdeloop.identify((z, a), n_s=3, method="dmdc"), z, a)
    model = subspace_model([(z @ C.T, a)], order=3)
    np.testing.assert_allclose(poles(model.A), poles(A), atol=1e-6)


@needs("pydmd", "PyDMD")
def test_dmdc_of_pydmd() -> None:
    from pydmd import DMDc

    z, a = trajectory(50)
    dmdc = DMDc(svd_rank=-1).fit(z.T, a.T)
    U = dmdc.basis
    agrees(pdeloop.ReducedModel(dmdc.operator.as_numpy_array, U.T @ dmdc.B, U=U), z, a)
    np.testing.assert_allclose(dmdc.B, B, atol=EXACT)  # in the plant's own coordinates
    # Its default rank is that of noise: one of three modes here.
    assert len(DMDc().fit(z.T, a.T).eigs) == 1


@needs("pysindy", "pysindy")
def test_discrete_sindy() -> None:
    import pysindy

    parts = [trajectory(12, seed) for seed in range(6)]
    for unused in (0.0, 1e6):
        sindy = pysindy.DiscreteSINDy(
            optimizer=pysindy.STLSQ(threshold=0.0, alpha=0.0),
            feature_library=pysindy.PolynomialLibrary(degree=1, include_bias=False),
        )
        last = np.full((1, 2), unused)
        sindy.fit([z for z, _ in parts], t=1, u=[np.vstack([a, last]) for _, a in parts])
        found = sindy.coefficients()
        agrees(pdeloop.ReducedModel(found[:, :3], found[:, 3:]), *parts[0])


@needs("pysindy", "pysindy")
def test_the_rival_of_the_process_family_finds_products() -> None:
    """A plant of products of state and action is that of its model, whatever the units."""
    rng, units = np.random.default_rng(3), np.array([1.0, 300.0])

    def step(z: Any, a: Any) -> Any:
        x, y = (z - 20.0) / units
        return 20.0 + units * np.array(
            [0.9 * x + 0.1 * x * a[0] + 0.2 * a[1], 0.8 * y + 0.1 * x * x]
        )

    data = []
    for _ in range(6):
        z, a = [20.0 + units * rng.standard_normal(2)], rng.uniform(0.0, 2.0, (60, 2))
        for own in a:
            z.append(step(z[-1], own))
        data.append((np.array(z), a))
    model = fitted(data)
    states = 20.0 + units * rng.standard_normal((5, 2))
    actions = rng.uniform(0.0, 2.0, (5, 2))
    after = [step(z, a) for z, a in zip(states, actions, strict=True)]
    np.testing.assert_allclose(model.step(states, actions), after, rtol=1e-3, atol=1e-3 * 300)


@needs("nfoursid", "nfoursid")
def test_nfoursid() -> None:
    from nfoursid.nfoursid import NFourSID
    from nfoursid.state_space import StateSpace
    from pandas import DataFrame

    z, a = trajectory(400)

    def identified(y: Any, order: int) -> Any:
        table = DataFrame(np.hstack([a, y]), columns=["a1", "a2", "y1", "y2"])
        method = NFourSID(table, ["y1", "y2"], ["a1", "a2"], num_block_rows=6)
        method.subspace_identification()
        return method.system_identification(rank=order)[0]

    y = z @ C.T
    system = identified(y[:-1], 3)
    np.testing.assert_allclose(poles(system.a), poles(A), atol=EXACT)
    np.testing.assert_allclose(system.d, 0.0, atol=EXACT)
    # A log whose inputs are one row late has the same poles, and D = C B instead of 0.
    late = identified(y[1:], 3)
    np.testing.assert_allclose(poles(late.a), poles(A), atol=EXACT)
    np.testing.assert_allclose(late.d, C @ B, atol=EXACT)
    # An offset is a mode that never decays, which ours about the means does not have.
    np.testing.assert_allclose(poles(identified(y[:-1] + 5.0, 4).a)[-1], 1.0, atol=1e-6)
    ours = subspace_model([(y + 5.0, a)], order=3, constant=True)
    np.testing.assert_allclose(poles(ours.A), poles(A), atol=1e-2)
    # `step` returns the output before the step.
    before = StateSpace(A, B, C, np.zeros((2, 2)), x_init=z[0][:, np.newaxis]).step(a[:1].T)
    np.testing.assert_allclose(before.ravel(), y[0], atol=EXACT)


@needs("sippy_unipi", "SIPPY")
@pytest.mark.parametrize("method", ["N4SID", "MOESP", "CVA"])
def test_sippy(method: str) -> None:
    from sippy_unipi import system_identification

    z, a = trajectory(400)
    y = (z @ C.T)[:-1]
    found = system_identification(y.T, a.T, method, SS_fixed_order=3)
    np.testing.assert_allclose(poles(found.A), poles(A), atol=1e-6)
    plain = system_identification((y + 5.0).T, a.T, method, SS_fixed_order=3)
    centred = system_identification((y + 5.0).T, a.T, method, SS_fixed_order=3, centering="MeanVal")
    errors = [np.abs(poles(one.A) - poles(A)).max() for one in (plain, centred)]
    assert (errors[0] > 0.1 and errors[1] < 0.02) or (method == "CVA" and errors[1] > 0.1)


@needs("control", "python-control")
def test_systems_and_responses_of_python_control() -> None:
    import control

    z, a = trajectory(60)
    system = control.ss(A, B, C, 0, 0.1)
    # As many rows of inputs as of states: the last input is not used yet.
    given = np.vstack([a, a[-1:]]).T
    response = control.forced_response(system, 0.1 * np.arange(61), given, z[0])
    agrees(pdeloop.ReducedModel(A, B), response.states.T, response.inputs.T[:-1])
    whole = pdeloop.ReducedModel.of(control.ss(A, B, np.eye(3), 0, 0.1), 0.1)
    agrees(whole, z, a)
    # The impulse is 1 / dt high.
    pulse = control.impulse_response(system).outputs[:, :, 1]
    np.testing.assert_allclose(0.1 * pulse, C @ B, atol=EXACT)


@needs("control", "python-control")
def test_a_law_of_dlqr_acts_the_same_here() -> None:
    import control

    gains = pdeloop.track(pdeloop.ReducedModel(A, B), state_weight=1.0, action_weight=1.0)
    K, X, E = control.dlqr(A, B, np.eye(3), np.eye(2))
    np.testing.assert_allclose(-K, gains.K_a, atol=EXACT)
    np.testing.assert_allclose(X, gains.P, atol=1e-8)
    np.testing.assert_allclose(np.sort_complex(E), np.sort_complex(gains.poles), atol=EXACT)

    class Plant(pdeloop.Dynamics):
        n_z, n_a, horizon = 3, 2, 30

        def initial_state(self, rng: np.random.Generator) -> Any:
            return rng.standard_normal(3)

        def step(self, z: Any, a: Any) -> Any:
            return A @ z + B @ a

    episode = pdeloop.rollout(pdeloop.problem(plant=Plant()).plant(), lambda k, z: z @ -K.T, [3])
    start = episode.states[0, 0]
    there = control.initial_response(
        control.ss(A - B @ K, B, np.eye(3), 0, 1.0), np.arange(31.0), start
    )
    np.testing.assert_allclose(episode.states[:, 0], there.states.T, atol=1e-10)
    cost = sum(
        z @ z + a @ a for z, a in zip(episode.states[:-1, 0], episode.actions[:, 0], strict=True)
    )
    assert cost == pytest.approx(start @ X @ start, rel=1e-6)


@needs("control", "python-control")
def test_dlqe_gives_the_gain_of_the_predictor() -> None:
    import control

    W, V = 0.09 * np.eye(3), 0.04 * np.eye(2)
    L, P, _ = control.dlqe(A, np.eye(3), C, W, V)
    ours = kalman_filter(A, C, W, V)
    np.testing.assert_allclose(L, A @ ours.M, atol=EXACT)
    np.testing.assert_allclose(P, ours.P, atol=EXACT)
    # Its estimator's output does not contain the measurement of the same instant.
    system = control.ss(A, np.hstack([B, np.eye(3)]), C, 0, True)
    estimator = control.create_estimator_iosystem(system, W, V, control_indices=2)
    state, given = np.concatenate([np.zeros(3), P.ravel()]), np.array([5.0, 5.0, 0.0, 0.0])
    assert np.array_equal(estimator.output(0.0, state, given), np.zeros(3))
    np.testing.assert_allclose(estimator.dynamics(0.0, state, given)[:3], L @ given[:2], atol=EXACT)


@needs("slycot", "slycot")
def test_the_riccati_solver_of_slycot() -> None:
    from slycot import sb02od

    gains = pdeloop.track(pdeloop.ReducedModel(A, B), state_weight=1.0, action_weight=1.0)
    X = sb02od(3, 2, A, B, np.eye(3), np.eye(2), "D")[0]
    np.testing.assert_allclose(X, gains.P, atol=1e-8)


@needs("slycot", "slycot")
def test_an_unweighted_marginal_mode_is_refused_by_both() -> None:
    import control
    from slycot.exceptions import SlycotArithmeticError

    hold, Q = np.diag([1.0, 0.5]), np.diag([0.0, 1.0])
    with pytest.raises(SlycotArithmeticError):
        control.dlqr(hold, np.ones((2, 1)), Q, np.eye(1))

    class Plant(pdeloop.Dynamics):
        n_z, n_a, state_weight = 2, 1, Q

        def initial_state(self, rng: np.random.Generator) -> Any:
            return rng.standard_normal(2)

        def step(self, z: Any, a: Any) -> Any:
            return hold @ z + a

    cost = pdeloop.problem(plant=Plant()).plant().cost
    model = pdeloop.ReducedModel(hold, np.ones((2, 1)))
    with pytest.raises(DesignError):
        pdeloop.track(model, state_weight=1.0, action_weight=1.0, cost=cost)


def test_a_simulation_of_scipy_begins_before_the_first_step() -> None:
    """In `make test` too: it needs SciPy alone."""
    z, a = trajectory(30)
    system = scipy.signal.dlti(A, B, np.eye(3), np.zeros((3, 2)), dt=1.0)
    _, y, x = scipy.signal.dlsim(system, np.vstack([a, a[-1:]]), x0=z[0])
    np.testing.assert_allclose(y, z, atol=1e-10)
    agrees(pdeloop.ReducedModel.of(system, 1.0), x, a)


def test_only_a_held_input_leaves_the_state_what_it_is() -> None:
    """In `make test` too: of `signal.cont2discrete`, which python-control calls."""
    F, G = np.array([[-1.0, 0.5], [0.0, -2.0]]), np.array([[0.0], [1.0]])
    plant, h = (F, G, np.eye(2), np.zeros((2, 1))), 0.1
    discrete = scipy.signal.dlti(*scipy.signal.cont2discrete(plant, h)[:4], dt=h)
    held = pdeloop.ReducedModel.of(discrete, h)
    np.testing.assert_allclose(held.A, scipy.linalg.expm(h * F), atol=EXACT)
    ramp = np.zeros((4, 4))  # of x, u = t and 1
    ramp[:2, :2], ramp[:2, 2:3], ramp[2, 3] = F, G, 1.0
    exact = {
        "foh": ([[0.0], [h], [2 * h]], [scipy.linalg.expm(k * h * ramp)[:2, 3] for k in range(3)]),
        "impulse": (
            [[1 / h], [0], [0]],
            [scipy.linalg.expm(k * h * F) @ G[:, 0] for k in range(3)],
        ),
    }
    for method, (u, response) in exact.items():
        sampled = scipy.signal.dlti(*scipy.signal.cont2discrete(plant, h, method)[:4], dt=h)
        _, y, x = scipy.signal.dlsim(sampled, u)
        np.testing.assert_allclose(y, response, atol=EXACT)
        assert np.abs(x - response).max() > 1e-3
        with pytest.raises(ValueError, match="D of the system is not 0"):
            pdeloop.ReducedModel.of(sampled, h)


def test_the_page_has_the_pinned_versions() -> None:
    """In `make test` too."""
    page = (ROOT / "docs" / "neighbours.md").read_text()
    pins = (ROOT / "constraints.txt").read_text().lower().split()
    scripts = "".join(file.read_text() for file in (ROOT / "findings").glob("*.sh")).lower().split()
    rows = re.findall(r"^\| ([\w. -]+?) (\d[\d.]+)( †)?", page, flags=re.MULTILINE)
    assert len(rows) > 12
    for name, version, older in rows:
        package = name.removeprefix("python-").lower()
        assert f"{package}=={version}" in (scripts if older else pins), name
