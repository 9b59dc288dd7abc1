# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Texts from files and from the network, as they may be shown."""


def printable(text: str) -> str:
    r"""A text with what is no character to be seen, such as a terminal's escape sequences, in words.

    Examples
    --------
    >>> printable("red " + chr(27) + "[31m")
    'red \\x1b[31m'
    """
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)
