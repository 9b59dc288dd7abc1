# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Why a training over topics ends early."""


class DispatchError(RuntimeError):
    """An episode that cannot be run: attempts used up, or a model that cannot be designed."""


class ContradictionError(DispatchError):
    """Something that the training has used was contradicted: it cannot be continued either."""
