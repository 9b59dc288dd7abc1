# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop bag verify`: computes a recorded run again and compares it bit by bit.

The files of a bag are held against its metadata, and what is recorded of a run against the run's folder
where it lies there. The target is the plant's. Every complete episode is run again from its seeds,
policies and models (or the excitation's seed): initial fields, actions, states, costs, the reduced
model after exploration, times, signatures and /clock. The whole training is run again: every recorded
policy, with its models, must be one that it asks for, and every rollout that it asks for must be
recorded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from pdeloop.bags.headers import ClockTimes
from pdeloop.bags.reader import Bag, bags_of
from pdeloop.bags.recorded_run import RecordedRun
from pdeloop.bags.report import Report
from pdeloop.bags.run_claims import claims_of
from pdeloop.bags.survey import by_run
from pdeloop.messages.documents import parse_json
from pdeloop.messages.files import FileError, read_bounded
from pdeloop.messages.problem import read_problem
from pdeloop.messages.spec import MAX_YAML_BYTES, ParameterError
from recorder_node.bag import BagError

Parameters = Mapping[int, Mapping[str, Any]]
"""Those of the nodes, by run."""


def verify(*paths: Path, parameters: Path | None = None) -> Report:
    """Recompute the recordings in folders of bags, or of runs with all their bags.

    Several bags of one run are one. parameters: a file to use instead of what the bags say, in ROS form
    or a bag's parameters.json. BagError for a bag that cannot be read, ParameterError for parameters
    that describe no plant of this version.
    """
    bags = [bag for path in paths for bag in bags_of(path)]
    report = Report(", ".join(str(bag.path) for bag in bags))
    for bag in bags:
        _check_files(bag, report)
    known, every = _known(bags, parameters)
    claims = [c for c in map(claims_of, _whole_runs(bags)) if c is not None]
    report.differences_of(text for claim in claims for text in claim.unreadable)
    runs: dict[int, RecordedRun] = {}
    clock = ClockTimes()
    for bag in bags:
        for episode in bag.episodes():
            report.episodes += 1
            number = episode.key[1]
            if number not in runs:
                values = known.get(number, every)
                runs[number] = RecordedRun(number, values, report, bag.target())
            runs[number].episode(episode)
            clock.note(episode, runs[number].sample_time)
    if runs and all(run.sample_time is not None for run in runs.values()):
        clock.compare(
            [time for bag in bags for time in bag.survey.clock],
            report,
            published=all(run.publishes_clock for run in runs.values()),
        )
    for number, run in runs.items():
        # A folder that names no run is about the only one in the bag.
        about = (c for c in claims if c.run == number or (c.run is None and len(runs) == 1))
        run.finish(next(about, None))
    for claim in claims:
        if claim.result is None and not claim.unreadable and claim.finished:
            report.missing.append(f"result.json of the run in {claim.folder}")
        if claim.run is not None and claim.run not in runs:
            report.missing.append(
                f"all episodes of run {claim.run}, which is the one in {claim.folder}"
            )
    if not report.episodes:
        report.notes.append("no episode of the loop is in this bag")
    return report


def recorded_parameters(*paths: Path, parameters: Path | None = None) -> list[Mapping[str, Any]]:
    """The parameters of the runs that `verify` computes with the same arguments, where known."""
    bags = [] if parameters is not None else [bag for path in paths for bag in bags_of(path)]
    known, every = _known(bags, parameters)
    runs = [*known.values(), *([every] if every else [])]
    return [values for values in runs if "equation" in values]


def _check_files(bag: Bag, report: Report) -> None:
    """Compare the files of a bag with its metadata, and its parameters with those next to it."""
    where = f" ({bag.path})" if report.bag != str(bag.path) else ""
    try:
        findings = bag.findings()
    except BagError as error:  # its messages may be read all the same
        report.differs(str(error))
        return
    report.missing += [f"{text}{where}" for text in findings.missing]
    report.differences_of(f"{text}{where}" for text in findings.differences)
    report.differences_of(bag.contradicting_parameters())


def _known(bags: Sequence[Bag], given: Path | None) -> tuple[Parameters, Mapping[str, Any] | None]:
    """The parameters by run, and those of every run that is not among them."""
    if given is not None:
        return _given(given)
    known: dict[int, dict[str, Any]] = {}
    for bag in bags:
        for run, values in bag.parameters().items():
            known[run] = known.get(run, {}) | values
    return known, None


def _given(path: Path) -> tuple[Parameters, Mapping[str, Any] | None]:
    """The parameters in a file that the user gives: in ROS form, or a bag's parameters.json."""
    if path.suffix == ".json":
        try:
            return by_run(parse_json(read_bounded(path, MAX_YAML_BYTES))), None
        except FileError:
            raise
        except ValueError as error:
            raise ParameterError(f"{path} is not the parameters.json of a bag: {error}") from error
    return {}, read_problem(path)


def _whole_runs(bags: Sequence[Bag]) -> list[Path]:
    """The folders of which all bags are among these."""
    paths, found = {bag.path.resolve() for bag in bags}, []
    for folder in dict.fromkeys(path.parent for path in sorted(paths)):
        with suppress(BagError):  # it is not the folder of a run
            found += [folder] if {bag.path.resolve() for bag in bags_of(folder)} <= paths else []
    return found
