# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models as rows of numbers: all that a law has comes back, also of earlier versions."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.messages.model_rows import ModelRows, completed, pack, unpack

N, N_A = 4, 2
RNG = np.random.default_rng(8)


def test_rows_carry_the_filter_gain_of_those_laws_that_have_one() -> None:
    L, A = RNG.standard_normal((2, N, N))
    B, K_a, K_b = RNG.standard_normal((3, N, N_A))

    def model(**others: np.ndarray) -> ModelRows:
        return ModelRows(A, B, np.eye(N), K_a.T, K_b.T, np.zeros(N), **others)

    rows = pack(model(L=L))
    assert rows.shape == (N + 2 * N + 4 * N_A + 2, N)
    again = unpack(rows, N_A, True)
    assert again.L is not None and np.array_equal(again.L, L) and again.d is again.b is None
    drifting = unpack(pack(model(L=L, d=np.arange(N))), N_A, True)
    assert np.array_equal(drifting.d, np.arange(N)) and np.array_equal(drifting.L, L)
    assert np.array_equal(again.U, np.eye(N))
    offset = unpack(pack(model(L=L, b=np.arange(N_A))), N_A, True)
    assert np.array_equal(offset.b, np.arange(N_A)) and offset.d is None
    # Those of version 0.2 have no d, and others no b.
    for end in (-1 - N_A, -N_A):
        assert np.array_equal(completed(rows[:end], N_A, N), rows)
    assert completed(rows, N_A, N) is rows
    # More estimated than measured numbers.
    few = unpack(pack(ModelRows(A, B, np.ones((1, N)), B.T, B.T, np.zeros(N), L)), N_A, True)
    assert few.U.shape == (1, N)
    with pytest.raises(ValueError, match="leaves 1 rows for U; expected at least 4"):
        unpack(rows[: N * 2 + 3 * N_A + 1 - N + 1], N_A)
