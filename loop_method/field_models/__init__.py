# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models of the whole field of a plant, identified from its trajectories."""

from loop_method.field_models.convolution import ConvolutionModel
from loop_method.field_models.differential import DifferentialModel
from loop_method.field_models.sensed import SensedModel

FieldModel = ConvolutionModel | DifferentialModel | SensedModel
"""A model z_{k+1} = step(z_k, a_k) with its jacobians."""
