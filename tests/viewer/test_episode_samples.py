# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The samples of an episode are kept in a bounded memory, evenly thinned."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.messages.frames import Frame
from tests.support.viewed import PLANT, frame, state
from viewer_node.episode_samples import COLUMNS, MAX_COMPONENTS, ROWS, EpisodeSamples, rows_of


def test_an_episode_keeps_every_state_and_action_while_there_is_room():
    episode = EpisodeSamples(state(0), environment=1)
    for k in range(10):
        episode.state(state(k))
        episode.action(frame([[k, -k], [10 + k, -k]], step=k))
    assert episode.columns == 10 and episode.stride == 1 and episode.whole
    expected = 100 + np.arange(10)[:, None] + np.arange(4) / 10
    np.testing.assert_allclose(episode.fields[:10], expected, rtol=1e-6)
    np.testing.assert_array_equal(episode.actions[:10, 0], 10 + np.arange(10))
    assert np.isnan(episode.fields[10:]).all()
    assert episode.sample_time == pytest.approx(0.1)


@pytest.mark.parametrize("steps", [COLUMNS, COLUMNS + 1, 3 * COLUMNS + 7, 9 * COLUMNS])
def test_a_long_episode_is_thinned_evenly_and_each_column_shows_a_step_of_its_own(steps):
    episode = EpisodeSamples(state(0))
    for k in range(steps):
        episode.state(state(k))
    stride = episode.stride
    assert stride == 2 ** int(np.ceil(np.log2(steps / COLUMNS)))
    shown = episode.fields[: episode.columns, 0]
    column = np.arange(episode.columns)
    assert (shown // stride == column).all()
    assert shown[-1] == steps - 1
    assert np.isnan(episode.fields[episode.columns :]).all()


def test_missed_steps_stay_blank():
    episode = EpisodeSamples(state(0))
    for k in (0, 1, 5):
        episode.state(state(k))
    assert np.isnan(episode.fields[2:5]).all() and not np.isnan(episode.fields[5]).any()


def test_a_state_of_another_batch_or_before_the_first_one_is_left_out():
    episode = EpisodeSamples(state(3))
    episode.state(state(3))
    before = episode.fields.copy()
    episode.state(state(2))
    episode.state(state(4, batch=3))
    np.testing.assert_array_equal(episode.fields, before)
    assert not episode.whole


@pytest.mark.parametrize("components", [1, 2])
@pytest.mark.parametrize("n", [4, ROWS, ROWS + 1, 65536, 1])
def test_rows_are_evenly_spaced_from_the_first_point_of_each_component_to_the_last(n, components):
    rows = rows_of(n * components, components).reshape(components, -1)
    for component, own in enumerate(rows - n * np.arange(components)[:, None]):
        assert len(own) == min(n, ROWS) and own[0] == 0 and own[-1] == n - 1, component
        assert n == 1 or (np.ptp(np.diff(own)) <= 1 and np.diff(own).min() >= 1)


def test_of_very_many_delayed_measurements_the_first_are_kept():
    measured = Frame(5, 1, 0, 0.0, np.arange(3.0 * 1000)[None], PLANT)
    episode = EpisodeSamples(measured, components=1000)
    episode.state(measured)
    assert episode.fields.shape == (COLUMNS, 3 * MAX_COMPONENTS)
    np.testing.assert_array_equal(episode.fields[0, episode.part(1)], [3, 4, 5])
    assert episode.part(999) == episode.part(MAX_COMPONENTS - 1)
