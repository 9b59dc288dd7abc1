# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The results of a study: one SQLite file, which can be read while it grows.

DIR/study.json            what was asked for
DIR/results.sqlite        table `trainings`: a row for each one that has ended, or has lost a worker;
                          table `files`: the files of its run folder, compressed by zlib
DIR/unfinished/           run folders of the trainings that are being carried out, which those
                          processes share that see it (pdeloop.study.training.Place)
DIR/PROBLEM/VARIANT/SEED/ run folders of failed trainings, and those that were asked for
"""

from __future__ import annotations

import json
import secrets
import shlex
import shutil
import sqlite3
import time
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from pdeloop.messages.documents import parse_json
from pdeloop.messages.files import (
    FileError,
    make_folder,
    open_own,
    read_json,
    try_lock,
    write_atomically,
    writing_to,
)
from pdeloop.study.description import Study, StudyError

STUDY_FILE, RESULTS_FILE, UNFINISHED = "study.json", "results.sqlite", "unfinished"
BUSY = 30.0
"""Seconds that a reader waits for the writer, and the other way round."""
MOST = 2**30
"""Most bytes of a file of a run."""
_ADVICE = {
    sqlite3.SQLITE_FULL: "free some space there, and continue",
    sqlite3.SQLITE_CORRUPT: "put back a copy of it, or begin in another folder",
    sqlite3.SQLITE_NOTADB: "put back a copy of it, or begin in another folder",
}
_TABLES = """
CREATE TABLE IF NOT EXISTS study (id TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS trainings (
    name TEXT PRIMARY KEY, problem TEXT, variant TEXT, seed INTEGER,
    ended REAL, failure TEXT, deaths INTEGER NOT NULL DEFAULT 0,
    no_control REAL, lqt REAL, cost REAL, rollouts REAL, costs TEXT,
    plant INTEGER, parameters TEXT, environment TEXT
);
CREATE TABLE IF NOT EXISTS files (
    training TEXT, name TEXT, content BLOB, PRIMARY KEY (training, name)
);
"""


def made_with(result: Mapping[str, Any]) -> int | None:
    """The fingerprint of a result's plant, with that of the user's own law and optimiser, if known."""
    plant = result.get("plant")
    return None if plant is None else int(plant) ^ int(result.get("code", 0))


class Ended(NamedTuple):
    """A training that has ended.

    name: PROBLEM/VARIANT/SEED; row: entries of `trainings`, by column; files: content by name,
    compressed; empty of a failure.
    """

    name: str
    row: Mapping[str, Any]
    files: Mapping[str, bytes]

    @classmethod
    def well(cls, name: str, parameters: Mapping[str, Any], files: Mapping[str, bytes]) -> Ended:
        """A training with these resolved parameters, and files, result.json among them."""
        result = parse_json(files["result.json"])
        costs = result["costs_by_field"]
        means = {n: sum(costs[n][0]) / len(costs[n][0]) for n in costs}
        row = {
            "parameters": json.dumps(dict(parameters), sort_keys=True),
            "failure": None,
            "no_control": means.get("none"),
            "lqt": means.get("lqt"),
            "cost": means.get("adapted"),
            "rollouts": result["rollouts"][0]["total"],
            "costs": json.dumps(costs),
            "plant": made_with(result),
            "environment": json.dumps(result.get("environment", {}), sort_keys=True),
        }
        return cls(name, row, {file: zlib.compress(own, 1) for file, own in files.items()})

    @classmethod
    def failed(cls, name: str, parameters: Mapping[str, Any], why: str) -> Ended:
        """A training that cannot be carried out."""
        text = json.dumps(dict(parameters), sort_keys=True)
        return cls(name, {"parameters": text, "failure": why}, {})


class Results:
    """The results of the study in `folder`. StudyError where they cannot be read or written."""

    def __init__(self, folder: Path, connection: sqlite3.Connection) -> None:
        self.folder = folder
        self._connection = connection

    @property
    def study_id(self) -> str:
        """The id of this folder's study, by which workers and schedulers know it."""
        return str(self._rows("SELECT id FROM study")[0][0])

    def rows(self, columns: str, where: str = "ended IS NOT NULL") -> Iterator[dict[str, Any]]:
        """These columns of the trainings, in the order in which they ended."""
        names = [word.strip() for word in columns.split(",")]
        for row in self._rows(f"SELECT {columns} FROM trainings WHERE {where} ORDER BY ended"):
            yield dict(zip(names, row, strict=True))

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Have what is read in the block be of one moment; the writer waits for its end."""
        with _reported(self.folder, "read"):
            self._execute("BEGIN")
            try:
                yield
            finally:
                self._execute("COMMIT")

    def names(self) -> set[str]:
        """The trainings that have ended, with results or without."""
        return {row["name"] for row in self.rows("name")}

    def files(self, name: str) -> dict[str, bytes]:
        """The files of a training's run folder. StudyError if it has none here."""
        query = "SELECT name, content FROM files WHERE training = ? ORDER BY rowid"
        try:
            found = {file: _unpacked(content) for file, content in self._rows(query, (name,))}
        except zlib.error as error:
            raise StudyError(
                f"{self.folder / RESULTS_FILE}: {name} is damaged ({error})"
            ) from error
        if not found:
            raise StudyError(f"no results of {name} in {self.folder}")
        return found

    def extract(self, name: str, folder: Path) -> Path:
        """Write a training's run folder, `folder`/PROBLEM/VARIANT/SEED."""
        place = folder / name
        with writing_to(f"to {place}", StudyError):
            make_folder(place)
            for file, content in self.files(name).items():  # result.json last
                write_atomically(place / file, content)
        return place

    def add(self, ended: Iterable[Ended]) -> None:
        """Keep what has ended, all or nothing."""
        with self._transaction():
            for one in ended:
                self._set(one.name, {"ended": time.time(), **one.row})
                self._connection.executemany(
                    "INSERT OR REPLACE INTO files VALUES (?, ?, ?)",
                    [(one.name, file, content) for file, content in one.files.items()],
                )

    def died(self, name: str, deaths: int) -> None:
        """Keep how many workers a training has lost so far."""
        with self._transaction():
            self._set(name, {"deaths": deaths})

    def forget(self, names: Iterable[str]) -> None:
        """Remove these trainings' results."""
        with self._transaction():
            for name in names:
                self._execute("DELETE FROM trainings WHERE name = ?", (name,))
                self._execute("DELETE FROM files WHERE training = ?", (name,))

    def _set(self, name: str, entries: Mapping[str, Any]) -> None:
        problem, variant, seed = name.split("/")
        of = {"name": name, "problem": problem, "variant": variant, "seed": int(seed), **entries}
        words = ", ".join(f"{column} = excluded.{column}" for column in entries)
        self._execute(
            f"INSERT INTO trainings ({', '.join(of)}) VALUES ({', '.join('?' * len(of))}) "
            f"ON CONFLICT (name) DO UPDATE SET {words}",
            (*of.values(),),
        )

    def _rows(self, query: str, values: tuple[Any, ...] = ()) -> list[Any]:
        with _reported(self.folder, "read"):
            return self._connection.execute(query, values).fetchall()

    def _execute(self, query: str, values: tuple[Any, ...] = ()) -> None:
        self._connection.execute(query, values)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with _reported(self.folder, "write to"), self._connection:
            self._execute("BEGIN IMMEDIATE")
            yield


@contextmanager
def writing(folder: Path, study: Study) -> Iterator[Results]:
    """The results in `folder`, which other drivers are kept from; begins the study if there is none.

    StudyError if the folder holds another study or a run, another process works on it, or it cannot be
    written.
    """
    if (folder / "parameters.yaml").exists():
        raise StudyError(f"{folder} holds a run; choose another folder")
    with ExitStack() as stack:
        try:
            make_folder(folder)
            lock = stack.enter_context(open_own(folder / "lock", 0))
            if not try_lock(lock):
                raise StudyError(
                    f"another process is working on the study in {folder}; wait for it to end, or "
                    "stop it"
                )
            if not (folder / STUDY_FILE).exists():
                content = json.dumps(study.content(), indent=1).encode()
                write_atomically(folder / STUDY_FILE, content)
            elif read_study(folder) != study:
                raise StudyError(
                    f"{folder} holds another study; choose another folder, or give "
                    f"--out {shlex.quote(str(folder))} alone to continue the one there"
                )
            open_own(folder / RESULTS_FILE, 0).close()  # no link is followed
            results = stack.enter_context(_connected(folder))
            with _reported(folder, "write to"):
                results._connection.executescript(_TABLES)
                if not results._rows("SELECT id FROM study"):
                    with results._transaction():
                        results._execute("INSERT INTO study VALUES (?)", (secrets.token_hex(8),))
            make_folder(folder / UNFINISHED)
            write_atomically(folder / UNFINISHED / "study", results.study_id.encode())
        except (OSError, FileError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise StudyError(f"cannot write to {folder}: {why}") from error
        yield results
        # All trainings have ended; others may have finished the same ones meanwhile.
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)


@contextmanager
def reading(folder: Path) -> Iterator[Results]:
    """The results in `folder`, also while they grow. StudyError if there is no study."""
    read_study(folder)
    path = folder / RESULTS_FILE
    if path.is_symlink() or not path.is_file():
        raise StudyError(f"no results in {folder}: expected {RESULTS_FILE}")
    with _connected(folder) as results:
        yield results


def read_study(folder: Path) -> Study:
    """The study in `folder`. StudyError if there is none."""
    try:
        return Study.of(read_json(folder / STUDY_FILE))
    except (OSError, ValueError, AttributeError) as error:
        raise StudyError(f"no study in {folder}: {STUDY_FILE} cannot be used ({error})") from error


def is_worked_on(folder: Path) -> bool:
    """Whether a process is carrying out the study in `folder`."""
    try:
        with (folder / "lock").open("rb") as file:
            return not try_lock(file, shared=True)
    except (OSError, FileError):
        return False


@contextmanager
def _connected(folder: Path) -> Iterator[Results]:
    with _reported(folder, "read"):
        # Read-only where the file cannot be written; what a killed driver left half done is undone.
        uri = f"{(folder / RESULTS_FILE).resolve().as_uri()}?mode=rw"
        connection = sqlite3.connect(uri, BUSY, uri=True, isolation_level=None)
    with closing(connection):
        yield Results(folder, connection)


@contextmanager
def _reported(folder: Path, doing: str) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        advice = _ADVICE.get(getattr(error, "sqlite_errorcode", 0))
        more = f"; {advice}" if advice else ""
        raise StudyError(f"cannot {doing} {folder / RESULTS_FILE}: {error}{more}") from error


def _unpacked(content: bytes) -> bytes:
    unpacker = zlib.decompressobj()
    found = unpacker.decompress(content, MOST)
    if not unpacker.eof:
        raise zlib.error("it is incomplete, or too large")
    return found
