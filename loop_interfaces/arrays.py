# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What numbers are computed with: float64, everywhere."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
