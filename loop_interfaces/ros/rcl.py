"""ctypes access to rcl, for what rclpy lacks or performs with extra copies."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np


class Allocator(ctypes.Structure):
    """rcutils_allocator_t."""

    _fields_ = [
        (name, ctypes.c_void_p)
        for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")
    ]


class SerializedMessage(ctypes.Structure):
    """rcl_serialized_message_t."""

    _fields_ = [
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", Allocator),
    ]


def publishes_where_it_is(publisher: Any) -> Callable[[memoryview], None]:
    """A function that publishes, with a publisher of rclpy, the serialised message in a writable
    piece of memory.

    rclpy would copy it twice first, which takes as long as everything else for a large one. Where rcl
    is not to be had, it is rclpy that publishes.
    """
    handle: Any = publisher.handle

    def through_rclpy(message: memoryview) -> None:
        handle.publish_raw(bytes(message))

    try:
        publish = ctypes.CDLL("librcl.so").rcl_publish_serialized_message
        reset = ctypes.CDLL("librcutils.so").rcutils_reset_error
    except (OSError, AttributeError):
        return through_rclpy
    publish.argtypes = [ctypes.c_void_p] * 3
    outgoing = SerializedMessage()  # rcl only reads it
    reference = ctypes.addressof(outgoing)

    def directly(message: memoryview) -> None:
        outgoing.buffer = np.frombuffer(message, np.uint8).ctypes.data
        outgoing.length = outgoing.capacity = len(message)
        if publish(handle.pointer, reference, None) != 0:
            reset()
            through_rclpy(message)  # which says why it cannot

    return directly
