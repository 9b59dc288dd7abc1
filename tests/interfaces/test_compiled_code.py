# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Where compiled code is kept."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numba
import pytest
from numba.core import caching

from pdeloop.jit.cache import cached_njit
from pdeloop.messages.files import is_private
from tests.support.interpreter import python


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


def test_a_package_that_was_moved_with_what_it_has_compiled_is_compiled_anew(
    tmp_path: Path,
) -> None:
    """Compiled code refers to the modules that it is made of by their names."""
    package = tmp_path / "first"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "helper.py").write_text(
        "from pdeloop.jit.cache import jit\n@jit\ndef double(x):\n    return 2 * x\n"
    )
    (package / "function.py").write_text(
        "from pdeloop.jit.cache import cached_njit\nfrom .helper import double\n"
        "@cached_njit()\ndef function(x):\n    return double(x) + 1\n"
    )

    def result() -> str:
        program = f"from {package.name}.function import function; print(function(3))"
        return python("-c", program, PYTHONPATH=str(tmp_path), NUMBA_CACHE_DIR="").stdout

    assert result() == "7\n"
    assert list(package.rglob("*.nbc"))
    package = package.rename(tmp_path / "second")
    assert result() == "7\n"
