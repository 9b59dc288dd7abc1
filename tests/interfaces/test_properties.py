# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Round trips, and every malformed input refused with its sentence, for inputs nobody thought of."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdeloop.messages.frames import HEADER, MAX_ID, ArrayCodec, Frame, FrameError
from pdeloop.messages.parameter_file import yaml_text
from pdeloop.messages.parameters import table
from pdeloop.messages.problem import read_problem
from pdeloop.messages.protocol import ModelFailure
from pdeloop.messages.samples import unpack
from pdeloop.messages.spec import ParameterError, Spec, check
from tests.support.small import parameters, same_bits
from tuner_node import checkpoint
from tuner_node.budget import PURPOSES, Budget

# The same examples each time: a test that fails now and then says nothing.
tried = settings(derandomize=True, deadline=None, database=None, max_examples=60)

IDS = st.integers(0, MAX_ID - 1)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
LABELS = ("env", "row", "column")


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    shape = draw(st.lists(st.integers(0, 4), min_size=1, max_size=3))
    count = math.prod(shape)
    numbers = draw(st.lists(NUMBERS, min_size=count, max_size=count))
    run, episode, step, plant = (draw(IDS) for _ in range(4))
    return Frame(run, episode, step, draw(NUMBERS), np.array(numbers).reshape(shape), plant)


def same(a: Frame, b: Frame) -> bool:
    ids = ("run", "episode", "step", "time", "plant")
    return all(getattr(a, i) == getattr(b, i) for i in ids) and same_bits(a.values, b.values)


@tried
@given(frames(), frames())
def test_a_frame_comes_back_from_its_bytes_whatever_came_before(first, second):
    reader = ArrayCodec(LABELS[: first.values.ndim])
    assert same(reader.decode(ArrayCodec(reader.labels).encode(first)), first)
    if second.values.ndim == first.values.ndim:
        assert same(reader.decode(ArrayCodec(reader.labels).encode(second)), second)
        assert same(reader.decode(ArrayCodec(reader.labels).encode(first)), first)


