# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What actuators applied: in records of episodes, in figures, and in the trajectories of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

import pdeloop
from pdeloop.messages.action_set import ActionSet
from pdeloop.report.data import of_run
from pdeloop.report.figures import behaviour
from pdeloop.report.places import FEW, saturated, share_text
from pdeloop.report.style import STYLE
from tests.support.small import FEW_STEPS


class Row(pdeloop.Dynamics):
    """Cells in a row, each with a heater of 0 to 1, and a target that moves."""

    n_z, n_a, horizon, sample_time = 8, 3, 20, 1.0
    action_low, action_high, action_weight = 0.0, 1.0, 0.1

    def __init__(self, heaters: int = 3, moving: bool = True) -> None:
        self.n_a = heaters
        self.effect = np.zeros((8, heaters))
        self.effect[np.arange(heaters) % 8, np.arange(heaters)] = 1.0
        wave = 2.0 + np.sin(np.arange(21)[:, None] / 5.0 + np.arange(8))
        self.target = wave if moving else wave[0]

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.standard_normal(8)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return 0.8 * z + self.effect @ a


def test_a_record_has_the_actions_that_were_applied() -> None:
    def law(k: int, states: np.ndarray) -> np.ndarray:
        return np.tile([-1.0, 0.5, 2.0 * (k < 10)], (len(states), 1))

    plant = pdeloop.problem(plant=Row()).plant()
    episode = pdeloop.rollout(plant, law, [0, 1])
    assert episode.actions[0, 0].tolist() == [-1.0, 0.5, 2.0]
    assert episode.applied[0, 0].tolist() == [0.0, 0.5, 1.0]
    assert episode.applied[15, 1].tolist() == [0.0, 0.5, 0.0]
    assert saturated(episode.applied, plant.action_set) == pytest.approx(2 / 3)
    assert share_text(episode.applied, plant.action_set) == "66.7 % at a bound"
    assert share_text(episode.applied, ActionSet(3)) == ""
    assert share_text(np.ones((5, 3)), ActionSet(3, high=1.0)) == "100 % at a bound"


def images(figure: object) -> list[str]:
    """Labels of the colour bars of a figure."""
    axes = figure.axes  # type: ignore[attr-defined]
    return [ax.get_ylabel() for ax in axes if ax.get_label() == "<colorbar>"]


def apart(figure: Figure, ax: Axes) -> bool:
    """Whether the legend of actions lies beside the text about their bounds."""
    FigureCanvasAgg(figure).draw()
    text = next(t for t in ax.get_children() if isinstance(t, Text) and "bound" in t.get_text())
    return not ax.get_legend().get_window_extent().overlaps(text.get_window_extent())


def test_the_behaviour_in_a_report_has_its_legends_apart_and_numbers_of_a_vector(
    tmp_path: Path,
) -> None:
    few = {"rollouts": 6, "evaluation_fields": 2, **FEW_STEPS}
    run = pdeloop.train(plant=Row(FEW), **few, out=tmp_path / "run")
    with rc_context(STYLE):
        figure = behaviour(of_run(run))
        FigureCanvasAgg(figure).draw()
    assert apart(figure, next(ax for ax in figure.axes if ax.get_legend()))
    for ax in figure.axes:
        for axis, label in ((ax.xaxis, ax.get_xlabel()), (ax.yaxis, ax.get_ylabel())):
            assert label != "number" or not (axis.get_majorticklocs() % 1.0).any()


@pytest.mark.parametrize("heaters", [3, FEW, 12])
def test_figures_show_bounds_the_moving_target_and_many_actions_as_a_picture(heaters: int) -> None:
    plant = pdeloop.problem(plant=Row(heaters)).plant()
    episode = pdeloop.rollout(plant, lambda k, z: np.full((1, heaters), 2.0 - 0.2 * k), [0])
    figure = pdeloop.plot_episode(plant, episode)
    below = next(ax for ax in figure.axes if ax.get_title(loc="right"))
    assert below.get_title(loc="right") == "80 % at a bound"  # 16 of 20 steps
    few = heaters <= FEW
    dotted = [line.get_ydata()[0] for line in below.lines if line.get_linestyle() == ":"]
    assert dotted == ([0.0, 1.0] if few else [])
    assert not few or apart(figure, below)
    assert len({line.get_color() for line in below.lines if line.get_linestyle() == "-"}) == (
        heaters if few else 0
    )
    assert {*images(figure)} == {"z(x, t)", "target of z", *["$a_j(t)$"] * (not few)}
    if not few:
        np.testing.assert_array_equal(below.images[0].get_array(), episode.applied[:, 0].T)
    shown = next(ax for ax in figure.axes if ax.images and ax.get_shared_x_axes().joined(ax, below))
    assert shown.images[0].get_array().shape == (8, 21)


def test_the_trajectories_of_a_run_that_was_not_recorded_are_those_it_measured(
    tmp_path: Path,
) -> None:
    given = pdeloop.ReducedModel(0.8 * np.eye(8), Row().effect)
    for model in (None, given):
        own = {} if model is None else {"model": model}
        run = pdeloop.train(
            plant=Row(moving=False), optimizer="two_point", rollouts=9, reduced_order=3, **own
        )
        episodes = list(run.trajectories())
        closing = episodes[-1]
        costs = [*np.ravel([*run.costs.values()]), run.result["repeated"][0]["now"]]
        assert np.array_equal(np.sort(closing.costs.mean), np.sort(costs))
        assert sum(len(episode.costs.mean) for episode in episodes[:-1]) == run.rollouts[0]["total"]
        for episode in episodes:
            assert (episode.applied >= 0.0).all() and (episode.applied <= 1.0).all()
            again = 0.8 * episode.states[:-1] + episode.applied @ Row().effect.T
            np.testing.assert_allclose(episode.states[1:], again, rtol=1e-12, atol=1e-12)
