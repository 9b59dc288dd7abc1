# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Boxes of a Gymnasium space, also in Dict and Tuple spaces, as one vector."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from pdeloop.messages.arrays import Array, float_array


class Boxes:
    """The boxes of a space one after the other, as Gymnasium orders them.

    Parameters
    ----------
    what : str
        What the space is of, for messages.
    space
        A Box, or a Dict or Tuple of boxes at any depth.

    Attributes
    ----------
    names : list of str
        Their names, of keys and indices with dots between them; one empty name for a Box.

    Raises
    ------
    ValueError
        A part is no box; the message names it.
    """

    def __init__(self, what: str, space: Any) -> None:
        self._what, self._space = what, space
        parts = list(self._leaves(space, ""))
        self.names = [name for name, _ in parts]
        self._sizes = [int(np.prod(box.shape)) for _, box in parts]
        self.size = sum(self._sizes)
        bounds = [[np.ravel(side) for side in (box.low, box.high)] for _, box in parts]
        self.low, self.high = (
            np.concatenate(side).astype(np.float64) for side in zip(*bounds, strict=True)
        )

    def vector(self, value: Any) -> Array:
        """A member of the space as numbers (size,); an Exception where it is none."""
        return np.concatenate([np.zeros(0), *self._numbers(self._space, value)])

    def member(self, numbers: Array) -> Any:
        """The inverse of `vector`, in the types of the space."""
        return self._filled(self._space, iter(np.split(numbers, np.cumsum(self._sizes)[:-1])))

    def infinite(self, numbers: Array) -> str:
        """Words on the named parts that are not finite; empty if there are no names."""
        parts = np.split(numbers, np.cumsum(self._sizes)[:-1])
        pairs = zip(self.names, parts, strict=True)
        found = [name for name, part in pairs if name and not np.isfinite(part).all()]
        more = f" and {len(found) - 3} more" if len(found) > 3 else ""
        left_out = "; a wrapper, such as gymnasium.wrappers.TransformObservation, leaves parts out"
        return f" in {', '.join(found[:3])}{more}{left_out}" if found else ""

    def by_name(self, name: str, given: Any, otherwise: float) -> Array | float:
        """Numbers (size,) of a mapping from names to numbers, or what is given if it is none.

        ValueError for a name that there is not, or a size that does not fit.
        """
        if not isinstance(given, Mapping):
            numbers = float_array(name, given)
            return float(numbers) if numbers.ndim == 0 else numbers.ravel()
        if unknown := [key for key in given if key not in self.names]:
            raise ValueError(
                f"{name} has the key {unknown[0]!r}; the {self._what} has {', '.join(self.names)}"
            )
        found = []
        for own, size in zip(self.names, self._sizes, strict=True):
            numbers = float_array(f"{name}[{own!r}]", given.get(own, otherwise)).ravel()
            if numbers.size not in (1, size):
                raise ValueError(f"{name}[{own!r}] must be {size} numbers, got {numbers.size}")
            found.append(np.broadcast_to(numbers, size))
        return np.concatenate(found)

    def _leaves(self, space: Any, name: str) -> Iterator[tuple[str, Any]]:
        from gymnasium import spaces

        if isinstance(space, spaces.Dict | spaces.Tuple):
            parts = space.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
            for key, part in parts:
                yield from self._leaves(part, f"{name}.{key}" if name else str(key))
        elif isinstance(space, spaces.Box):
            yield name, space
        else:
            which = f"part {name!r} of the {self._what} space" if name else f"{self._what} space"
            raise ValueError(
                f"the {which} must be a Box, got {space}: wrap the environment so that it is one, "
                "or is left out"
            )

    def _numbers(self, space: Any, value: Any) -> list[Array]:
        from gymnasium import spaces

        if isinstance(space, spaces.Dict):
            return [part for key, own in space.items() for part in self._numbers(own, value[key])]
        if isinstance(space, spaces.Tuple):
            if len(value) != len(space.spaces):
                raise ValueError(f"it has {len(value)} parts")
            own = zip(space.spaces, value, strict=True)
            return [part for kind, item in own for part in self._numbers(kind, item)]
        return [np.array(value, dtype=np.float64).ravel()]

    def _filled(self, space: Any, parts: Iterator[Array]) -> Any:
        from gymnasium import spaces

        if isinstance(space, spaces.Dict):
            return {key: self._filled(own, parts) for key, own in space.items()}
        if isinstance(space, spaces.Tuple):
            return tuple(self._filled(own, parts) for own in space.spaces)
        return next(parts).reshape(space.shape).astype(space.dtype)
