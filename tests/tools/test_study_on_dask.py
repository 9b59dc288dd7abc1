# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Studies on a Dask cluster: the same bits, and a worker with other versions is refused."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from pdeloop.cli import main
from pdeloop.study import Study, StudyError, run
from pdeloop.study import cluster as dask_client
from pdeloop.study.cluster import cluster
from pdeloop.study.results import read_study, reading
from pdeloop.study.table import status
from tests.support import study_tasks
from tests.support.dask_cluster import DaskCluster, address_in, dask_cluster
from tests.support.interpreter import ROOT
from tests.support.loop_harness import Forked, until
from tests.support.small_study import CONTENT, LIMIT, contents
from tests.support.study_tasks import runs_in


def installed_before(name: str, folder: Path, *others: str) -> str:
    """A folder with the newest versions of packages before those installed here."""
    older = [f"{each}<{metadata.version(each)}" for each in (name, *others)]
    options = ("--quiet", "--no-deps", "--no-compile", "--only-binary=:all:", "--retries=0")
    words = [sys.executable, "-m", "pip", "install", *options, "--target", str(folder), *older]
    done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT)
    if done.returncode:
        pytest.skip(f"another {name} cannot be had: {done.stderr.strip().splitlines()[-1]}")
    return str(folder)


def another_version(name: str, folder: Path) -> str:
    """Packages of a worker in whose environment this one seems to have the version 1.0."""
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    return f"{folder}:{ROOT}"


@pytest.mark.filterwarnings("default")  # of the libraries below Dask, in threads of its own
def test_a_dask_cluster_that_loses_a_worker_gives_the_same_bits(reference: Path, tmp_path: Path):
    out = tmp_path / "out"
    with dask_cluster(tmp_path, 2) as dask:
        one, other = dask.workers

        def kill_one(done: int, total: int, status: str) -> None:
            if done and one.poll() is None:
                one.kill()

        assert run(Study.of(CONTENT), out, partial(cluster, dask.address), tell=kill_one) == []
        assert one.wait(LIMIT) == -signal.SIGKILL and other.poll() is None

        def kill_the_other(done: int, total: int, status: str) -> None:
            if other.poll() is None:
                other.kill()
            if (
                "no worker is left; waiting for one to be started: PYTHONSAFEPATH=1 dask worker tcp"
                in status
            ):
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            run(
                Study.of(CONTENT),
                tmp_path / "no",
                partial(cluster, dask.address),
                tell=kill_the_other,
            )
    assert contents(out) == contents(reference)


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.filterwarnings("default")  # of the libraries below Dask, in threads of its own
def test_a_dask_worker_with_another_numpy_is_refused_or_accepted_and_marked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    older = another_version("numpy", tmp_path / "packages")
    file, out = tmp_path / "study.yaml", str(tmp_path / "out")
    content = {**CONTENT, "variants": {"two-point": {}}}
    file.write_text(json.dumps({**content, "seeds": 1}))
    with dask_cluster(tmp_path / "dask", 1, worker=older) as dask:
        dask.start_worker()
        dask.await_workers(2)
        words = ["study", str(file), "--out", out, "--scheduler", dask.address]
        assert main(words) == 1
        said = capsys.readouterr().err.strip().splitlines()[-1]
        assert re.fullmatch(
            r"pdeloop: a worker has numpy \S+ instead of \S+: .* --any-environment", said
        )
        dask.workers[1].kill()
        dask.workers[1].wait(LIMIT)
        dask.await_workers(1, exactly=True)
        # Workers are compared with each other, and not with this machine.
        assert main(words) == 0
    numpy = json.loads(contents(Path(out))["small/two-point/0/result.json"])["environment"]["numpy"]
    assert numpy == "1.0"
    assert "instead of" not in capsys.readouterr().out
    file.write_text(json.dumps(content))
    (tmp_path / "out/study.json").unlink()  # more seeds of the same study
    assert main(["study", str(file), "--out", out, "--processes", "1"]) == 1
    assert f"a worker has numpy {np.__version__} instead of {numpy}" in capsys.readouterr().err
    assert main(["study", "--out", out, "--processes", "1", "--any-environment"]) == 0
    told = capsys.readouterr().out
    assert "two-point*" in told and "*: some trainings had numpy " in told


