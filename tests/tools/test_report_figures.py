# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Single figures of a report: colours, axes, and what they show of a plant and of explorations."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

import pdeloop
from pdeloop.in_process import LocalPair
from pdeloop.messages.colour_scale import DARK
from pdeloop.messages.controllers import CONTROLLERS
from pdeloop.method.reduce.regression import study_orders
from pdeloop.report.data import gather, of_run
from pdeloop.report.figures import bars
from pdeloop.report.style import BACK, FIELD_MAP, INK, STYLE, darken
from tests.support.small import FEW_STEPS, SMALL, parameters
from tuner_node.build import build_training


def test_a_dark_figure_has_the_same_colours_turned_around():
    figure = Figure()
    ax = figure.subplots()
    (black,) = ax.plot([0, 1], color="black")
    (lqt,) = ax.plot([0, 1], color=CONTROLLERS["lqt"].colour, alpha=0.5)
    (green,) = ax.plot([0, 1], color="#009e00")
    field = ax.imshow([[0.0, 0.5, 1.0]], cmap=FIELD_MAP)
    figure.colorbar(field)
    darken(figure)
    assert to_hex(figure.get_facecolor()) == to_hex(ax.get_facecolor()) == BACK
    assert to_hex(black.get_color()) == to_hex(ax.title.get_color()) == INK
    assert to_hex(lqt.get_color()) == CONTROLLERS["lqt"].on_dark and lqt.get_alpha() == 0.5
    assert to_hex(green.get_color()) == "#009e00"
    levels = [to_hex(field.to_rgba(value)) for value in (0.0, 1.0)]
    assert levels == [DARK[0], DARK[-1]]


@pytest.mark.parametrize(("without", "scale"), [(9.0, "linear"), (11.0, "log")])
def test_costs_that_differ_tenfold_have_a_logarithmic_axis(without, scale):
    costs = {
        "none": np.full((1, 3), without),
        "lqt": np.full((1, 3), 2.0),
        "adapted": np.ones((1, 3)),
    }
    ax = bars([SimpleNamespace(costs=costs, name="p")]).axes[0]
    assert ax.get_yscale() == scale
    low, high = ax.get_ylim()
    assert low < 1.0 and high > without
    assert [bar.get_height() for bar in ax.patches] == [without, 2.0, 1.0]


def test_a_plant_of_two_fields_shows_both(tmp_path):
    from pdeloop.cli import main
    from pdeloop.report.figures import behaviour

    out = tmp_path / "run"
    command = ["train", "wave", "--iterations", "1", "--optimizer", "two_point", "--in-process"]
    short = ["--set", "horizon=40", "--evaluation-fields", "1"]
    assert main([*command, *short, "--out", str(out)]) == 0
    with matplotlib.rc_context(STYLE):
        behaviour(gather(out).problems[0]).savefig(tmp_path / "both.svg")
    svg = (tmp_path / "both.svg").read_text()
    for words in (">u(x, t)<", ">u_t(x, t)<", ">u(x, T)<", ">u_t(x, T)<"):
        assert words in svg, words
    # A map and a profile of each field under every controller, and a target and a colour bar of each;
    # the actions of eight actuators are a picture with a colour bar.
    maps = re.findall(r'<g id="axes_\d+">', svg)
    assert len(maps) == 3 * (2 + 1 + 2) + 2 * 2 + 1


class Canal(pdeloop.Dynamics):
    """Depths in five reaches, and flows over the edges between."""

    grid = pdeloop.Grid(fields={"depth": (0, 5), "flow": (5, 9)})
    n_a, horizon, target = 1, 6, (1.0, 2.0, 3.0, 4.0, 5.0, *4 * (0.0,))

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.standard_normal(9)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        inflow = np.r_[a, z[5:]] - np.r_[z[5:], 0.0]
        return np.r_[z[:5] + 0.1 * inflow, 0.9 * z[5:] - 0.1 * np.diff(z[:5])]


def test_fields_of_different_lengths_are_each_a_profile_of_their_own(tmp_path):
    from pdeloop.data_sets import measured_names
    from pdeloop.report.figures import behaviour

    quick = {"optimizer": "two_point", "rollouts": 5, "evaluation_fields": 1, "reduced_order": 3}
    run = pdeloop.train(plant=Canal(), **quick)
    plant = pdeloop.problem(plant=Canal()).plant()
    episode = pdeloop.rollout(plant, run.law(), [0])
    depth, flow, *_ = pdeloop.plot_episode(plant, episode).axes
    for ax, own in ((depth, slice(0, 5)), (flow, slice(5, 9))):
        np.testing.assert_array_equal(ax.images[0].get_array(), episode.fields[:, 0, own].T)
    figure = behaviour(of_run(run))
    labels = [ax.get_ylabel() for ax in figure.axes]
    for name, own in (("depth", slice(0, 5)), ("flow", slice(5, 9))):
        (at,) = (i for i, label in enumerate(labels) if label == f"{name}(x, T)")
        curves = {line.get_label(): line.get_ydata() for line in figure.axes[at].lines}
        np.testing.assert_array_equal(curves["target"], Canal.target[own])
        assert f"{name}(x, t)" in labels
    names = [*(f"depth{i}" for i in range(1, 6)), *(f"flow{i}" for i in range(1, 5))]
    assert measured_names(run, 9) == names


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_the_orders_shown_are_those_of_the_exploration_that_the_model_is_from(tmp_path, share):
    from pdeloop.cli import main

    words = ["train", str(SMALL), "--in-process", "--rollouts", "10", "--optimizer", "model_based"]
    words += ["--reduced-order", "0", "--set", f"identification_settings.order_share={share}"]
    words += [word for own in FEW_STEPS.items() for word in ("--set", "{}={}".format(*own))]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    values = parameters(rollouts=10, optimizer="model_based")
    batch = build_training(values).next_batch()
    explored = LocalPair(values).run(replace(batch, trajectories=True)).trajectories
    assert len(explored) == 2
    expected = study_orders([(explored[0].states, explored[0].actions)])
    data = gather(tmp_path / "run").problems[0]
    found = data.orders
    assert found.suggested == len(data.models[0].A), "the order that the training took"
    np.testing.assert_array_equal(found.singular_values, expected.singular_values)
    np.testing.assert_array_equal(found.rollout, expected.rollout)
