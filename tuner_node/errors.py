# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Why a training over topics ends early."""


class DispatchError(RuntimeError):
    """An episode that cannot be run: attempts used up, or a model that cannot be designed."""


class NoModelError(DispatchError, ValueError):
    """An exploration that gives no reduced model: the training ends there again if it is continued."""


class ContradictionError(DispatchError):
    """Something that the training has used was contradicted: it cannot be continued either."""
