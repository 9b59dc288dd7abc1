# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The site of the documents (`make docs`): its pages, and where their links lead."""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


def site() -> dict[str, Any]:
    """mkdocs.yml."""
    found: dict[str, Any] = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    return found


def pages(nav: Any) -> list[str]:
    """The files of a navigation, of any depth."""
    if isinstance(nav, str):
        return [nav]
    items = nav.values() if isinstance(nav, dict) else nav
    return [page for item in items for page in pages(item)]


def test_each_document_is_in_the_navigation_once() -> None:
    listed = pages(site()["nav"])
    found = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")}
    assert sorted(listed) == sorted(found)


def test_the_first_page_names_each_document() -> None:
    first = (DOCS / "index.md").read_text()
    for page in pages(site()["nav"]):
        assert page == "index.md" or f"({page})" in first, page


def test_no_heading_begins_with_a_digit() -> None:
    """Its anchor would: no CSS selector may, and the theme's script stops at such a page."""
    for page in DOCS.rglob("*.md"):
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
        assert not re.search(r"^#+ [`*(]*\d", text, re.MULTILINE), page
        assert re.search(r"^# \S", text, re.MULTILINE), page


def test_no_text_is_taken_for_a_tag() -> None:
    """A page of the site is HTML: what begins like a tag, as k<T, swallows what follows it."""
    for page in (*DOCS.rglob("*.md"), *ROOT.glob("*.md")):
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
        text = re.sub(r"^(    |\t).*$", "", text, flags=re.MULTILINE)
        text = re.sub(r"(`+).+?\1", "", text, flags=re.DOTALL)
        assert not re.findall(r"<(?!https?://|!--)[A-Za-z/!?][^\n]{,30}", text), page


def test_a_link_that_leaves_the_documents_leads_to_the_repository() -> None:
    spec = importlib.util.spec_from_file_location("site_hooks", DOCS / "site_hooks.py")
    assert spec and spec.loader
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    config = SimpleNamespace(repo_url="https://host/repo")
    written = hooks.on_page_markdown("[a](../x/y.py) [b](z.md#c)", None, config, None)
    assert written == "[a](https://host/repo/blob/main/x/y.py) [b](z.md#c)"


def test_the_code_of_the_first_hour_runs() -> None:
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "first-hour.md").read_text(), re.DOTALL)
    assert len(blocks) == 2
    names: dict[str, Any] = {"__name__": "first_hour"}
    for block in blocks:
        exec(compile(block, "first-hour.md", "exec"), names)
    assert names["states"].shape == (301, 128) and names["actions"].shape == (300, 6)
    assert abs(names["gains"].poles).max() < 1
    assert "pdeloop.train(plant=Chain()" in ast.unparse(ast.parse(blocks[1]))
    np, chain = names["np"], names["Chain"]()
    z = chain.initial_state(np.random.default_rng(0))
    assert chain.step(z, np.ones(chain.n_a)).shape == (chain.n_z,)
