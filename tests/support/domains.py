# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""ROS domains of tests whose processes have temporary folders of their own.

Locks on files in the temporary folder say which domains are in use. A program that a test starts
without ROS_DOMAIN_ID looks for them in its own folder, where it would not see the domains of the tests
of other workers and of other test runs, nor they its own.
"""

from __future__ import annotations

import os
from pathlib import Path

from pdeloop.domain import DOMAINS, DOMAINS_FOLDER
from pdeloop.messages.files import open_own, private_folder


def share_domains(folder: Path) -> None:
    """Let processes with the temporary folder `folder` lock the same files as this process."""
    own = folder / DOMAINS_FOLDER.name
    for place in (DOMAINS_FOLDER, own):
        private_folder(place)
    for domain in map(str, DOMAINS):
        open_own(DOMAINS_FOLDER / domain, 0).close()
        os.link(DOMAINS_FOLDER / domain, own / domain)
