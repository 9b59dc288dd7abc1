# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Mutants that nothing can find, and why."""

ARGUED: dict[tuple[str, str, str], str] = {
    (
        "pde_sim_node.lockstep",
        "self._repeats = 0",
        "removed",
    ): "whatever reads it comes after a state was sent, which sets it",
    (
        "tuner_node.pair",
        "void = topic == COST.name and bool((answer.values[:, -1:] == VOID).any())",
        "1 -> 2",
    ): "the column before it counts steps, which are not negative",
    (
        "controller_node.run_state",
        "self._furthest = -1",
        "1 -> 2",
    ): "it is compared once an episode was answered, whose first step is 0",
    (
        "controller_node.run_state",
        "self._claimed = NONE, -1",
        "1 -> 2",
    ): "the step is not looked at where the episode is none",
    (
        "controller_node.responder",
        "self._ended = (-1, -1)",
        "1 -> 2",
    ): "no run and no episode has either number",
    (
        "controller_node.exploration",
        "self.nbytes = 0",
        "0 -> 1",
    ): "a byte among the hundreds of megabytes that are allowed",
    (
        "pdeloop.messages.protocol",
        'return (int.from_bytes(state.digest(), "big") >> 11) or 1',
        "1 -> 2",
    ): "one of 2^53 texts has the digest 0",
    (
        "controller_node.law_batch",
        "self._next = 0",
        "0 -> 1",
    ): "it is compared once there is a policy, with which it is set",
    (
        "controller_node.law_batch",
        "self._next = 0",
        "removed",
    ): "it is compared once there is a policy, with which it is set",
    (
        "controller_node.responder",
        "self._served = (-1, -1)",
        "1 -> 2",
    ): "no run and no plant has either number",
    (
        "tuner_node.training_state",
        "if np.abs(training.models).max(initial=0.0) > _LARGEST:",
        "Gt -> GtE",
    ): "no model has a number that is the bound itself",
}
"""By module, line and change."""
