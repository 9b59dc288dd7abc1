# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws that leave the project act as in the loop at every bound of the actuators."""

from __future__ import annotations

import ctypes
import io
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller_node.law_batch import LawBatch
from pdeloop.export import GainLaw, Parameters
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.laws import Affine, Law
from pdeloop.method.laws.linear import FeedForward, Observer
from pdeloop.method.laws.neural import Layers, Neural
from tests.tools.test_compare_and_export import DOUBLES, compiled

N_Z, N_S, N_A, N_H, T = 6, 3, 4, 5, 12
RNG = np.random.default_rng(0)
SETS = {
    "one side": ActionSet(N_A, 0.0, np.inf),
    "each its own": ActionSet(N_A, [0.0, -1.0, -np.inf, 0.2], [4.0, 2.0, 0.5, 0.25]),
    "a limit besides": ActionSet(N_A, 0.0, np.inf, limit=0.7),
    "zero mean": ActionSet(N_A, zero_mean=True),
    "zero mean within bounds": ActionSet(
        N_A, [0.0, -1.0, -0.5, -2.0], [0.4, 1.0, np.inf, 1.0], True
    ),
    "rate limits": ActionSet(
        N_A, [0.0, -1.0, -np.inf, -2.0], [4.0, 2.0, 0.5, 2.0], rate=[0.3, np.inf, 0.1, 0.5]
    ),
    "rate limits of mean zero": ActionSet(
        N_A, [-0.4, -1.0, -0.5, -2.0], [0.4, 1.0, np.inf, 1.0], True, rate=[0.3, np.inf, 0.1, 0.5]
    ),
    "none": ActionSet(N_A),
}
needs_compiler = pytest.mark.skipif(
    shutil.which("cc") is None, reason="needs a C compiler, the command cc (make packages)"
)


def model(filtered: bool = False) -> ModelRows:
    return ModelRows(
        A=0.3 * RNG.standard_normal((N_S, N_S)),
        B=RNG.standard_normal((N_S, N_A)),
        U=np.linalg.qr(RNG.standard_normal((N_Z, N_S)))[0],
        K_a=RNG.standard_normal((N_A, N_S)),
        K_b=RNG.standard_normal((N_A, N_S)),
        s_r=RNG.standard_normal(N_S),
        L=0.4 * np.eye(N_S) if filtered else None,
    )


class MovingNeural(Neural):
    """Of a target that moves."""

    def __init__(self, model: ModelRows, horizon: int) -> None:
        super().__init__(model, horizon)
        self.cost = Cost(N_Z, N_A, T, target=np.outer(np.arange(T), np.ones(N_Z)))


def acting(law: Law, allowed: ActionSet) -> np.ndarray:
    """Its actions in the loop along given states."""
    target = np.linalg.pinv(law.model.U.T) @ law.model.s_r
    batch = LawBatch([law], target, allowed)
    theta = theta_of(law)
    batch.set(theta[None] if law.extends else theta.reshape(1, *law.shape))
    return np.stack([batch.actions(k, z[None])[0] for k, z in enumerate(STATES)])


def theta_of(law: Law) -> np.ndarray:
    theta = law.theta_start.copy()
    rng = np.random.default_rng(1)
    theta += 0.1 * rng.standard_normal(theta.shape)
    if isinstance(law, Neural):
        K, _ = law.feedback(law.parts(theta))
        shapes = (N_H, N_S + N_A * law.depends_on_step), (N_H,), (N_A, N_H), (N_A,)
        theta = law.theta_of(theta, K, Layers(*(rng.standard_normal(shape) for shape in shapes)))
    return theta


def arguments(kind: type[Law], k: int, memory: Any) -> tuple[Any, ...]:
    """What the function takes before state and action."""
    return {Affine: (), Neural: (), FeedForward: (k,), MovingNeural: (k,)}.get(kind, (memory,))


STATES = 2.0 * RNG.standard_normal((T, N_Z))


def pointer(array: np.ndarray) -> Any:
    return array.ctypes.data_as(DOUBLES)


MOVING = Cost(N_Z, N_A, T, target=np.sin(np.arange(T * N_Z)).reshape(T, N_Z))


@needs_compiler
@pytest.mark.parametrize(
    ("kind", "cost"),
    [
        (Affine, None),
        (FeedForward, None),
        (Observer, None),
        (Observer, MOVING),
        (Neural, None),
        (MovingNeural, None),
    ],
)
def test_c_acts_as_the_loop_at_every_bound(
    tmp_path: Path, kind: type[Law], cost: Cost | None
) -> None:
    law = kind(model(kind.filtered), T)
    if cost is not None:
        law.cost = cost
    theta = theta_of(law)
    for i, (name, allowed) in enumerate(SETS.items()):
        source, expected = tmp_path / f"law{i}.c", acting(law, allowed)
        assert (expected >= allowed.low - 1e-12).all() and (expected <= allowed.high + 1e-12).all()
        exported: Any = Parameters(law.name, theta, law.model, law, allowed, 0.1, name)
        if kind is Affine:
            gains = law.gains(theta)
            parts = {**law.model.arrays, "K_a": gains[:, :N_S], "K_b": gains[:, N_S:]}
            exported = GainLaw(ModelRows(**parts), allowed, 0.1, name)
        source.write_bytes(exported.c())
        function, a = compiled(source), np.broadcast_to(allowed.start, N_A).copy()
        memory = ctypes.create_string_buffer(8 * (1 + N_S))
        for k, z in enumerate(STATES):
            first: Any = {Affine: (), Neural: (), FeedForward: (k,), MovingNeural: (k,)}.get(
                kind, (memory,)
            )
            function(*first, pointer(z), pointer(a))
            np.testing.assert_allclose(a, expected[k], rtol=1e-9, atol=1e-11, err_msg=name)
        with np.load(io.BytesIO(exported.npz())) as kept:
            assert np.array_equal(kept["action_low"], np.broadcast_to(allowed.low, N_A))
            assert np.array_equal(kept["action_high"], np.broadcast_to(allowed.high, N_A))
            assert kept["zero_mean"] == allowed.zero_mean


@needs_compiler
@pytest.mark.parametrize("kind", [Affine, FeedForward, Observer, Neural, MovingNeural])
def test_what_is_not_finite_neither_passes_nor_stays(tmp_path: Path, kind: type[Law]) -> None:
    law = kind(model(kind.filtered), T)
    allowed = SETS["each its own"]
    exported: Any = Parameters(law.name, theta_of(law), law.model, law, allowed, 0.1, "it")
    if kind is Affine:
        exported = GainLaw(law.model, allowed, 0.1, "it")
    source = tmp_path / "law.c"
    source.write_bytes(exported.c())
    function, a = compiled(source), np.empty(N_A)
    memory = ctypes.create_string_buffer(8 * (1 + N_S))
    first: Any = {Affine: (), Neural: (), FeedForward: (0,), MovingNeural: (0,)}.get(
        kind, (memory,)
    )
    for bad in (np.nan, np.inf, -np.inf):
        for z in (STATES[0], np.where(np.arange(N_Z) == 2, bad, STATES[1]), STATES[2]):
            function(*first, pointer(np.ascontiguousarray(z)), pointer(a))
            assert np.isfinite(a).all()
            assert (a >= allowed.low).all() and (a <= allowed.high).all()
