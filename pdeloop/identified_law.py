# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The law of an identified model: its behaviour on that model, and how to apply it elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pdeloop.field_report import determined
from pdeloop.messages.arrays import Array
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.reduce.channels import SHOWN, Channels

if TYPE_CHECKING:
    from pdeloop.method.design.field_law import FieldLaw

SETTLED = 0.05
"""Share of the way from the first to the last state within which the loop counts as settled."""
DECAYED = 1e-3
"""Remaining share of the closed loop's slowest mode at the end of a long enough simulation."""
LONGEST = 10
"""Times as many steps as the recorded trajectory that are simulated at most."""
BEYOND = 0.01
"""Share of the recorded range of an action that it may leave it by."""
_OVERFLOW = 1e100


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """The law on the model, from the first recorded state.

    states (N + 1, n_z): U s_k; actions (N, n_a); target (n_z,); radius: spectral radius of A + B K_a;
    recorded: the lowest and the highest recorded value of each action, (2, n_a); model: its kind, of
    one of the whole field; variation: of the recorded states, the norm of their standard deviations.
    """

    states: Array
    actions: Array
    target: Array
    radius: float
    recorded: Array
    model: str = ""
    variation: float = 0.0

    @property
    def settled(self) -> int:
        """The step from which on the state is close to the last one."""
        distances = np.linalg.norm(self.states - self.states[-1], axis=1)
        far = np.flatnonzero(distances > SETTLED * distances[0])
        return int(far[-1]) + 1 if far.size else 0

    @property
    def left(self) -> float:
        """|U s_N - z_r|, relative to |U s_0 - z_r|; infinity if s_0 is there already."""
        first, last = (float(np.linalg.norm(self.states[k] - self.target)) for k in (0, -1))
        return last / first if first > 0.0 else float("inf") if last > 0.0 else 0.0

    @property
    def ends(self) -> tuple[float, str]:
        """How far from the target it ends, relative to where it begins or the variation; in words."""
        if np.isfinite(self.left):
            return self.left, f"with {100 * self.left:.3g} % of the distance to the target left"
        away = float(np.linalg.norm(self.states[-1] - self.target)) / max(self.variation, 1e-300)
        return (
            away,
            f"from the target to {100 * away:.3g} % of the variation of the log away from it",
        )

    def summary(self) -> dict[str, Any]:
        """The findings as data."""
        return {
            "spectral_radius": self.radius,
            "steps": len(self.actions),
            "settled_step": self.settled,
            "distance_left": self.left if np.isfinite(self.left) else None,
            "action_range": self.taken.tolist(),
            "recorded_range": self.recorded.tolist(),
        }

    @property
    def taken(self) -> Array:
        """The lowest and the highest value of each action, (2, n_a)."""
        return np.stack([self.actions.min(axis=0), self.actions.max(axis=0)])

    def text(self, channels: Channels, sample_time: float | None) -> list[str]:
        """Lines for people."""
        unit, step = (" steps", 1.0) if sample_time is None else (" s", sample_time)
        lines = [
            f"closed loop on the {self.model + ' ' * bool(self.model)}model, from the first recorded "
            "state",
            f"  spectral radius {self.radius:.4f}; settled after {self.settled * step:.3g}{unit}, "
            f"{self.ends[1]}",
        ]
        (low, high), (least, most) = self.taken, self.recorded
        room = BEYOND * (most - least)
        beyond = [
            f"{channels.input(j)} from {low[j]:.3g} to {high[j]:.3g}, recorded {least[j]:.3g} to "
            f"{most[j]:.3g}"
            for j in np.flatnonzero((low < least - room) | (high > most + room)).tolist()
        ]
        if not beyond:
            return [*lines, "  actions within the recorded ones"]
        if len(beyond) > SHOWN:
            beyond[SHOWN:] = [f"and {len(beyond) - SHOWN} others"]
        told = "; ".join(beyond)
        return [*lines, f"  actions beyond what the model was identified from: {told}"]


def closed_loop(
    law: ModelRows,
    target: Array,
    states: Array,
    actions: Array,
    field: FieldLaw | None = None,
) -> ClosedLoop:
    """Simulate s_{k+1} = A s_k + B a_k + d under a_k = K_a s_k + K_b s_r + b, from s_0 = U^T z_0.

    states (N + 1, n_z) and actions (N, n_a): the recorded trajectory whose first state it begins with.
    It runs for its length, or longer, until the slowest mode has decayed. field: the report on a model
    of the whole field, which is simulated in its place.
    """
    A, B, K, model = law.A, law.B, law.K_a, None
    closed = A + B @ K
    if field is not None and field.linear is not None and field.fitted is not None:
        K, model = K @ law.U.T, field.fitted.model
        closed = determined(field, field.linear.A + field.linear.B @ K)
    radius = float(np.abs(np.linalg.eigvals(closed)).max())
    needed = np.log(DECAYED) / np.log(min(max(radius, 0.01), 1.0 - 1e-9))
    steps = int(np.clip(np.ceil(needed), len(actions), LONGEST * len(actions)))
    s, forced = law.U.T @ states[0] if model is None else states[0], law.constant
    reduced, applied = [s], list[Array]()
    for _ in range(steps):
        a = K @ s + forced
        with np.errstate(all="ignore"):
            if model is None:
                after = A @ s + B @ a + (0.0 if law.d is None else law.d)
            else:
                after = model.step(s[None], a[None])[0]
        if applied and not np.abs(after).max() < _OVERFLOW:
            break
        s = after
        reduced.append(s)
        applied.append(a)
    recorded = np.stack([actions.min(axis=0), actions.max(axis=0)])
    seen = np.array(reduced) if model else np.array(reduced) @ law.measurement.T
    kind = model.kind if model else ""
    variation = float(np.linalg.norm(states.std(axis=0)))
    return ClosedLoop(seen, np.array(applied), target, radius, recorded, kind, variation)
