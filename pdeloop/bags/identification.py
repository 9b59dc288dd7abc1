"""`pdeloop identify`: a reduced model, and its LQ-tracking gains, from the episodes of a bag.

Only what was on the topics is used, so the plant may be any: this one, another one, a real one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller_node.identification import DesignSettings, design
from loop_interfaces.model_rows import ModelRows, pack
from loop_interfaces.parameters import as_recorded
from loop_interfaces.topics import COMPLETED, CostColumn
from pdeloop.bags.reader import Bag, RecordedEpisode
from recorder_node.bag import BagError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Identified:
    """A model from recorded episodes.

    sources: (episode, environment) of the trajectories used; live: whether the controller, from the
    same trajectory and the same settings, published the same model to the bit; None if it did not.
    """

    model: ModelRows
    sources: list[tuple[int, int]]
    steps: int
    live: bool | None

    def summary(self) -> dict[str, Any]:
        """The result as data, without the arrays, which `save` writes."""
        A, B, U = self.model.A, self.model.B, self.model.U
        return {
            "reduced_order": len(A),
            "n_z": U.shape[0],
            "n_a": B.shape[1],
            "steps": self.steps,
            "trajectories": [{"episode": n, "environment": m} for n, m in self.sources],
            "spectral_radius": float(np.abs(np.linalg.eigvals(A)).max()),
            "same_as_published": self.live,
        }

    def text(self) -> str:
        """The result for people."""
        known = self.summary()
        used = ", ".join(f"{number}/{env}" for number, env in self.sources[:6])
        more = f" and {len(self.sources) - 6} more" if len(self.sources) > 6 else ""
        lines = [
            f"reduced model of order {known['reduced_order']} from {self.steps} steps of "
            f"{len(self.sources)} trajectories (episode/environment {used}{more})",
            f"  {known['n_z']} points, {known['n_a']} actuators, "
            f"spectral radius {known['spectral_radius']:.4f}",
        ]
        if self.live is not None:
            same = "the same, to the bit, as" if self.live else "not the same as"
            lines.append(f"  {same} the model that the controller published")
        return "\n".join(lines)


def identify(
    path: Path,
    *,
    order: int | None,
    method: str | None = None,
    rank: int | None = None,
    episode: int | None = None,
    environment: int | None = None,
    weights: tuple[float | None, float | None] = (None, None),
) -> Identified:
    """The model from the complete episodes of the bag at `path`.

    order, method, rank, weights: n_s, the identification, p of dmdc, (q, r); those of the recorded
    run if not given, and least squares where it says nothing. episode,
    environment: only this one; otherwise the exploratory episodes, or all if there are none.
    """
    bag = Bag(path)
    recorded = bag.episodes() if episode is None else bag.find(episode)
    chosen = [e for e in recorded if _usable(e)]
    if any(e.exploratory for e in chosen):
        chosen = [e for e in chosen if e.exploratory]
    if not chosen:
        which = "complete episode" if episode is None else f"complete episode {episode}"
        raise BagError(f"{bag.path} holds no {which} to identify from (see pdeloop bag info)")
    known = bag.parameters().get(chosen[-1].key[1], {})
    recorded_with = as_recorded(known)
    how = method or recorded_with.get("identification", "regression")
    if how == "dmdc" and known.get("dmdc_order"):
        known = {**known, "reduced_order": known["dmdc_order"]}
    n_s = _parameter("order", order, known, "reduced_order")
    p = rank if rank is not None else int(known.get("dmdc_rank", 0))
    target = bag.target()
    if target is None:
        raise BagError(f"{bag.path} holds no target, without which no gains can be designed")
    trajectories, sources = [], []
    for one in chosen:
        states, actions = one.trajectory()
        for env in range(states.shape[1]):
            if environment in (None, env):
                trajectories.append((states[:, env], actions[:, env]))
                sources.append((one.number, env))
    if not trajectories:
        raise BagError(f"the chosen episodes have no environment {environment}")
    q = weights[0] if weights[0] is not None else float(known.get("state_weight", 1.0))
    r = weights[1] if weights[1] is not None else float(known.get("action_weight", 1.0))
    settings = DesignSettings(
        n_a=trajectories[0][1].shape[1],
        reduced_order=n_s,
        state_weight=q,
        action_weight=r,
        identification=how,
        dmdc_rank=p,
    )
    model = design(trajectories, target, settings)
    steps = sum(len(actions) for _, actions in trajectories)
    names = ("reduced_order", "state_weight", "action_weight")
    as_live = (n_s, q, r) == tuple(known.get(name) for name in names)
    as_live = as_live and how == recorded_with.get("identification")
    as_live = as_live and (how == "regression" or p == int(known.get("dmdc_rank", 0)))
    live = _same_as_live(model, chosen, sources) if as_live else None
    return Identified(model, sources, steps, live)


def save(found: Identified, path: Path) -> None:
    """Write the model as an .npz archive: A, B, U, K_a, K_b, s_r and `model`, the rows of the topic."""
    model = found.model
    arrays: dict[str, Any] = {name: getattr(model, name) for name in model.__dataclass_fields__}
    try:
        with path.open("wb") as file:
            np.savez(file, model=pack(model)[np.newaxis], **arrays)
    except OSError as error:
        raise BagError(f"cannot write {path}: {error.strerror}") from error


def _usable(episode: RecordedEpisode) -> bool:
    if episode.missing or episode.contradictions or episode.cost is None:
        return False
    return bool((episode.cost.values[:, CostColumn.ENDED] == COMPLETED).all())


def _parameter(what: str, given: int | None, known: dict[str, Any], name: str) -> int:
    if given is not None:
        return given
    if name not in known:
        raise BagError(f"the bag does not say which {what} to use; give it with --{what}")
    return int(known[name])


def _same_as_live(
    model: ModelRows, chosen: list[RecordedEpisode], sources: list[tuple[int, int]]
) -> bool | None:
    if len(sources) != 1:
        return None
    published = next(e.model for e in chosen if e.number == sources[0][0])
    if published is None:
        return None
    return bool(published.values[sources[0][1]].tobytes() == pack(model).tobytes())
