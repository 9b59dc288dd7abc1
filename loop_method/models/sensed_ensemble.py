# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Several equations of a field between few sensors, for simulations of what is uncertain in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from loop_interfaces.arrays import Array
from loop_method.models.sensed import SensedModel, sensed_model
from loop_method.models.settings import FieldModelSettings


@dataclass(frozen=True, eq=False)
class SensedEnsemble(SensedModel):
    """The newest equation, and earlier ones: environments follow them in turn.

    Its attributes are those of the newest equation, which is also the one that is linearised.
    Environment i follows member i modulo their number: where there are fewer environments than
    members, only the newest members count.

    Attributes
    ----------
    members : sequence of SensedModel
        The newest one first.
    """

    members: Sequence[SensedModel] = field(kw_only=True)

    def _alike(self, states: Array) -> Iterator[tuple[SensedModel, slice]]:
        """The rows that follow each member."""
        for i, model in enumerate(self.members[: len(states)]):
            yield model, slice(i, None, len(self.members))

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        return self.members[0].linearise(state, action)


def ensemble(
    model: SensedModel, earlier: Sequence[Array], settings: FieldModelSettings
) -> SensedEnsemble:
    """The model, and the equations with these other unknowns, each (44 + n_a,)."""
    others = [
        sensed_model(shared, model.sensors, model.actuators, model.largest, settings)
        for shared in earlier
    ]
    parts = {name: getattr(model, name) for name in SensedModel.__dataclass_fields__}
    return SensedEnsemble(**parts, members=(model, *others))
