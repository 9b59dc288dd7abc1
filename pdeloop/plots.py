# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Figures of runs and episodes, in the style of `pdeloop report`, for notebooks and papers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from pde_sim_node.plant import Plant
from pdeloop.episode import EpisodeRecord
from pdeloop.finished_run import FinishedRun
from pdeloop.messages.colour_scale import field_range
from pdeloop.method.laws import Affine
from pdeloop.report import figures, places, planes
from pdeloop.report.data import ProblemData, of_run
from pdeloop.report.style import STYLE, field_image

__all__ = [
    "plot_behaviour",
    "plot_costs",
    "plot_episode",
    "plot_gains",
    "plot_spectrum",
    "plot_training",
]


def plot_episode(plant: Plant, episode: EpisodeRecord, environment: int = 0) -> Figure:
    """One environment of an episode: its field in space and time, and its actions.

    Parameters
    ----------
    plant
        The plant of the episode; it gives the axes, in m and s.
    episode
        As `rollout` returns it.
    environment
        Its index, 0 to M - 1.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ValueError
        The episode was not kept, or has no such environment.
    """
    steps, batch, _ = episode.actions.shape
    if not steps or not 0 <= environment < batch:
        raise ValueError(
            f"environment is {environment}; expected one of the {batch} of an episode that was kept"
        )
    if len(plant.grid.axes) > 1:
        with matplotlib.rc_context(STYLE):
            return planes.episode(plant, episode, environment)
    times = plant.sample_time * np.arange(steps + 1)
    parts = plant.grid.parts
    with matplotlib.rc_context(STYLE):
        moving = places.moving_target(plant)
        each = 1 if moving is None else 2
        figure = Figure(figsize=(6.4, 1.6 + 1.7 * each * len(parts)))
        *maps, below = figure.subplots(each * len(parts) + 1, 1, sharex=True)
        for i, (name, own, axis) in enumerate(parts):
            ax, extent = maps[each * i], (0.0, times[-1], 0.0, axis.length)
            field, target = episode.fields[:, environment, own], plant.field_target[own]
            limits = field_range(field, target if moving is None else moving[:, own])
            if moving is not None:
                goal = maps[each * i + 1]
                wanted = field_image(goal, moving[: steps + 1, own].T, extent, limits)
                goal.set_ylabel(axis.label)
                figure.colorbar(wanted, ax=goal, label=f"target of {name}", pad=0.01)
            drawn = field_image(ax, field.T, extent, limits)
            if moving is None:
                places.beside(ax, target, limits, axis.length)
            ax.set_ylabel(axis.label)
            figure.colorbar(drawn, ax=ax, label=f"{name}(x, t)", pad=0.01)
        applied = episode.applied[:, environment]
        limits, size = places.action_range([applied], plant.action_set), 8
        picture: Any = places.held_actions(below, times, applied, plant.action_set, limits, size)
        if picture is not None:
            figure.colorbar(picture, ax=below, label="$a_j(t)$", pad=0.01)
        places.name_actions(below, plant.n_a)
    return figure


def plot_costs(run: FinishedRun) -> Figure:
    """Mean stage cost of no control, LQT and the adapted policy, over seeds and fields.

    Parameters
    ----------
    run
        A finished training.

    Returns
    -------
    matplotlib.figure.Figure
    """
    return _drawn(lambda data: figures.bars([data]), run)


def plot_training(run: FinishedRun) -> Figure:
    """Cost against rollouts, relative to LQT: mean and standard deviation over the seeds.

    Parameters
    ----------
    run
        A finished training.

    Returns
    -------
    matplotlib.figure.Figure
    """
    return _drawn(lambda data: figures.training_curves([data]), run)


def plot_behaviour(run: FinishedRun) -> Figure:
    """Fields, actions and final profiles of the first seed's controllers from the mean field.

    Parameters
    ----------
    run
        A finished training.

    Returns
    -------
    matplotlib.figure.Figure
    """
    return _drawn(figures.behaviour, run)


def plot_gains(run: FinishedRun) -> Figure:
    """The gains K_a and K_b of the first seed, before and after the adaptation.

    Parameters
    ----------
    run
        A finished training.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ValueError
        The run's law is not the affine one.
    """
    _require_gains(run)
    return _drawn(figures.gains, run)


def plot_spectrum(run: FinishedRun) -> Figure:
    """Eigenvalues of the reduced models, without control and with each controller's gains.

    Parameters
    ----------
    run
        A finished training.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ValueError
        The run's law is not the affine one.
    """
    _require_gains(run)
    return _drawn(figures.spectrum, run)


def _require_gains(run: FinishedRun) -> None:
    """ValueError if the run's law has other parameters than gains."""
    if not run.affine:
        raise ValueError(
            f"the run has the law '{run.values['law']}', but this figure shows the gains of the "
            f"law '{Affine.name}'"
        )


def _drawn(draw: Callable[[ProblemData], Figure], run: FinishedRun) -> Figure:
    with matplotlib.rc_context(STYLE):
        return draw(of_run(run))