@tried
@given(frames(), st.data())
def test_damaged_bytes_are_a_frame_error_or_a_sound_frame(frame, data):
    codec = ArrayCodec(LABELS[: frame.values.ndim])
    raw = bytearray(codec.encode(frame))
    codec.decode(bytes(raw))  # what follows is tried on the fast way, too
    for _ in range(data.draw(st.integers(0, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(raw[: data.draw(st.integers(0, len(raw)))])
    for bytes_ in (bytes(raw), cut, cut + data.draw(st.binary(max_size=20))):
        try:
            read = codec.decode(bytes_)
        except FrameError as error:
            assert str(error).startswith(("expected", "the message ends"))
            continue
        assert np.isfinite(read.values).all() and math.isfinite(read.time)
        assert all(0 <= i < MAX_ID for i in (read.run, read.episode, read.step, read.plant))
        assert 8 * (HEADER + read.values.size) <= len(bytes_)
    assert same(codec.decode(codec.encode(frame)), frame)


@tried
@given(st.binary(max_size=300))
def test_any_bytes_are_refused_by_codec_and_samples_alike(raw):
    with pytest.raises(FrameError):
        ArrayCodec(LABELS).decode(raw)
    with pytest.raises(FrameError):
        list(unpack(raw)[1])


@tried
@given(st.text(max_size=300))
def test_any_text_is_no_news_of_a_failed_model(text):
    try:
        ModelFailure.from_json(text)
    except ValueError as error:
        assert "\n" not in str(error)


@tried
@given(st.text(max_size=3000))
def test_a_reason_from_the_network_is_one_line_that_can_be_printed(text):
    shown = ModelFailure.from_json(ModelFailure(1, 2, True, text).to_json()).reason
    assert shown.isprintable() and len(shown.encode()) <= 4000
    assert shown == text or not text.isprintable() or len(text) > 1000 or "  " in f" {text} "


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=5,
)


@tried
@given(st.sampled_from(table()), ANYTHING)
def test_a_parameter_is_in_its_range_or_refused_with_it(spec: Spec, value: Any):
    try:
        taken = spec.check(value)
    except ParameterError as error:
        assert str(error).startswith(f"parameter '{spec.name}' is ") and spec.range in str(error)
        return
    assert type(taken) is spec.type
    if isinstance(taken, (int, float)):
        assert math.isfinite(taken)
        assert spec.minimum is None or taken >= spec.minimum
        assert spec.maximum is None or taken <= spec.maximum
    assert spec.check(taken) == taken


def within(spec: Spec) -> st.SearchStrategy[Any]:
    """Good values of a parameter."""
    if spec.choices:
        return st.sampled_from(spec.choices)
    if spec.file_name:
        return st.from_regex(r"\A[a-z0-9][a-z0-9_.-]{0,20}\Z")
    if spec.type is bool:
        return st.booleans()
    if spec.type is int:
        low, high = int(spec.minimum or 0), int(spec.maximum or 2**53)
        step = spec.multiple_of
        return st.integers(-(-low // step), high // step).map(lambda n: n * step)
    if spec.type is float:
        least = spec.minimum if spec.minimum is not None else 0.0
        return st.floats(
            least, spec.maximum or 1e300, exclude_min=spec.positive, allow_subnormal=False
        )
    if spec.numbers:
        return st.lists(st.floats(spec.minimum, spec.maximum, allow_subnormal=False), max_size=3)
    text = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), max_size=20)
    return st.lists(text, max_size=3) if spec.type is list else text


@tried
@given(st.data())
def test_parameters_come_back_from_their_file(data):
    some = st.lists(st.sampled_from(table()), min_size=1, max_size=5, unique_by=lambda s: s.name)
    specs = data.draw(some)
    values = check(specs, {spec.name: data.draw(within(spec)) for spec in specs})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "parameters.yaml"
        path.write_text(yaml_text(values, "some"), encoding="utf-8")
        assert check(specs, read_problem(path)) == values


@tried
@given(st.text(max_size=200) | ANYTHING.map(str))
def test_any_text_is_a_parameter_file_or_refused_by_name(text):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "parameters.yaml"
        path.write_text(text, encoding="utf-8", errors="replace")
        try:
            assert isinstance(read_problem(path), dict)
        except ParameterError as error:
            assert str(path) in str(error)


KINDS = st.sampled_from(["<f8", "<i8", "|b1", "<U5", "<c16"])
SHAPES = st.lists(st.integers(0, 3), max_size=3).map(tuple)


@tried
@given(
    st.dictionaries(st.from_regex(r"\A[a-z][a-z0-9_.]{0,9}\Z"), st.tuples(KINDS, SHAPES)), st.data()
)
def test_a_checkpoint_comes_back_and_no_changed_byte_is_taken(wanted, data):
    rng = np.random.default_rng(0)
    arrays = {
        name: rng.integers(0, 2, shape).astype(kind) for name, (kind, shape) in wanted.items()
    }
    found: list[dict[str, np.ndarray]] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint"
        checkpoint.save(path, arrays)
        assert checkpoint.restore(path, found.append) == (True, [])
        assert found[0].keys() == arrays.keys()
        for name, array in arrays.items():
            assert found[0][name].dtype == array.dtype and same_bits(found[0][name], array)
        raw = bytearray(path.read_bytes())
        raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(1, 255))
        path.write_bytes(raw[: data.draw(st.integers(0, len(raw)))])
        usable, (sentence,) = checkpoint.restore(path, found.append)
        assert not usable and len(found) == 1
        assert sentence.startswith(f"{path} is ")


@tried
@given(st.integers(1, 5), st.integers(20, 200), st.data())
def test_a_budget_comes_back_from_its_counts(seeds, rollouts, data):
    budget = Budget(seeds=seeds, rollouts=rollouts)
    owners = st.lists(st.integers(0, seeds - 1), max_size=6)
    for phase in data.draw(st.lists(st.sampled_from(list(PURPOSES)), max_size=6)):
        budget.count(phase, data.draw(owners))
    again = Budget(seeds=seeds, rollouts=rollouts)
    again.restore(budget.state())
    assert again.by_purpose() == budget.by_purpose()
    # What is paid and what is left for the adaptation is the budget, whatever was counted.
    adapted = np.array([known["adaptation"] for known in budget.by_purpose()])
    assert (budget.paid - adapted + budget.adaptation == rollouts).all()
    for row in range(seeds):
        left = rollouts - int(budget.paid[row])
        assert budget.allows(row, left) and not budget.allows(row, left + 1)
    with pytest.raises(ValueError, match="a budget of shape"):
        again.restore(np.zeros((len(PURPOSES), seeds + 1), dtype=np.int64))


def test_the_small_problem_comes_back_from_its_file(tmp_path):
    values = parameters()
    path = tmp_path / "parameters.yaml"
    path.write_text(yaml_text(values))
    assert read_problem(path) == values