@pytest.mark.filterwarnings("default")
def test_workers_that_are_retired_cost_the_trainings_that_they_run(tmp_path: Path):
    study, notes = Study.of({**CONTENT, "seeds": 8, "variants": {"noted": {}}}), tmp_path / "notes"
    notes.mkdir()
    tasks = {"noted": partial(study_tasks.noted, str(notes), 2.0)}
    lifetime = ("--lifetime", "12", "--lifetime-restart")
    with dask_cluster(tmp_path / "dask", 0) as dask:
        dask.start_worker(str(ROOT), *lifetime, nanny=True)
        dask.await_workers(1)
        failures = run(study, tmp_path / "out", partial(cluster, dask.address), tasks=tasks)
    found = status(tmp_path / "out")
    assert failures == [] and found["finished"] == 8 and found["workers_lost"] >= 1
    # A retired worker may carry its training on for a moment, for nothing.
    assert sum(runs_in(notes)) <= 8 + found["workers_lost"]


DRIVER = """
import sys
from functools import partial
from pathlib import Path
from pdeloop.study import Study, run
from pdeloop.study.cluster import cluster
from tests.support import study_tasks
from tests.support.small_study import CONTENT

if __name__ == "__main__":
    address, out, notes = sys.argv[1:]
    study = Study.of({**CONTENT, "seeds": 6, "variants": {"noted": {}}})
    tasks = {"noted": partial(study_tasks.noted, notes, 0.5)}
    run(study, Path(out), partial(cluster, address), tasks=tasks)
"""


def driver(address: str, out: Path, notes: Path, **environment: str) -> Forked:
    own = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    words = [DRIVER, address, str(out), str(notes)]
    return Forked("-c", words, notes.with_name("driver.log"), own)


@pytest.mark.filterwarnings("default")
def test_a_driver_that_dies_loses_nothing_and_what_was_finished_is_not_done_again(tmp_path: Path):
    notes, out = tmp_path / "notes", tmp_path / "out"
    notes.mkdir()
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    with dask_cluster(tmp_path / "dask", 2) as dask:
        first = driver(dask.address, out, notes, TMPDIR=str(temporary))
        until(lambda: len(runs_in(notes)) > 2, LIMIT, "third task")
        with pytest.raises(StudyError, match="another process is working on the study in"):
            run(read_study(out), out, partial(cluster, dask.address))
        assert status(out)["running"]
        first.kill()
        first.wait()
        known = status(out)
        assert not known["running"] and known["total"] == 6
        tasks = {"noted": partial(study_tasks.noted, str(notes), 0.5)}
        assert run(read_study(out), out, partial(cluster, dask.address), tasks=tasks) == []
    assert runs_in(notes) == [1] * 6 and status(out)["finished"] == 6
    assert not [*temporary.iterdir()]
    assert {path.name for path in out.iterdir()} == {"study.json", "results.sqlite", "lock"}


@pytest.mark.filterwarnings("default")
def test_what_a_driver_has_left_goes_on_where_its_workers_were_replaced_meanwhile(tmp_path: Path):
    notes, out = tmp_path / "notes", tmp_path / "out"
    notes.mkdir()
    with dask_cluster(tmp_path / "dask", 1) as dask:
        first = driver(dask.address, out, notes)
        until(lambda: len(runs_in(notes)) > 2, LIMIT, "third task")
        first.kill()
        first.wait()
        dask.workers[0].kill()
        dask.start_worker()
        tasks = {"noted": partial(study_tasks.noted, str(notes), 0.1)}
        assert run(read_study(out), out, partial(cluster, dask.address), tasks=tasks) == []
    assert len(runs_in(notes)) == 6 and status(out)["finished"] == 6


