# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The next policy to try, a function of the remembered trajectories.

With few sensors also of the equation that was fitted before, with which the next fit begins. It is one
of four kinds, the first that applies:

1. `sensed`: there are few point sensors, and a model of the field between them reproduces their
   readings.
2. `chaotic`: a model of the whole field reproduces the rollouts in pieces, but the plant forgets where
   it began.
3. `whole_field`: a model of the whole field reproduces the rollouts from beginning to end.
4. `local`: always; local models of the plant agree on a direction.

`proposer` chooses; `reproducing` fits and judges the models of the whole field.
"""

from loop_method.adapt.proposals.proposal import Proposal as Proposal
from loop_method.adapt.proposals.proposer import Proposer as Proposer
