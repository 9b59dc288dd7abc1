# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Control laws behind one interface: see `loop_method.laws.base`."""

from loop_method.laws.affine import Affine as Affine
from loop_method.laws.base import Law as Law
from loop_method.laws.extended_kalman import ExtendedKalman as ExtendedKalman
from loop_method.laws.feedforward import FeedForward as FeedForward
from loop_method.laws.observer import Observer as Observer
from loop_method.laws.predictive import Predictive as Predictive
