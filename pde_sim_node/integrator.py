"""z_{k+1} = f(z_k, a_k) of one equation on one grid: what the compiled step needs, laid out once."""

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .compiled import pointwise_loop
from .equations import Equation, Spectrum
from .etdrk4 import etdrk4_coefficients
from .fft import is_transform_length, plane_size, radices_of, twiddles_of
from .kernel import PLAN, all_finite, step
from .simd import WIDTH

__all__ = ["Integrator"]

POINTS_PER_PIECE = 30_000
"""Grid points, in all stages, of a piece of work for a thread: about 50 microseconds."""
WORTHWHILE_PIECES = 3
"""Below this many pieces, waking another thread takes longer than it helps."""


def whole_lanes(n: int) -> int:
    return -(-n // WIDTH) * WIDTH


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

    def planes(self) -> NDArray[np.float64]:
        parts = np.concatenate(self._parts)
        planes = aligned(2 * parts.size)
        planes[: parts.size], planes[parts.size :] = parts.real, parts.imag
        return planes


class Integrator:
    """The plant's equation and grid, made ready for the compiled step.

    The nonlinearity is dealiased on a grid of at least 3/2 n_z points; exactly that where 3/2 n_z
    is 16 * 2^i * 3^j, else the next such number.

    Parameters
    ----------
    equation
        The PDE.
    supports : (n_z, n_a)
        Phi_j(x_i).
    target : (n_z,)
        Field of the stage cost.
    integration_time, steps
        Length and number of the internal steps of a sampling time.
    state_weight, action_weight
        Weights of the stage cost.
    bound
        Magnitude beyond which a state has diverged.

    Attributes
    ----------
    compiled_in_seconds : float
        Time spent on compiling, 0.0 if everything was on disk.

    Raises
    ------
    ValueError
        The equation's operators have the wrong shape or are not finite, or its nonlinearity does
        not compile.
    """

    def __init__(
        self,
        equation: Equation,
        *,
        supports: NDArray[np.float64],
        target: NDArray[np.float64],
        integration_time: float,
        steps: int,
        state_weight: float,
        action_weight: float,
        bound: float,
    ) -> None:
        n_z, n_a = supports.shape
        modes = n_z // 2 + 1
        k = 2 * np.pi * np.arange(modes) / equation.length
        linear = checked_operator("linear_operator", equation.linear_operator(k), modes)
        multiplier = checked_operator("multiplier", equation.multiplier(k), modes)
        fine = fine_length(n_z)
        # The compiled transform leaves out the factor 1/4m.
        m = multiplier / (4 * fine)
        c = etdrk4_coefficients(linear, integration_time)

        constants = Constants()
        plan = np.zeros(1, PLAN)[0]
        plan["n_z"], plan["n_a"], plan["steps"] = n_z, n_a, steps
        plan["modes"] = whole_lanes(modes)
        plan["state_weight"], plan["action_weight"] = state_weight, action_weight
        plan["bound"] = bound

        def spectra(rows: NDArray[Any]) -> int:
            return constants.add(
                np.pad(rows, [(0, 0)] * (rows.ndim - 1) + [(0, plan["modes"] - modes)])
            )

        def transform(length: int) -> tuple[int, int, int, int]:
            radices = sum(radix << 4 * i for i, radix in enumerate(radices_of(length)))
            half_turns = np.arange(max(length, plan["modes"])) / length
            return (
                length,
                radices,
                constants.add(twiddles_of(length)),
                constants.add(-1j * np.exp(-1j * np.pi * half_turns)),
            )

        plan["fine"] = transform(fine)
        if is_transform_length(n_z // 2):
            plan["coarse"] = transform(n_z // 2)
        else:
            angle = 2 * np.pi * (np.outer(np.arange(n_z), np.arange(modes)) % n_z) / n_z
            multiplicity = np.where(np.arange(modes) % (n_z // 2) == 0, 1, 2)
            plan["analysis"] = spectra(np.exp(-1j * angle) / n_z)
            plan["synthesis"] = spectra(np.exp(1j * angle) * multiplicity)
        plan["e"], plan["e2"], plan["q"] = spectra(c.e), spectra(c.e2), spectra(c.q)
        plan["qm"], plan["f1m"] = spectra(c.q * m), spectra(c.f1 * m)
        plan["f2m"], plan["f3m"] = spectra(2 * c.f2 * m), spectra(c.f3 * m)
        plan["f"] = spectra(c.f1 + 4 * c.f2 + c.f3)
        plan["supports"] = spectra(np.fft.rfft(supports, axis=0).T / n_z)
        plan["target"] = constants.add(target)

        plane = plane_size(max(fine, n_z // 2))
        # In front, and behind each plane: room for what whole lanes read and write beyond a
        # transform.
        offset = WIDTH
        for name, size in (
            ("z1", plane),
            ("z2", plane),
            ("x", fine + WIDTH),
            *((name, plan["modes"]) for name in ("next", "b", "c", "qf", "ff")),
            ("state", whole_lanes(n_z)),
        ):
            plan[name] = offset
            offset += size
        self._constants = constants.planes()
        plan["constants"], plan["constants_apart"] = (
            self._constants.ctypes.data,
            self._constants.size // 2,
        )
        plan["scratch_apart"] = offset

        began, misses = time.perf_counter(), cache_misses()
        self._loop, loop_is_new = pointwise_loop(equation.nonlinearity)
        plan["pointwise"] = self._loop.address
        self._threads = ThreadTeam(available_cores())
        self._scratch = [aligned(2 * offset) for _ in range(self._threads.size)]
        self._plans = np.repeat(plan, self._threads.size)
        self._plans["scratch"] = [scratch.ctypes.data for scratch in self._scratch]
        self._points_per_step = 8 * steps * fine

        states, actions = np.zeros((1, n_z)), np.zeros((1, n_a))
        all_finite(actions)
        self.step(states, actions, np.zeros(1), np.zeros(1, dtype=np.int64), 0)
        compiled = cache_misses() > misses or loop_is_new
        self.compiled_in_seconds = time.perf_counter() - began if compiled else 0.0

    def step(
        self,
        states: NDArray[np.float64],
        actions: NDArray[np.float64],
        totals: NDArray[np.float64],
        diverged_step: NDArray[np.int64],
        k: int,
    ) -> None:
        """Advance all environments in place, see `kernel.step`; arrays are contiguous and writable."""
        batch = len(states)
        pieces = min(batch, batch * self._points_per_step // POINTS_PER_PIECE)
        if pieces < WORTHWHILE_PIECES or self._threads.size == 1:
            step(states, actions, totals, diverged_step, k, self._plans, 0, 0, batch)
            return

        def advance(thread: int, piece: int) -> None:
            begin, end = batch * piece // pieces, batch * (piece + 1) // pieces
            step(states, actions, totals, diverged_step, k, self._plans, thread, begin, end)

        self._threads.run(advance, pieces)


class ThreadTeam:
    """The calling thread and others beside it, which exist from their first use on."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._process = 0
        self._pool: ThreadPoolExecutor | None = None

    def run(self, work: Callable[[int, int], None], pieces: int) -> None:
        """work(thread, piece) for every piece, each by whichever thread is free.

        The caller waits for no thread that has not begun, so a busy machine costs little.
        """
        if (
            self._pool is None or self._process != os.getpid()
        ):  # a fork has the pool, not its threads
            self._pool = ThreadPoolExecutor(self.size - 1, thread_name_prefix="plant")
            self._process = os.getpid()
        remaining = iter(range(pieces))

        def take(thread: int) -> None:
            for piece in remaining:
                work(thread, piece)

        others = [self._pool.submit(take, thread) for thread in range(1, min(self.size, pieces))]
        take(0)
        for other in others:
            if not other.cancel():
                other.result()


def available_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def cache_misses() -> int:
    """How many functions had to be compiled in this process so far."""
    compiled: tuple[Any, ...] = (step, all_finite)
    return sum(sum(function.stats.cache_misses.values()) for function in compiled)


def fine_length(n_z: int) -> int:
    """Complex length, half the points, of the dealiased grid."""
    length = -(-3 * n_z // 4)
    while not is_transform_length(length):
        length += 1
    return length


def checked_operator(what: str, values: Spectrum, modes: int) -> Spectrum:
    if (
        not isinstance(values, np.ndarray)
        or values.shape != (modes,)
        or values.dtype.kind not in "iufc"
        or not np.isfinite(values).all()
    ):
        raise ValueError(
            f"{what} of the equation must return an array of {modes} finite numbers for k of shape "
            f"({modes},), got {values!r}"
        )
    return values
