"""Models of the whole field of a plant, identified from its trajectories."""

from loop_interfaces.field_models.convolution import ConvolutionModel
from loop_interfaces.field_models.differential import DifferentialModel

FieldModel = ConvolutionModel | DifferentialModel
"""A model z_{k+1} = step(z_k, a_k) with its jacobians."""
