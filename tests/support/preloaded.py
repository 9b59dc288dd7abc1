# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What nodes and commands import and load, done once by the process that they are forked from.

`tests.support.loop_harness` starts that process with this module.
"""

import gc
import inspect

import scipy.fft
import scipy.special  # noqa: F401  # for what a training needs at its end
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterEvent
from rclpy.type_support import check_for_type_support
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger
from type_description_interfaces.srv import GetTypeDescription

import controller_node.node
import pde_sim_node.node
import pdeloop.bags.verify  # noqa: F401
import recorder_node.node
import tests.support.forked_nodes
import tests.support.forked_workers
import tests.support.operator_program  # noqa: F401
import tuner_node.node
import viewer_node.node
from pdeloop import cli
from pdeloop.process.one_thread import one_thread
from tests.support.compiled import COMPILED

MAINS = {
    "controller_node": controller_node.node.main,
    "pdeloop": cli.main,
    "pde_sim_node": pde_sim_node.node.main,
    "recorder_node": recorder_node.node.main,
    "tuner_node": tuner_node.node.main,
    "viewer_node": viewer_node.node.main,
}

cli.parser()  # imports what the commands need
for load in COMPILED.values():
    load()
# Looks through all modules, as rclpy does for a node's first line of a log.
inspect.getmodule(inspect.currentframe())
for kind in (ParameterEvent, DiagnosticArray, Clock, String, Trigger, GetTypeDescription):
    check_for_type_support(kind)  # loads libraries, and a generator of code, as each node would
with one_thread():  # looks for libraries
    pass
gc.collect()
gc.freeze()  # a collection in a forked process would write to, and so copy, all of this
