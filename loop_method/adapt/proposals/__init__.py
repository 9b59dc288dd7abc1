# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The next policy to try, a function of the remembered trajectories.

With few sensors also of the equation that was fitted before, with which the next fit begins. It is one
of three kinds, the first that applies:

1. `sensed`: there are few point sensors, and a model of the field between them reproduces their
   readings.
2. `field`: a model of the whole field predicts the rollouts, or, of a plant that forgets where it
   began, pieces of them.
3. `local`: always; local models of the plant agree on a direction.

`proposer` chooses.
"""

from loop_method.adapt.proposals.proposal import Proposal as Proposal
from loop_method.adapt.proposals.proposer import Proposer as Proposer
