# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The description of a study. Pure but for the problems' files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pdeloop.messages.problem import code_from, find_problem, read_problem
from pdeloop.messages.text import shown
from pdeloop.training_run import resolve
from tuner_node.build import build_training

MAX_SEEDS = 1_000_000
"""Most seeds of a study that gives their number."""
MAX_PATH = 1000
"""Characters of a problem's name or file."""
_NAME = re.compile(r"[\w.+-]{1,60}")


class StudyError(ValueError):
    """The study cannot be run as asked; the text says why and what to do."""


@dataclass(frozen=True)
class Study:
    """Trainings of every problem, by every variant, with every seed.

    problems: shipped name or YAML file of each problem, by its name; variants: the parameters that
    each sets; settings: those that all trainings set; curves: keep the cost of every policy that a
    training has, on the evaluation fields.
    """

    problems: Mapping[str, str]
    seeds: tuple[int, ...]
    variants: Mapping[str, Mapping[str, Any]]
    settings: Mapping[str, Any]
    curves: bool = False

    @classmethod
    def of(cls, content: object, folder: Path = Path()) -> Study:
        """The study that a file describes; relative paths in it are taken relative to `folder`.

        >>> Study.of({"problems": ["kdv"], "seeds": 2, "variants": {"default": {}}}).seeds
        (0, 1)
        """
        if not isinstance(content, dict):
            raise StudyError(f"the study is {shown(content)}; expected a table with 'problems'")
        if "/**" in content:
            raise StudyError(
                "this is a problem's file; expected a study's, which lists it in 'problems'"
            )
        entries = ("problems", "seeds", "variants", "settings", "curves")
        unknown = sorted(set(map(str, content)) - {*entries})
        if unknown:
            some = ", ".join(name[:60] for name in unknown[:10])
            raise StudyError(f"unknown entries: {some}; expected {', '.join(entries)}")
        problems, seeds = content.get("problems"), content.get("seeds", 1)
        if not isinstance(problems, list) or not problems:
            raise StudyError(
                f"'problems' is {shown(problems)}; expected a list of names or YAML files"
            )
        for word in problems:
            if not isinstance(word, str) or not 0 < len(word) <= MAX_PATH:
                raise StudyError(
                    f"'problems' holds {shown(word)}; expected names or YAML files, texts of at most "
                    f"{MAX_PATH} characters"
                )
        if type(seeds) is int and 0 < seeds <= MAX_SEEDS:
            seeds = range(seeds)
        elif not isinstance(seeds, list) or not seeds or any(type(s) is not int for s in seeds):
            raise StudyError(
                f"'seeds' is {shown(seeds)}; expected their number, at most {MAX_SEEDS}, or a list of "
                "them"
            )
        variants, settings = content.get("variants", {"default": {}}), content.get("settings", {})
        curves = content.get("curves", False)
        if type(curves) is not bool:
            raise StudyError(f"'curves' is {shown(curves)}; expected true or false")
        for name, table in (("variants", variants), ("settings", settings)):
            if not isinstance(table, dict):
                raise StudyError(f"'{name}' is {shown(table)}; expected a table")
        if not variants:
            raise StudyError("'variants' is empty; expected one or more, such as: default: {}")
        for name, table in variants.items():
            if not isinstance(name, str) or not _NAME.fullmatch(name):
                raise StudyError(
                    f"variant {shown(name)}; expected a name of letters, digits, . + - _"
                )
            if not isinstance(table, dict):
                raise StudyError(
                    f"variant '{name}' is {shown(table)}; expected a table of parameters"
                )
        if any(
            own in table for table in (settings, *variants.values()) for own in ("seed", "seeds")
        ):
            raise StudyError(
                "the settings or a variant have 'seed' or 'seeds'; leave them out, and give 'seeds' "
                "next to 'problems'"
            )
        settings = _beside(settings, folder)
        variants = {name: _beside(table, folder) for name, table in variants.items()}
        files = {}
        for word in problems:
            beside = folder / word
            file = str(beside.resolve()) if beside.is_file() else word
            name = str(read_problem(find_problem(file)).get("problem", Path(file).stem))
            if not _NAME.fullmatch(name) or name in files:
                raise StudyError(f"problem '{name}' of {file}; expected different names")
            files[name] = file
        return cls(files, tuple(sorted(set(seeds))), variants, settings, curves)

    def having(self, settings: Mapping[str, Any]) -> Study:
        """The study in which all trainings have these settings, instead of its own.

        StudyError for one that a variant sets, and for seeds, which a study has itself.
        """
        for name in settings:
            if name in ("seed", "seeds"):
                raise StudyError(f"'{name}' is not a setting of a study; give its 'seeds' instead")
            if other := [variant for variant, own in self.variants.items() if name in own]:
                raise StudyError(f"'{name}' is set by variant '{other[0]}' itself; change it there")
        return replace(self, settings={**self.settings, **settings})

    def content(self) -> dict[str, Any]:
        """The content that `of` makes this study from."""
        return {
            "problems": list(self.problems.values()),
            "seeds": list(self.seeds),
            "variants": {name: dict(table) for name, table in self.variants.items()},
            "settings": dict(self.settings),
            "curves": self.curves,
        }

    def trainings(self) -> Mapping[str, dict[str, Any]]:
        """The resolved parameters of every training, by its name PROBLEM/VARIANT/SEED."""
        found: dict[str, dict[str, Any]] = {}
        for problem, file in self.problems.items():
            for variant, table in self.variants.items():
                own = {**self.settings, **table, "seed": self.seeds[0], "seeds": 1}
                try:
                    values = resolve(file, own)
                    build_training(values)
                except ValueError as error:
                    raise StudyError(f"{problem}, variant '{variant}': {error}") from error
                found[f"{problem}/{variant}"] = values
        return _Trainings(found, self.seeds)


class _Trainings(Mapping[str, dict[str, Any]]):
    """The parameters of many trainings, which are made when they are asked for."""

    def __init__(self, values: Mapping[str, Mapping[str, Any]], seeds: Sequence[int]) -> None:
        self._values, self._seeds = values, dict.fromkeys(seeds)

    def __getitem__(self, name: str) -> dict[str, Any]:
        whose, _, seed = name.rpartition("/")
        if not seed.lstrip("-").isdecimal() or int(seed) not in self._seeds:
            raise KeyError(name)
        return {**self._values[whose], "seed": int(seed)}

    def __iter__(self) -> Iterator[str]:
        return (f"{whose}/{seed}" for whose in self._values for seed in self._seeds)

    def __len__(self) -> int:
        return len(self._values) * len(self._seeds)


def _beside(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Parameters of which those that name code in a relative file name it from the study's folder."""
    code = {
        word: code_from(folder.resolve(), table[word])
        for word in ("equation", "plant", "optimizer", "law")
        if isinstance(table.get(word), str)
    }
    return {**table, **code}
