# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""For `colcon build`, which calls setup.py. The package is described in pyproject.toml."""

from setuptools import setup

distribution = setup()
# colcon reads back the repr of every option, and that of a SpecifierSet is no literal.
for options in (distribution, distribution.metadata):
    options.python_requires = str(options.python_requires)