@pytest.mark.filterwarnings("default")
def test_what_kills_its_worker_or_raises_is_told_from_what_a_dying_worker_loses(tmp_path: Path):
    names = ("killing", "raising", "unsendable", "exiting", "noted")
    study = Study.of({**CONTENT, "seeds": 1, "variants": {name: {} for name in names}})
    places = {name: tmp_path / name for name in study.variants}
    for place in places.values():
        place.mkdir()
    tasks: dict[str, Any] = {
        "killing": partial(study_tasks.killing, str(places["killing"])),
        **{name: partial(vars(study_tasks)[name], str(places[name])) for name in names[1:4]},
        "noted": partial(study_tasks.noted, str(places["noted"]), 0.0),
    }
    with dask_cluster(tmp_path / "dask", 2, nanny=True) as dask:
        failures = run(study, tmp_path / "out", partial(cluster, dask.address), tasks=tasks)
    reasons = {failure.training: failure.reason for failure in failures}
    assert {*reasons} == {f"small/{name}/0" for name in names[:4]}
    assert "it kills its workers: 3 died in a row" in reasons["small/killing/0"]
    assert reasons["small/raising/0"] == "no model can be had"
    assert reasons["small/unsendable/0"] == "UnsendableError: 7 MPa are too much"
    assert reasons["small/exiting/0"] == "SystemExit: no licence"
    # The scheduler has it run again before the driver takes it back.
    assert all(runs_in(places[name]) == [1] for name in names[1:])
    assert runs_in(places["killing"])[0] in (3, 4)
    found = status(tmp_path / "out")
    assert (found["finished"], found["failed"]) == (1, 4) and found["workers_lost"] >= 3


@pytest.mark.filterwarnings("default")
def test_a_scheduler_that_is_killed_is_reported_in_a_sentence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    notes, file, out = tmp_path / "notes", tmp_path / "study.yaml", tmp_path / "out"
    file.write_text(json.dumps(CONTENT))
    notes.mkdir()
    with dask_cluster(tmp_path / "dask", 1) as dask:
        scheduler = dask.scheduler
        assert scheduler is not None

        def kill(folder: Path) -> None:
            until(lambda: [*folder.rglob("run.json")], LIMIT, "training that has begun")
            scheduler.kill()

        monkeypatch.setattr(dask_client, "CONNECTING", 5.0)
        killer = threading.Thread(target=kill, args=(out,))
        killer.start()
        assert main(["study", str(file), "--out", str(out), "--scheduler", dask.address]) == 1
        killer.join()
    told = capfd.readouterr()
    assert "Traceback" not in told.err + told.out and "distributed" not in told.err, told
    (line,) = [line for line in told.err.splitlines() if line.startswith("pdeloop: ")]
    assert "no Dask scheduler answers at tcp://127.0.0.1:" in line
    assert f"trainings are kept in {out}, which `pdeloop study --out {out}` continues" in line


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("seen", ["scheduler", "worker"])
def test_a_scheduler_that_ends_while_a_driver_connects_is_reported_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seen: str
):
    """Once the driver has seen its version, or that of its workers."""
    check = dask_client._check_versions
    monkeypatch.setattr(dask_client, "CONNECTING", 3.0)
    with dask_cluster(tmp_path / "dask", 1) as dask:

        def end_after(versions: dict[str, str], own: str) -> None:
            check(versions, own)
            if min(versions).startswith(seen):
                assert dask.scheduler is not None
                dask.scheduler.kill()
                dask.scheduler.wait()

        monkeypatch.setattr(dask_client, "_check_versions", end_after)
        with pytest.raises(StudyError, match="no Dask scheduler answers at tcp://"):
            run(Study.of(CONTENT), tmp_path / "out", partial(cluster, dask.address))


def test_a_finished_study_needs_no_workers(reference: Path):
    def none() -> NoReturn:
        raise AssertionError("asked for workers")

    assert run(read_study(reference), reference, none) == []


def other_processor(folder: Path) -> str:
    """Packages of a worker that has another processor."""
    return _packages(
        folder, "import llvmlite.binding\nllvmlite.binding.get_host_cpu_name = lambda: 'nocona'\n"
    )


def no_pdeloop(folder: Path) -> str:
    """Packages of a worker on a machine where pdeloop is not installed."""
    return _packages(
        folder,
        "import sys\n"
        "class Missing:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] in ('pdeloop', 'pde_sim_node', 'tests'):\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Missing())\n",
    )


def _packages(folder: Path, content: str) -> str:
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(content)
    return f"{folder}:{ROOT}"


def processors_by_seed(out: Path) -> dict[int, set[str]]:
    found: dict[int, set[str]] = {}
    with reading(out) as results:
        for row in results.rows("seed, environment"):
            processor = json.loads(row["environment"])["processor"]
            found.setdefault(row["seed"], set()).add(processor)
    return found


