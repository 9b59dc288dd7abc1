# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Many trainings side by side: on this machine's cores, on a cluster, on any executor."""

from pdeloop.study.description import Study, StudyError
from pdeloop.study.run import Failure, run
from pdeloop.study.table import rows

__all__ = ["Failure", "Study", "StudyError", "rows", "run"]
