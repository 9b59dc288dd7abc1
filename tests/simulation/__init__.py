# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The protocols of plant, controller and tuner, as they are, over a network in virtual time.

    python -m tests.simulation --seeds 0 10000

A seed gives a plan: rates of loss, duplication and delay, and faults at points of virtual time. The
same seed gives the same history, to the bit. The auditor (`audit`) knows only the policy of the
training in one process: a history ends with the same bits, or with an error that names a cause.
"""
