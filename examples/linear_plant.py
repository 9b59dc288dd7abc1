# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant: z+ = A z + B a with 3 states and 2 inputs. Nothing of pdeloop is imported."""

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

A = np.array([[0.95, 0.20, 0.00], [-0.20, 0.95, 0.10], [0.00, 0.00, 0.90]])
B = np.array([[0.0, 0.1], [0.2, 0.0], [0.0, 0.3]])
TARGET = np.array([0.5, 0.0, -0.2])
HORIZON, SAMPLE_TIME, REPEAT_AFTER, GIVE_UP_AFTER = 50, 0.1, 0.05, 600
PLANT = 20250101  # any whole number below 2^53; another one whenever the numbers above change
COMPLETED, VOID = -1.0, -2.0

VOLATILE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
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
    """(run, episode, step, plant), time, values."""
    shape = [dim.size for dim in message.layout.dim]
    run, episode, step, time, plant = message.data[:5]
    ids = int(run), int(episode), int(step), int(plant)
    return ids, time, np.array(message.data[5:]).reshape(shape)


class LinearPlant(Node):
    def __init__(self):
        super().__init__("linear_plant")
        self.run, self.episode, self.step, self.time = 0, -1, 0, 0.0
        self.reply, self.waiting, self.repeats = None, False, 0
        self.states = self.create_publisher(Float64MultiArray, "state", VOLATILE)
        self.costs = self.create_publisher(Float64MultiArray, "episode/cost", LATCHED)
        self.targets = self.create_publisher(Float64MultiArray, "target", LATCHED)
        self.targets.publish(to_message(["x"], [0, 0, 0, 0.0, PLANT], TARGET))
        self.create_subscription(Float64MultiArray, "episode/start", self.on_start, LATCHED)
        self.create_subscription(Float64MultiArray, "action", self.on_action, VOLATILE)
        self.timer = self.create_timer(REPEAT_AFTER, self.on_silence)

    def on_start(self, message):
        (run, episode, _, _), time, rows = from_message(message)
        if not rows.size:
            if run == self.run:  # the run is over; another one's end means nothing here
                self.waiting = False
        elif run == self.run and episode <= self.episode:  # known: answer again, or too old
            if episode == self.episode:
                self.send()
        else:
            self.run, self.episode, self.step = run, episode, 0
            self.time = max(self.time, time) + SAMPLE_TIME
            self.z = np.array([self.initial_state(int(seed)) for seed in rows[:, 0]])
            self.total = np.zeros(len(rows))
            self.send_state()

    def on_action(self, message):
        ids, _, a = from_message(message)
        if not self.waiting or ids != (self.run, self.episode, self.step, PLANT):
            return  # a repeated or late answer moves nothing
        if self.step == HORIZON:
            self.finish(COMPLETED)
            return
        self.total += ((self.z - TARGET) ** 2).sum(axis=1) + (a**2).sum(axis=1)
        self.z = np.array([A @ z + B @ u for z, u in zip(self.z, a, strict=True)])  # row by row
        self.step, self.time = self.step + 1, self.time + SAMPLE_TIME
        self.send_state()

    def on_silence(self):
        if self.waiting and self.repeats < GIVE_UP_AFTER:
            self.repeats += 1
            self.send()
        elif self.waiting:
            self.finish(VOID)

    def initial_state(self, seed):
        noise = np.random.default_rng(seed).normal(size=3) if seed >= 0 else 0.0  # -1: the mean
        return np.array([1.0, 0.0, 0.0]) + 0.1 * noise

    def send_state(self):
        header = [self.run, self.episode, self.step, self.time, PLANT]
        self.reply = self.states, to_message(["env", "x"], header, self.z)
        self.waiting, self.repeats = True, 0
        self.send()

    def finish(self, ended):
        header = [self.run, self.episode, self.step, self.time, PLANT]
        rows = np.stack([self.total / HORIZON, self.total, np.full(len(self.total), ended)], axis=1)
        self.reply = self.costs, to_message(["env", "mean_total_ended"], header, rows)
        self.waiting = False
        self.send()

    def send(self):
        publisher, message = self.reply
        publisher.publish(message)
        self.timer.reset()


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(LinearPlant())
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
