# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A picture of a page in a headless browser: `python -m tests.support.screenshot URL FILE.png`.

docs/figures/monitor.png is made so, with the address that `pdeloop monitor` prints.
"""

from __future__ import annotations

import argparse
import base64
import tempfile
import time
from pathlib import Path

from tests.support.browser import browser


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.screenshot", description=__doc__)
    add = parser.add_argument
    add("url")
    add("file", type=Path)
    add("--size", default="1280x900", metavar="WxH", help="of the window [1280x900]")
    add("--scheme", choices=("light", "dark"), default="light", help="of the colours [light]")
    add("--seconds", type=float, default=3.0, help="to wait for what a live page shows [3]")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        browser(Path(folder)) as tab,
    ):
        tab.size(width, height)
        tab.scheme(options.scheme)
        tab.go(options.url)
        time.sleep(options.seconds)
        taken = tab.send("Page.captureScreenshot", format="png")
        options.file.write_bytes(base64.b64decode(taken["data"]))


if __name__ == "__main__":
    main()
