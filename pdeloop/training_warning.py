# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The warning of a training; a module without imports, so that filters of warnings are quick."""


class TrainingWarning(UserWarning):
    """What the user of a training should know: a law is no better, or a plant drifts."""
