# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The controllers whose costs are shown: one name and one colour each, wherever they appear.

The command line, the report, the live page and the views take them from here. The colours are those
of Okabe and Ito (*Color Universal Design*, 2008) with a darker grey, which differ with any colour
vision; on a dark background lighter ones of the same hues stand for them.
"""

from typing import NamedTuple


class Controller(NamedTuple):
    """Display style of a controller: its name, and its colours on white and on a dark background."""

    name: str
    colour: str
    on_dark: str


CONTROLLERS = {
    "none": Controller("no control", "#606060", "#909090"),
    "lqt": Controller("LQT", "#0072b2", "#56b4e9"),
    "adapted": Controller("adapted", "#d55e00", "#ff8c42"),
    # The three adapted controllers of `pdeloop reproduce`, told apart by how they were adapted.
    "lqt_po": Controller("LQT-PO", "#e69f00", "#f7dc6f"),
    "pure_po": Controller("pure PO", "#009e73", "#2fd6a4"),
    "model_based": Controller("model-based", "#d55e00", "#ff8c42"),
}
"""By the key under which result.json, table.json and the history of a run have their costs.

The first three are those of every run; `adapted` is the policy at its end. `model_based` is the
`adapted` of a run with the default optimiser and has its colour.
"""
