# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Hooks of MkDocs: links that leave docs/ lead to the repository; the style of highlighted code."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from pygments.formatters import HtmlFormatter

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

OUTSIDE = re.compile(r"\]\(\.\./([^)\s]+)\)")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """A page whose links to files outside of docs/ are addresses in the repository."""
    return OUTSIDE.sub(rf"]({config.repo_url}/blob/main/\1)", markdown)


def on_post_build(config: MkDocsConfig) -> None:
    """Write the style of highlighted code, for light and dark pages."""
    light = HtmlFormatter(style="default").get_style_defs(".highlight")
    dark = HtmlFormatter(style="github-dark").get_style_defs('[data-bs-theme="dark"] .highlight')
    own = (Path(config.docs_dir) / "site.css").read_text()
    (Path(config.site_dir) / "site.css").write_text("\n".join([light, dark, own]))
