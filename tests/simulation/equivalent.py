# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Mutants that nothing can find, and why."""

ARGUED: dict[tuple[str, str, str], str] = {
    (
        "pde_sim_node.lockstep",
        "self._repeats = 0",
        "removed",
    ): "whatever reads it comes after a state was sent, which sets it",
    (
        "controller_node.answered_steps",
        "self._furthest = -1",
        "1 -> 2",
    ): "it is compared once an episode was answered, whose first step is 0",
    (
        "controller_node.answered_steps",
        "self._claimed = NONE, -1",
        "1 -> 2",
    ): "the step is not looked at where the episode is none",
    (
        "controller_node.responder",
        "self._served = (-1, -1)",
        "1 -> 2",
    ): "no run and no plant has either number",
}
"""By module, line and change."""
