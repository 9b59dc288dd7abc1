# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models of the whole field of a plant, identified from its rollouts."""

from pdeloop.method.models.base import FieldModel, FieldModelSettings, Measured, affine_law
from pdeloop.method.models.selection import FittedModel, Selection

__all__ = ["FieldModel", "FieldModelSettings", "FittedModel", "Measured", "Selection", "affine_law"]
