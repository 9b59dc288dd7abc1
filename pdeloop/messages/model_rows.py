# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The layout of a reduced model with its gains as one array of rows with n_s columns.

Every part has n_s columns (or is transposed to have), so the parts stack:

    rows              part     meaning
    n_z               U        projection, s = U^T z
    n_s               A        s_{k+1} = A s_k + B a_k
    n_a               B^T
    n_a               K_a      feedback gain
    n_a               K_b      gain of the target
    1                 s_r      U^T z_r, the target in reduced coordinates
    n_s or none       L        filter gain, where the law uses one
    1 or none         d        constant term of s_{k+1} = A s_k + B a_k + d, after an L
    n_a or none       b        after d, in the first column: the rest of K_b s_r + b

n_s is the number of columns, n_a that of the axis `actuator`; n_z follows from the row count.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from pdeloop.messages.arrays import Array


@dataclass(frozen=True)
class ModelRows:
    """A reduced model, its warm-start gains and its target.

    A (n_s, n_s), B (n_s, n_a), U (n_z, n_s), K_a and K_b (n_a, n_s), s_r (n_s,). L (n_s, n_s): the
    estimate after a measurement is p + L (U^T z - p), with p the prediction; None: no filter.
    d (n_s,): the constant term of s_{k+1} = A s_k + B a_k + d; None: 0. The rows have it after an L,
    whose predictions need it; K_b knows of it. b (n_a,): what K_b s_r does not have of the law's
    constant part, as where s_r is 0; None: 0. The rows have it after an L, too.
    """

    A: Array
    B: Array
    U: Array
    K_a: Array
    K_b: Array
    s_r: Array
    L: Array | None = None
    d: Array | None = None
    b: Array | None = None

    @property
    def constant(self) -> Array:
        """The constant part of the law, K_b s_r + b, (n_a,)."""
        held: Array = self.K_b @ self.s_r
        return held if self.b is None else held + self.b

    @property
    def arrays(self) -> dict[str, Array]:
        """Its parts by their names."""
        parts = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: part for name, part in parts.items() if part is not None}

    @property
    def policy(self) -> Array:
        """[K_a K_b], shape (n_a, 2 n_s)."""
        return np.hstack([self.K_a, self.K_b])

    @property
    def measurement(self) -> Array:
        """The map from reduced to full states, z = measurement @ s, (n_z, n_s); U, if orthonormal."""
        if self.L is None:
            return self.U
        return np.asarray(np.linalg.pinv(self.U.T), dtype=np.float64)


def pack(model: ModelRows) -> Array:
    """The rows of `model`, (n_z + n_s + 3 n_a + 1, n_s), with a filter gain n_s + 1 + n_a more."""
    parts = [model.U, model.A, model.B.T, model.K_a, model.K_b, model.s_r]
    if model.L is not None:
        own = np.zeros((1 + len(model.K_b), len(model.A)))  # d, and b in the first column
        own[0] = 0.0 if model.d is None else model.d
        own[1:, 0] = 0.0 if model.b is None else model.b
        parts += [model.L, own]
    return np.vstack(parts)


def has_filter(rows: Array, n_a: int, n_z: int) -> bool:
    """True if `rows` are those of a model with a filter gain, of a plant that measures n_z numbers."""
    return bool(len(rows) == n_z + 2 * rows.shape[1] + 4 * n_a + 2)


def completed(rows: Array, n_a: int, n_z: int) -> Array:
    """The rows, with d = 0 and b = 0 where older ones end with L, as those of version 0.2, or d."""
    missing = n_z + 2 * rows.shape[1] + 4 * n_a + 2 - len(rows)
    older = missing in (n_a, n_a + 1)
    return np.vstack([rows, np.zeros((missing, rows.shape[1]))]) if older else rows


def unpack(rows: Array, n_a: int, filtered: bool = False) -> ModelRows:
    """The model in `rows`, with a filter gain or not. ValueError where there is no room for U.

    >>> gains = np.ones((1, 2))
    >>> model = ModelRows(np.eye(2), np.ones((2, 1)), np.eye(4)[:, :2], gains, gains, np.ones(2))
    >>> pack(model).shape, unpack(pack(model), n_a=1).U.shape
    ((10, 2), (4, 2))
    """
    n_s = rows.shape[1]
    n_z = rows.shape[0] - n_s - 3 * n_a - 1 - (n_s + 1 + n_a if filtered else 0)
    # A filter may estimate more numbers than are measured.
    least = 1 if filtered else max(n_s, 1)
    if n_s < 1 or n_z < least:
        raise ValueError(
            f"a model of {rows.shape[0]} rows and {n_s} columns with {n_a} actuators leaves "
            f"{n_z} rows for U; expected at least {least}"
        )
    ends = np.cumsum([n_z, n_s, n_a, n_a, n_a, 1, n_s, 1])
    U, A, Bt, K_a, K_b, s_r, L, d, b = np.split(rows, ends)
    known = ModelRows(A=A, B=Bt.T.copy(), U=U, K_a=K_a, K_b=K_b, s_r=s_r[0])
    if not filtered:
        return known
    own = d[0] if d.any() else None, b[:, 0].copy() if b.any() else None
    return replace(known, L=L, d=own[0], b=own[1])
