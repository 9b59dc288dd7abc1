# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A bare ping-pong between two processes: what the middleware alone costs."""
