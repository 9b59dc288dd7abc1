# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Control laws behind one interface: see `pdeloop.method.laws.base`."""

from pdeloop.method.laws.base import Law as Law
from pdeloop.method.laws.extended_kalman import ExtendedKalman as ExtendedKalman
from pdeloop.method.laws.linear import Affine as Affine
from pdeloop.method.laws.linear import FeedForward as FeedForward
from pdeloop.method.laws.linear import Observer as Observer
from pdeloop.method.laws.neural import Neural as Neural
from pdeloop.method.laws.predictive import Predictive as Predictive
