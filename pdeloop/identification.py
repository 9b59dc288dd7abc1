# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop identify`: a reduced model, and its LQ-tracking gains, from recorded trajectories.

Only states, actions and the target are used, so the plant may be any, this one or a real one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from controller_node.identification import DesignSettings, design, examined
from loop_interfaces.arrays import Array
from loop_interfaces.episodes import episode_name
from loop_interfaces.files import write_atomically
from loop_interfaces.model_rows import ModelRows, pack
from loop_interfaces.parameters import as_recorded, model_order, recorded_values, table
from loop_interfaces.spec import ParameterError
from loop_interfaces.topics import COMPLETED, CostColumn
from loop_method.reduce.channels import NUMBERED, Channels
from loop_method.reduce.identifiability import Identifiability, NotIdentifiableError
from loop_method.reduce.order import OrderStudy, study_orders
from loop_method.reduce.reduced_model import steps_of
from pdeloop.data_file import read_measurements

if TYPE_CHECKING:
    from pdeloop.bags.episodes import RecordedEpisode

Trajectories = Sequence[tuple[Array, Array]]


@dataclass(frozen=True)
class Identified:
    """A model from trajectories.

    sources: which trajectories, by episode and environment or by number; study: the orders on held-out
    data, None where these are too few; determined: how well the data determine the model; sample_time
    in s, None where it is not known.
    """

    model: ModelRows
    sources: list[dict[str, int]]
    steps: int
    study: OrderStudy | None
    determined: Identifiability
    sample_time: float | None = None

    def summary(self) -> dict[str, Any]:
        """The result as data, without the arrays, which `save` writes."""
        A, B, U, study = self.model.A, self.model.B, self.model.U, self.study
        determined = self.determined
        poles = np.linalg.eigvals(A)
        return {
            "reduced_order": len(A),
            "n_z": U.shape[0],
            "n_a": B.shape[1],
            "steps": self.steps,
            "sample_time": self.sample_time,
            "trajectories": self.sources,
            "poles": [[pole.real, pole.imag] for pole in poles],
            "spectral_radius": float(np.abs(poles).max()),
            "rank": determined.rank,
            "unknowns": determined.unknowns,
            "smallest_singular_value": determined.smallest_singular_value,
            "independence": determined.independence.tolist(),
            "warnings": list(determined.remarks),
            "suggested_order": study and study.suggested,
            "singular_values": [] if study is None else study.singular_values.tolist(),
            "orders": [] if study is None else study.rows(),
        }

    def text(self) -> str:
        """The result for people."""
        known = self.summary()
        used = "; ".join(map(_source_text, self.sources[:6]))
        more = f"; and {len(self.sources) - 6} more" if len(self.sources) > 6 else ""
        trajectories = (
            "1 trajectory" if len(self.sources) == 1 else f"{len(self.sources)} trajectories"
        )
        lines = [
            f"reduced model of order {known['reduced_order']} from {self.steps} steps of "
            f"{trajectories} ({used}{more})",
            f"  {known['n_z']} points, {known['n_a']} actuators, "
            f"spectral radius {known['spectral_radius']:.4f}",
        ]
        if self.sample_time is not None:
            rates = np.log(np.abs(np.linalg.eigvals(self.model.A))) / self.sample_time
            lines.append(f"  modes grow at rates of {rates.min():.3g} to {rates.max():.3g} 1/s")
        own = self.determined.independence
        lines.append(
            f"  rank {known['rank']} of {known['unknowns']}, smallest singular value "
            f"{known['smallest_singular_value']:.2g}; the inputs move by themselves to "
            f"{100 * min(own.min(), 1.0):.0f} % or more"
        )
        if self.study is None:
            lines.append("  too few steps to hold some out: no order is suggested")
        else:
            lines += ["", self.study.text()]
        return "\n".join(lines)


def _source_text(source: Mapping[str, int]) -> str:
    names = {
        what: episode_name(number) if what == "episode" else number
        for what, number in source.items()
    }
    return ", ".join(f"{what} {name}" for what, name in names.items())


def identify_file(path: Path, given: Mapping[str, Any]) -> Identified:
    """The model from measurements in a file; see `pdeloop.data_file`, and `given` as below."""
    found = read_measurements(path)
    sources = [{"trajectory": number} for number in range(len(found.trajectories))]
    known = {"sample_time": found.sample_time}
    return _identified(found.trajectories, found.target, sources, known, given)


