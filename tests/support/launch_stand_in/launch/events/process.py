# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Events of processes."""

from launch import ProcessExited as ProcessExited
