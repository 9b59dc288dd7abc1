# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law of a run as matrices, for exports that compute it elsewhere.

    affine:    a = P(K s + constant),       s = U^T y
    observer:  a = P(K p + D s + b),        p <- F p + G s + B a + c,    p = s at first,
               where the target moves with rows of b and c for each step
    neural:    a = P(K s + c + D tanh(W s + w))

with the nearest admissible action P(a), which rate limits make one near the action before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from controller_node.policy import ProjectedLaw
from pdeloop.finished_run import FinishedRun
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.spec import ParameterError
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.linear import Extended, Observer
from pdeloop.method.laws.neural import Neural


@dataclass(frozen=True, eq=False)
class LawForm:
    """A law as matrices.

    kind: affine, observer or neural; arrays: by the names above; action_set: admissible actions;
    sample_time: time (s) of a step; name: what it is the law of, in words; spectral_radius: largest
    magnitude of an eigenvalue of the closed loop on the identified model, without bounds.
    """

    kind: str
    arrays: Mapping[str, Array]
    action_set: ActionSet
    sample_time: float
    name: str
    spectral_radius: float

    def require_constant(self) -> None:
        """ParameterError for a law with constant parts for each step, of a target that moves."""
        if self.kind == "observer" and self.arrays["b"].ndim > 1:
            raise ParameterError(
                "a law with constant parts for each step has no such form; write it as C or an FMU"
            )

    def require_matrices(self) -> None:
        """ParameterError for a law with a network, or with constant parts for each step."""
        self.require_constant()
        if self.kind == "neural":
            raise ParameterError(
                "a law with a network has no such form; write it as C, an FMU or an ONNX model"
            )

    @property
    def n_y(self) -> int:
        """Numbers of a measurement."""
        return len(self.arrays["U"])

    @property
    def n_a(self) -> int:
        """Actuators."""
        return len(self.arrays["K"])


def law_form(run: FinishedRun, which: str = "adapted", seed: int | None = None) -> LawForm:
    """The matrices of a law; ParameterError for one that has none, or a seed that there is not."""
    theta, m = run.theta(which, seed).ravel(), run.index(seed)
    law, model = run.laws[m], run.models[m]
    if isinstance(law, Extended):
        law, theta = law.that_acts(theta)
    if law.has_gains(theta):
        projected = ProjectedLaw([model.U], run._target(model))
        gains, n_s = law.gains(theta), model.U.shape[1]
        constant: Array = np.zeros(len(gains))
        for j, number in enumerate(projected.reduced_targets[0]):  # as the loop adds them
            constant += gains[:, n_s + j] * number
        kind, arrays = "affine", {"U": model.U, "K": gains[:, :n_s], "constant": constant}
        loop = model.A + model.B @ arrays["K"]
    elif type(law) is Observer or (isinstance(law, ExtendedKalman) and not law.estimates(theta)):
        parts = law.parts(theta)
        own = {name: parts[name] for name in ("K", "D", "b", "F", "G", "c")}
        kind, arrays = "observer", {"U": model.U, "B": model.B, **own}
        B, K, D = model.B, own["K"], own["D"]
        loop = np.block([[model.A + B @ D, B @ K], [own["G"] + B @ D, own["F"] + B @ K]])
    elif isinstance(law, Neural) and not law.depends_on_step:
        own = law.matrices(theta)
        kind, arrays = "neural", {"U": model.U, **own}
        slope = own["D"] * (1.0 - np.tanh(own["W"] @ model.s_r + own["w"]) ** 2) @ own["W"]
        loop = model.A + model.B @ (own["K"] + slope)  # at the target
    else:
        steps = ", as it depends on the step" if isinstance(law, Neural) else ""
        raise ParameterError(
            f"the law '{law.name}' has no such form{steps}; train with --law affine or observer, or "
            "write its parameters as .npz"
        )
    return LawForm(
        kind,
        arrays,
        ActionSet.of(run.values),
        float(run.values["sample_time"]),
        f"The {which} law of {run.values['problem']}, seed {run.seeds[m]}",
        float(np.abs(np.linalg.eigvals(loop)).max()),
    )
