# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The tuner: optimisers, the training state machine, and the node that runs episodes."""
