# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The live page: a node that reads a loop, and a web server on this machine that shows it."""
