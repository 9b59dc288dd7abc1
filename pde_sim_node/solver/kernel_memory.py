"""How the constants and the scratch of a compiled step lie in memory."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loop_interfaces.jit.simd import WIDTH, whole_lanes
from pde_sim_node.equations import Spectrum
from pde_sim_node.solver.fft import is_transform_length, radices_of, twiddles_of

__all__ = ["Constants", "aligned", "checked_operator", "lay_out"]


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
        part = np.asarray(values, dtype=np.complex128).ravel()
        self._parts.append(np.pad(part, (0, whole_lanes(part.size) - part.size)))
        offset = self._size
        self._size += self._parts[-1].size
        return offset

    def add_spectra(self, rows: NDArray[Any]) -> int:
        """Append spectra (..., modes), each filled up to whole lanes, and return their offset."""
        modes = rows.shape[-1]
        missing = whole_lanes(modes) - modes
        return self.add(np.pad(rows, [(0, 0)] * (rows.ndim - 1) + [(0, missing)]))

    def add_transform(self, length: int, modes: int) -> tuple[int, int, int, int]:
        """Append what a transform of that complex length needs; its entry in a plan."""
        radices = sum(radix << 4 * i for i, radix in enumerate(radices_of(length)))
        half_turns = np.arange(max(length, whole_lanes(modes))) / length
        return (
            length,
            radices,
            self.add(twiddles_of(length)),
            self.add(-1j * np.exp(-1j * np.pi * half_turns)),
        )

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


def lay_out(plan: Any, sizes: Mapping[str, int]) -> int:
    """Give areas of the scratch, by name, their offsets in the plan; returns the size of a plane."""
    # In front, and behind each plane: room for what whole lanes read and write beyond a transform.
    offset = WIDTH
    for name, size in sizes.items():
        plan[name] = offset
        offset += size
    plan["scratch_apart"] = offset
    return offset


def checked_operator(what: str, values: Spectrum, modes: int, components: int = 1) -> Spectrum:
    """The values of an equation's operator, if they are what its docstring promises."""
    shape = (modes,) if components == 1 else (modes, components, components)
    if (
        not isinstance(values, np.ndarray)
        or values.shape != shape
        or values.dtype.kind not in "iufc"
        or not np.isfinite(values).all()
    ):
        numbers = f"{modes}" if components == 1 else " x ".join(map(str, shape))
        raise ValueError(
            f"{what} of the equation must return an array of {numbers} finite numbers for k of "
            f"shape ({modes},), got {values!r}"
        )
    return values