@pytest.mark.filterwarnings("default")
def test_workers_that_come_later_are_taken_by_their_kind_and_waited_for_when_they_go(
    tmp_path: Path,
):
    """One of another processor, which is killed and comes again, and one without pdeloop."""
    study = Study.of({**CONTENT, "variants": {"a": {}, "b": {}}, "seeds": 12})
    out, all_are_there = tmp_path / "out", tmp_path / "all are there"
    tasks = dict.fromkeys(study.variants, partial(study_tasks.waiting, str(all_are_there)))
    packages, bare = other_processor(tmp_path / "packages"), no_pdeloop(tmp_path / "bare")
    told: set[str] = set()
    with dask_cluster(tmp_path / "dask", 1) as dask:

        def come_and_go(done: int, total: int, status: str) -> None:
            told.add(status)
            if "workers have different processors (" in status and "gets no trainings" in status:
                all_are_there.touch()
            if done and len(dask.workers) == 1:
                dask.start_worker(packages)
                dask.start_worker(bare)
            elif len(dask.workers) == 3 and {"nocona"} in processors_by_seed(out).values():
                # Of its seeds those of the second variant are still to come.
                dask.workers[1].kill()
            if len(dask.workers) == 3 and "a processor nocona, which no worker has" in status:
                dask.start_worker(packages)

        run(study, out, partial(cluster, dask.address), tasks=tasks, tell=come_and_go)
        assert len(dask.workers) == 4
    processors = processors_by_seed(out)
    assert len(processors) == 12 and {len(own) for own in processors.values()} == {1}
    assert len(set.union(*processors.values())) == 2
    found = status(out)
    assert found["finished"] == 24 and found["workers_lost"] <= 1
    assert any("it does not answer (ModuleNotFoundError" in text for text in told)


@pytest.mark.filterwarnings("default")
def test_an_encrypted_scheduler_is_reached_with_certificates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    request = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "rsa:2048",
        "-nodes",
        "-days",
        "1",
        "-subj",
        "/CN=localhost",
    ]
    files = ["-subj", "/CN=localhost", "-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*request, *files], check=True, capture_output=True, timeout=LIMIT)
    own = ("--tls-ca-file", str(certificate), "--tls-cert", str(certificate), "--tls-key", str(key))
    file = tmp_path / "study.yaml"
    file.write_text(json.dumps({**CONTENT, "seeds": 1, "variants": {"two-point": {}}}))
    with ExitStack() as stack:
        dask = DaskCluster(tmp_path / "dask", stack, ("--protocol", "tls", *own))
        dask.start_scheduler()
        assert dask.address.startswith("tls://127.0.0.1:")
        dask.start_worker()
        words = ["study", str(file), "--out", str(tmp_path / "out"), "--scheduler", dask.address]
        assert (
            main(words) == 1 and "needs certificates: give --tls-ca-file" in capsys.readouterr().err
        )
        assert main([*words, *own[:2]]) == 1
        assert "all of --tls-ca-file, --tls-cert, --tls-key" in capsys.readouterr().err
        wrong = [*words, *own[:4], "--tls-key", str(file)]
        assert main(wrong) == 1 and "the certificates for tls://" in capsys.readouterr().err
        until(lambda: main([*words, *own]) == 0, LIMIT, "worker")


@pytest.mark.filterwarnings("default")
def test_a_scheduler_and_a_worker_with_another_dask_are_refused(tmp_path: Path):
    older = installed_before("distributed", tmp_path / "packages", "dask")
    words = f"has Dask .*, and this machine has {metadata.version('distributed')}; install the same"
    study = Study.of(CONTENT)
    one = dask_cluster(tmp_path / "one", 0, scheduler=older)
    with one as dask, pytest.raises(StudyError, match=f"the scheduler {words}"):
        run(study, tmp_path / "out", partial(cluster, dask.address))
    other = dask_cluster(tmp_path / "other", 1, worker=older)
    with other as dask, pytest.raises(StudyError, match=f"the worker at tcp://.* {words}"):
        run(study, tmp_path / "out", partial(cluster, dask.address))


def test_a_schedulers_file_is_awaited_until_it_is_written(tmp_path: Path):
    file = tmp_path / "scheduler.json"

    def write() -> None:
        for content in ("", '{"type": "Sched', '{"address": "tcp://127.0.0.1:8786"}'):
            file.write_text(content)
            time.sleep(0.1)

    writer = threading.Thread(target=write)
    writer.start()
    assert address_in(file) == "tcp://127.0.0.1:8786"
    writer.join()
