# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The input of a compiled step: its settings, and the layout of constants and scratch in memory."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdeloop.jit.simd import WIDTH, whole_lanes
from pdeloop.solver.etdrk4 import Spectrum
from pdeloop.solver.fft import is_transform_length, radices_of, twiddles_of
from pdeloop.solver.spectra import TRANSFORM


@dataclass(frozen=True, eq=False, kw_only=True)
class StepSettings:
    """A sampling time of d/dt F[u](k) = L(k) F[u](k) + m(k) F[g(u)](k) + F[sum_j Phi_j a_j](k).

    linear_operator: L, (n_x//2 + 1,) or, of c components, (n_x//2 + 1, c, c), where the step is exact;
    multiplier: m, (n_x//2 + 1,); nonlinearity: g, which Numba can compile for a float64; both are of no
    meaning to the exact step; actuated: the component that is forced; supports (n_x, n_a): Phi_j(x_i);
    target (c n_x,): state of the stage cost; steps: internal ones; bound: magnitude beyond which a
    state has diverged.
    """

    linear_operator: Spectrum
    multiplier: Spectrum
    nonlinearity: Callable[[float], float]
    actuated: int = 0
    supports: NDArray[np.float64]
    target: NDArray[np.float64]
    integration_time: float
    steps: int
    state_weight: float
    action_weight: float
    bound: float

    @property
    def n_x(self) -> int:
        """Grid points."""
        return len(self.supports)


def step_plan_type(*own: tuple[str, Any]) -> np.dtype[np.void]:
    """Type of the record that a compiled step reads: what all have, and the fields of its own."""
    return np.dtype(
        [
            ("constants", np.int64),  # address of c
            ("constants_apart", np.int64),  # distance e of its planes
            ("scratch", np.int64),  # address of w
            ("scratch_apart", np.int64),  # distance d of its planes
            ("n_x", np.int64),  # grid points
            ("n_z", np.int64),  # size of the state: components times grid points
            ("n_a", np.int64),
            ("modes", np.int64),  # n_x//2 + 1, up to whole lanes
            ("coarse", TRANSFORM),  # of the published grid
            ("state_weight", np.float64),
            ("action_weight", np.float64),
            ("bound", np.float64),
            # Offsets in c.
            ("target", np.int64),
            ("analysis", np.int64),  # matrices of the coarse transform, n_x by modes
            ("synthesis", np.int64),
            # Offsets in w.
            ("x", np.int64),  # the spectrum to be transformed next, zero above the modes
            ("z1", np.int64),
            ("z2", np.int64),
            ("state", np.int64),
            *own,
        ]
    )


def aligned(size: int) -> NDArray[np.float64]:
    """Zeros that begin on a boundary of whole lanes."""
    raw = np.zeros(size + WIDTH)
    start = -raw.ctypes.data // 8 % WIDTH
    return raw[start : start + size]


class Constants:
    """Complex arrays laid one after the other, in a plane of real and a plane of imaginary parts."""

    def __init__(self) -> None:
        self._parts: list[NDArray[np.complex128]] = []
        self._size = 0

    def add(self, values: ArrayLike) -> int:
        """Append an array, filled up to whole lanes, and return its offset."""
        return self._append(filled_up(np.asarray(values).ravel()))

    def _append(self, part: NDArray[np.complex128]) -> int:
        """The same with whole lanes, which stay as they are until `planes`."""
        self._parts.append(part)
        offset = self._size
        self._size += part.size
        return offset

    def add_spectra(self, rows: NDArray[Any]) -> int:
        """Append spectra (..., modes), each filled up to whole lanes, and return their offset."""
        return self._append(filled_up(rows).ravel())

    def add_transform(self, length: int, modes: int) -> tuple[int, int, int, int]:
        """Append what a transform of that complex length needs; its entry in a plan."""
        radices, twiddles, split = transform_constants(length, max(length, whole_lanes(modes)))
        return length, radices, self._append(twiddles), self._append(split)

    def add_grid(self, plan: Any, n_x: int) -> None:
        """Append what leads from a field on n_x points to its spectrum and back, into the plan."""
        modes = n_x // 2 + 1
        if is_transform_length(n_x // 2):
            plan["coarse"] = self.add_transform(n_x // 2, modes)
        else:
            angle = 2 * np.pi * (np.outer(np.arange(n_x), np.arange(modes)) % n_x) / n_x
            multiplicity = np.where(np.arange(modes) % (n_x // 2) == 0, 1, 2)
            plan["analysis"] = self.add_spectra(np.exp(-1j * angle) / n_x)
            plan["synthesis"] = self.add_spectra(np.exp(1j * angle) * multiplicity)

    def planes(self) -> NDArray[np.float64]:
        parts = np.concatenate(self._parts)
        planes = aligned(2 * parts.size)
        planes[: parts.size], planes[parts.size :] = parts.real, parts.imag
        return planes


def filled_up(rows: NDArray[Any]) -> NDArray[np.complex128]:
    """Rows (..., n), each filled up to whole lanes."""
    # By hand: there are many, and np.pad takes ten times as long.
    n = rows.shape[-1]
    filled = np.zeros((*rows.shape[:-1], whole_lanes(n)), dtype=np.complex128)
    filled[..., :n] = rows
    return filled


@lru_cache(maxsize=16)  # a fit makes thousands of steps on one grid
def transform_constants(
    length: int, split: int
) -> tuple[int, NDArray[np.complex128], NDArray[np.complex128]]:
    """Radices, twiddle factors and so many T_k of a transform of that complex length."""
    radices = sum(radix << 4 * i for i, radix in enumerate(radices_of(length)))
    half_turns = np.arange(split) / length
    return (
        radices,
        filled_up(twiddles_of(length)),
        filled_up(-1j * np.exp(-1j * np.pi * half_turns)),
    )


def lay_out(plan: Any, sizes: Mapping[str, int]) -> int:
    """Assign scratch offsets to the named areas; returns the size of a plane."""
    # In front, and behind each plane: room for what whole lanes read and write beyond a transform.
    offset = WIDTH
    for name, size in sizes.items():
        plan[name] = offset
        offset += size
    plan["scratch_apart"] = offset
    return offset


def begin_plan(kind: np.dtype[np.void], settings: StepSettings, constants: Constants) -> Any:
    """A record of that type, with the fields that all have but the addresses and the scratch."""
    plan: Any = np.zeros(1, kind)[0]
    plan["n_x"], plan["n_a"] = settings.supports.shape
    plan["n_z"] = settings.target.size
    plan["modes"] = whole_lanes(settings.n_x // 2 + 1)
    plan["state_weight"], plan["action_weight"] = settings.state_weight, settings.action_weight
    plan["bound"] = settings.bound
    plan["target"] = constants.add(settings.target)
    constants.add_grid(plan, settings.n_x)
    return plan
