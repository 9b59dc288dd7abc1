# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Where compiled code is kept."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numba
import pytest
from numba.core import caching

from loop_interfaces.files import is_private
from loop_interfaces.jit.cache import cached_njit


def test_it_is_kept_in_a_private_temporary_folder_where_no_other_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = caching.CacheImpl._locator_classes
    only = [kind for kind in known if "UserProvided" in kind.__name__]  # that of NUMBA_CACHE_DIR
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", only)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert cached_njit()(lambda x: x + 1)(2) == 3
    (folder,) = tmp_path.iterdir()
    assert is_private(folder)
    assert list(folder.rglob("*.nbc"))
