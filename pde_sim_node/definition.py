# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What defines a plant, and the number that stands for it on the network and in results."""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from loop_interfaces.frames import MAX_ID


@dataclass(frozen=True)
class Definition:
    """Everything that the states and costs of a plant depend on.

    Attributes
    ----------
    values : mapping
        Its parameters.
    sources : sequence of str
        The source of its code.
    """

    values: Mapping[str, Any]
    sources: Sequence[str]

    def having(self, values: Mapping[str, Any]) -> Definition:
        """The same with further values."""
        return Definition({**self.values, **values}, self.sources)

    @property
    def fingerprint(self) -> int:
        """A number in [1, 2^53) that two plants share only if they are the same plant."""
        content = json.dumps([dict(self.values), list(self.sources)], sort_keys=True, default=float)
        digest = hashlib.sha256(content.encode()).digest()
        return 1 + int.from_bytes(digest[:8], "big") % (MAX_ID - 1)


def module_sources(kind: type, root: type) -> list[str]:
    """The source of a class and of the classes it is derived from, as far as they derive from `root`.

    Each with its whole module: constants and functions beside the class are part of it.
    """
    kinds = [base for base in kind.__mro__ if issubclass(base, root)]
    return [inspect.getsource(inspect.getmodule(base) or base) for base in kinds]