def identify_bag(
    path: Path,
    given: Mapping[str, Any],
    *,
    episode: int | None = None,
    environment: int | None = None,
) -> Identified:
    """The model from the complete episodes of the bag at `path`.

    given: parameters (reduced_order, identification, dmdc_rank, state_weight, action_weight) that
    replace those of the recorded run, which replace the defaults; episode, environment: only this
    one; otherwise the exploratory episodes, or all if there are none.
    """
    from pdeloop.bags.reader import Bag  # here, as it needs the extra `record`
    from recorder_node.bag import BagError

    bag = Bag(path)
    chosen = [e for e in bag.episodes() if episode in (None, e.number) and _usable(e)]
    if any(e.exploratory for e in chosen):
        chosen = [e for e in chosen if e.exploratory]
    if not chosen:
        which = "complete episode" + (f" {episode_name(episode)}" if episode is not None else "")
        raise BagError(f"{bag.path} holds no {which} to identify from (see pdeloop bag info)")
    target = bag.target()
    if target is None:
        raise BagError(f"{bag.path} holds no target, without which no gains can be designed")
    trajectories, sources = [], []
    for one in chosen:
        states, actions = one.trajectory()
        for env in range(states.shape[1]):
            if environment in (None, env):
                trajectories.append((states[:, env], actions[:, env]))
                sources.append({"episode": one.number, "environment": env})
    if not trajectories:
        raise BagError(f"the chosen episodes have no environment {environment}")
    told = as_recorded(bag.parameters().get(chosen[-1].key[1], {}))
    known = {name: value for name, value in recorded_values(told).items() if name in told}
    return _identified(trajectories, target, sources, known, given)


def _identified(
    trajectories: Trajectories,
    target: Array,
    sources: list[dict[str, int]],
    recorded: Mapping[str, Any],
    given: Mapping[str, Any],
    channels: Channels = NUMBERED,
) -> Identified:
    if given.get("reduced_order", 0) > target.size:
        raise ParameterError(
            f"expected an order of at most {target.size}, the numbers of a state, got "
            f"{given['reduced_order']}"
        )
    values = {**recorded, **given}
    study, none = None, ""
    try:
        study = study_orders(trajectories, channels=channels)
    except NotIdentifiableError:  # whatever the order
        raise
    except ValueError as error:  # too few steps; the model itself may still be had
        none = str(error)
    defaults = {spec.name: spec.default for spec in table()} | {"reduced_order": 0}
    order = model_order({**defaults, **values}) or (study and study.suggested)
    if not order:
        raise ParameterError(f"no order can be suggested: {none}; or give one with --order")
    own = {"n_a": trajectories[0][1].shape[1], "reduced_order": order, "dmdc_order": order}
    settings = DesignSettings.of({**defaults, **values, **own})
    if given.get("dmdc_rank") and settings.identification != "dmdc":
        raise ParameterError(
            f"--rank is that of the identification dmdc, and this one is {settings.identification}: "
            "add --identification dmdc, or leave --rank out"
        )
    model = design(trajectories, target, settings, channels)
    method, p = settings.identification, settings.dmdc_rank
    determined = examined(trajectories, model, method=method, p=p, channels=channels)
    steps = len(steps_of(trajectories).inputs)
    return Identified(model, sources, steps, study, determined, values.get("sample_time"))


def save(found: Identified, path: Path) -> None:
    """Write the model as an .npz archive: A, B, U, K_a, K_b, s_r and `model`, the rows of the topic."""
    model = found.model
    arrays: dict[str, Any] = {name: getattr(model, name) for name in model.__dataclass_fields__}
    content = BytesIO()
    np.savez(content, model=pack(model)[np.newaxis], **arrays)
    try:
        write_atomically(path, content.getvalue())
    except OSError as error:
        raise ParameterError(f"cannot write {path}: {error.strerror}") from error


def _usable(episode: RecordedEpisode) -> bool:
    if episode.missing or episode.contradictions or episode.cost is None:
        return False
    return bool((episode.cost.values[:, CostColumn.ENDED] == COMPLETED).all())
