# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A controller in 160 lines: local sensors, saturated actuators. Nothing of pdeloop is imported.

Actuator j sees only y_j, the mean of the field over its own part of the grid, and the same mean r_j of
the target, and answers

    a_j = A_MAX tanh((p_j (r_j - y_j) + f_j r_j) / A_MAX).

The tuner improves p_j and f_j: they are the two columns of its `policy`, as [K_a K_b] with n_s = 1.
"""

import json

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, String

A_MAX, P, F = 2.0, 1.0, 0.0  # the limit of an actuator, and where p and f start
COMPLETED, VOID = -1.0, -2.0

VOLATILE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
NEWEST = QoSProfile(depth=8, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


def to_message(labels, header, values):
    """A Float64MultiArray: labelled row-major dims, data_offset 5, five header numbers."""
    message = Float64MultiArray()
    message.layout.data_offset = 5
    for axis, label in enumerate(labels):
        stride = int(np.prod(values.shape[axis:]))
        dim = MultiArrayDimension(label=label, size=values.shape[axis], stride=stride)
        message.layout.dim.append(dim)
    message.data = [float(x) for x in header] + values.ravel().tolist()
    return message


def from_message(message):
    """(run, episode, step, time, plant), values."""
    shape = [dim.size for dim in message.layout.dim]
    return list(message.data[:5]), np.array(message.data[5:]).reshape(shape)


def local_means(fields, n_a):
    """Means (M, n_a) of fields (M, n_z) over the parts of the grid that belong to the actuators."""
    parts = np.array_split(fields, n_a, axis=1)
    return np.stack([part.mean(axis=1) for part in parts], axis=1)


def law(policy, fields, target):
    """Actions (M, n_a) of fields (M, n_z) under policies (M, n_a, 2)."""
    n_a = policy.shape[1]
    y, r = local_means(fields, n_a), local_means(target[None], n_a)
    return A_MAX * np.tanh((policy[..., 0] * (r - y) + policy[..., 1] * r) / A_MAX)


class SaturatedController(Node):
    def __init__(self):
        super().__init__("saturated_controller")
        self.n_a = self.declare_parameter("n_a", 6).value
        self.targets, self.start, self.policy, self.waiting = {}, None, None, None
        self.result = None  # of an exploratory episode
        self.actions = self.create_publisher(Float64MultiArray, "action", VOLATILE)
        self.models = self.create_publisher(Float64MultiArray, "model/identified", LATCHED)
        self.failures = self.create_publisher(String, "model/failed", LATCHED)
        for topic, callback, qos in (
            ("target", self.on_target, LATCHED),
            ("episode/start", self.on_start, LATCHED),
            ("policy", self.on_policy, LATCHED),
            ("state", self.on_state, NEWEST),
            ("episode/cost", self.on_cost, LATCHED),
        ):
            self.create_subscription(Float64MultiArray, topic, callback, qos)

    def on_target(self, message):
        header, target = from_message(message)
        self.targets[header[4]] = target  # by the plant that it belongs to
        self.answer()

    def on_start(self, message):
        header, rows = from_message(message)
        known = self.start[0] if self.start is not None else [0, 0]
        if not rows.size:
            self.start = None if known[0] == header[0] else self.start  # its run is over
        elif known != header[:2]:
            self.start, self.result = (header[:2], rows), None
        elif self.result is not None:  # the start again: the result may have been lost
            publisher, result = self.result
            publisher.publish(result)
        self.answer()

    def on_policy(self, message):
        header, values = from_message(message)
        self.policy = header[:2], values
        self.answer()

    def on_state(self, message):
        self.waiting = from_message(message)
        self.answer()

    def answer(self):
        """Answer the newest state as soon as everything that belongs to it has arrived."""
        if self.waiting is None or self.start is None:
            return
        header, fields = self.waiting
        episode, rows = self.start
        if header[:2] != episode:
            return
        if rows[0, 1] >= 0:  # explore: draws that depend on the excitation's seed and the step only
            draws = [np.random.default_rng([int(e), int(header[2])]) for e in rows[:, 1]]
            noise = np.array([rng.standard_normal(self.n_a) for rng in draws])
            actions = np.sqrt(rows[:, 2:3]) * noise
        elif self.policy is None or self.policy[0] != episode or header[4] not in self.targets:
            return
        else:
            actions = law(self.policy[1], fields, self.targets[header[4]])
        self.waiting = None  # a repeated state is answered again
        self.actions.publish(to_message(["env", "actuator"], header, actions))

    def on_cost(self, message):
        """After an exploratory episode: where the policy starts, in the shape of a reduced model."""
        header, costs = from_message(message)
        if self.start is None or self.start[0] != header[:2] or self.start[1][0, 1] < 0:
            return
        target = self.targets.get(header[4])
        if target is None or not (costs[:, 2] == COMPLETED).all():
            retry = target is None or bool((costs[:, 2] == VOID).any())
            self.result = self.failures, String(data=failure(header, retry))
            self.failures.publish(self.result[1])
            return
        n_z = target.size
        U = np.full((n_z, 1), n_z**-0.5)  # not used by this law; it has to have orthonormal columns
        rows = [U, np.zeros((1 + self.n_a, 1)), np.full((self.n_a, 1), P)]
        rows += [np.full((self.n_a, 1), F), target[None] @ U]
        model = np.repeat(np.concatenate(rows)[None], len(costs), axis=0)
        header[2] = 0
        self.result = self.models, to_message(["model", "row", "mode"], header, model)
        self.models.publish(self.result[1])


def failure(header, retry):
    reason = "the exploratory episode was not completed"
    ids = {"run": int(header[0]), "episode": int(header[1])}
    return json.dumps({**ids, "retry": retry, "reason": reason})


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(SaturatedController())
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
