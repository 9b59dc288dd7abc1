# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Studies: the same results wherever the trainings run, whatever ends them meanwhile."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdeloop.cli import main
from pdeloop.finished_run import load_run
from pdeloop.study import Failure, Study, StudyError, cluster, executors, rows, run
from pdeloop.study.results import Ended, reading, writing
from pdeloop.study.table import text
from pdeloop.study.training import FILES, train_one
from tests.support.interpreter import ROOT
from tests.support.loop_harness import until
from tests.support.small import SMALL, same_bits, train_here
from tests.support.small_study import CONTENT, LIMIT, contents, here


def test_every_training_of_a_study_is_an_ordinary_run_with_the_bits_of_train(reference: Path):
    study = Study.of(CONTENT)
    trainings = study.trainings()
    assert len(trainings) == 4 and set(contents(reference)) == {
        f"{name}/{file}" for name in trainings for file in FILES
    }
    name = "small/model-based/1"
    alone = train_here(trainings[name])
    with np.load(BytesIO(contents(reference)[f"{name}/policy.npz"])) as kept:
        assert same_bits(kept["policy"], alone.policies())


def test_the_table_is_that_of_the_runs(reference: Path):
    table = rows(Study.of(CONTENT), reference)
    assert [(row["variant"], row["seeds"], row["rollouts"]) for row in table] == [
        ("model-based", 2, 9.0),
        ("two-point", 2, 9.0),
    ]
    files = contents(reference)
    found = [json.loads(files[f"small/two-point/{seed}/result.json"]) for seed in range(2)]
    costs = [result["mean_cost"]["adapted"] for result in found]
    assert np.isclose(table[1]["cost"], np.mean(costs), rtol=1e-12)
    low, high = table[1]["interval"]
    assert min(costs) <= low <= np.mean(costs) <= high <= max(costs)
    assert table[1]["worst"] == max(table[1]["cost_by_seed"])
    assert sum("two-point" in line for line in text(table).splitlines()) == 2


def test_the_models_of_a_study_may_have_different_orders(tmp_path: Path):
    """As with `reduced_order: 0`, which a training of several seeds refuses."""
    orders, study = (2, 3), Study.of({**CONTENT, "variants": {"own": {}}})
    with writing(tmp_path, study) as results:
        for order, (name, values) in zip(orders, study.trainings().items(), strict=True):
            results.add([Ended.well(name, values, train_one({**values, "reduced_order": order}))])
            run_folder = results.extract(name, tmp_path)
            assert len(load_run(run_folder).models[0].A) == order
    [row] = rows(study, tmp_path)
    assert row["seeds"] == len(row["cost_by_seed"]) == 2 and row["rollouts"] == 9.0


def test_the_result_is_a_function_of_the_parameters_alone():
    values = Study.of(CONTENT).trainings()["small/two-point/0"]
    assert train_one(values) == train_one(values)


def test_an_interrupted_study_trains_only_what_is_missing(reference: Path, tmp_path: Path):
    study, seen = Study.of(CONTENT), []

    def stop_after_two(done: int, total: int, status: str) -> None:
        seen.append((done, total))
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(study, tmp_path, here, tell=stop_after_two)
    kept = contents(tmp_path)
    assert 2 * len(FILES) <= len(kept) < 4 * len(FILES)
    damaged = tmp_path / "unfinished/small/two-point/1"  # as a crash between its files leaves it
    damaged.mkdir(parents=True, exist_ok=True)
    (damaged / "result.json").unlink(missing_ok=True)
    (damaged / "policy.npz").write_bytes(b"half")
    seen.clear()
    assert (
        run(study, tmp_path, here, tell=lambda done, total, status: seen.append((done, total)))
        == []
    )
    assert seen[0][0] >= 2 and seen[-1] == (4, 4)
    assert contents(tmp_path) == contents(reference)


def test_a_training_that_fails_is_named_and_the_others_are_kept(tmp_path: Path):
    wild = {"exploration_variance": 1e12}  # the plant diverges under exploration
    study = Study.of({**CONTENT, "seeds": 1, "variants": {"wild": wild, "tame": {}}})
    (failure,) = run(study, tmp_path, here)
    assert isinstance(failure, Failure) and failure.training == "small/wild/0"
    assert "lower exploration_variance" in failure.reason
    assert [row["variant"] for row in rows(study, tmp_path)] == ["tame"]


class Breaking(Executor):
    """Loses its workers after `successes` trainings, as a pool whose process is killed."""

    def __init__(self, successes: int) -> None:
        self._left = successes

    def submit(self, function: Any, /, *arguments: Any, **options: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if self._left:
            future.set_result(function(*arguments, **options))
        else:
            future.set_exception(BrokenProcessPool("a process ended"))
        self._left = max(0, self._left - 1)
        return future


def test_workers_that_end_are_replaced_and_those_that_always_end_are_reported(
    reference: Path, tmp_path: Path
):
    study, made = Study.of(CONTENT), []

    def breaking(successes: int) -> Executor:
        made.append(successes)
        return Breaking(successes)

    with pytest.raises(StudyError, match="the workers ended 3 times"):
        run(study, tmp_path / "never", lambda: breaking(0))
    assert made == [0, 0, 0] and contents(tmp_path / "never") == {}
    counts = iter((1, 0, 0, 4))  # two without a result are not yet three
    assert run(study, tmp_path / "once", lambda: breaking(next(counts))) == []
    assert contents(tmp_path / "once") == contents(reference)


def test_a_worker_with_other_versions_is_refused_or_accepted_on_request(
    reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from pdeloop.study import training

    study, true = Study.of(CONTENT), training.environment()

    def upgraded(done: int, total: int, status: str) -> None:
        if done == 2:  # the third has been carried out
            monkeypatch.setattr(training, "environment", lambda: {**true, "numpy": "9.0"})

    monkeypatch.setattr(executors, "AHEAD", 1)
    monkeypatch.setattr(executors, "UNKNOWN", 1)
    with pytest.raises(StudyError, match=r"a worker has numpy 9\.0 instead of .*any-environment"):
        run(study, tmp_path, lambda: Breaking(4), tell=upgraded)
    assert len(contents(tmp_path)) == 3 * len(FILES)
    assert run(study, tmp_path, here, any_environment=True) == []
    files = contents(tmp_path)
    found = [json.loads(files[f"{name}/result.json"]) for name in study.trainings()]
    assert [result["environment"]["numpy"] == "9.0" for result in found] == [0, 0, 0, 1]
    table = text(rows(study, tmp_path))
    assert "two-point*" in table and "*: some trainings had numpy 9.0 instead of " in table


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"problems": []}, "'problems' is"),
        ({"problems": ["kdv", "kdv"]}, "different names"),
        ({"seeds": 0}, "'seeds' is 0"),
        ({"seeds": 10**12}, "at most 1000000, or a list"),
        ({"seeds": [1, "2"]}, "'seeds' is"),
        ({"variants": ["a"]}, "'variants' is"),
        ({"variants": {"../a": {}}}, "expected a name of letters"),
        ({"variants": {"a": 1}}, "variant 'a' is 1"),
        ({"variants": {}}, "'variants' is empty"),
        ({"variants": {"a": {"seed": 4}}}, "leave them out, and give 'seeds' next to"),
        ({"settings": 3}, "'settings' is 3"),
        ({"settings": {"seeds": 4}}, "leave them out, and give 'seeds' next to"),
        ({"seed": 3}, "unknown entries: seed"),
        ({"/**": {}}, "this is a problem's file; expected a study's"),
    ],
)
def test_a_study_that_cannot_be_is_refused_in_one_sentence(change: dict[str, Any], sentence: str):
    with pytest.raises(StudyError, match=sentence):
        Study.of({**CONTENT, **change})
    with pytest.raises(
        StudyError, match=r"small, variant 'model-based': parameter 'rollouts' is -1"
    ):
        Study.of({**CONTENT, "settings": {"rollouts": -1}}).trainings()


@pytest.mark.usefixtures("forked_workers", "undrawn")
def test_the_command_runs_continues_and_refuses_another_study(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    file, out = tmp_path / "study.yaml", tmp_path / "out"
    file.write_text(json.dumps({**CONTENT, "seeds": 1}))  # JSON is YAML
    assert main(["study", str(file), "--out", str(out), "--processes", "1"]) == 0
    assert "results in" in capsys.readouterr().out and (out / "costs.png").stat().st_size > 1000
    for name in ("table.json", "costs.png"):
        (tmp_path / name).write_text("of somebody else")
        (out / name).unlink()
        (out / name).symlink_to(tmp_path / name)
    assert main(["study", "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["rows"]
    assert len(told) == 2 and json.loads((out / "table.json").read_text())["rows"] == told
    assert {(tmp_path / name).read_text() for name in ("table.json", "costs.png")} == {
        "of somebody else"
    }
    assert (out / "costs.png").stat().st_size > 1000  # not that of an earlier table
    file.write_text(json.dumps(CONTENT))
    assert main(["study", str(file), "--out", str(out)]) == 1
    assert "holds another study" in capsys.readouterr().err
    assert main(["study", "--out", str(out), "--run-folders", "*/two-point/0"]) == 0
    capsys.readouterr()
    (a_training,) = [path.parent for path in out.rglob("parameters.yaml")]
    assert a_training == out / "small/two-point/0" and main(["report", str(a_training)]) == 0
    capsys.readouterr()
    assert main(["study", str(file), "--out", str(a_training)]) == 1
    assert f"{a_training} holds a run" in capsys.readouterr().err
    assert main(["study", "--out", str(tmp_path / "none")]) == 1
    assert "no study in" in capsys.readouterr().err
    words = (str(file), "--out", str(tmp_path / "new"), "--scheduler")
    assert main(["study", *words, "127.0.0.1"]) == 1
    assert "expected one like tcp://localhost:8786" in capsys.readouterr().err
    assert main(["study", *words, ""]) == 1
    assert "address is ''; expected one like" in capsys.readouterr().err
    assert main(["study", *words, "tls://127.0.0.1:1"]) == 1
    assert "needs certificates" in capsys.readouterr().err
    monkeypatch.setattr(cluster, "CONNECTING", 1.0)
    assert main(["study", *words, "tcp://127.0.0.1:1"]) == 1
    assert "no Dask scheduler answers" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_report_of_a_study_points_to_its_table_and_its_runs(reference: Path, capsys: Any):
    assert main(["report", str(reference)]) == 1
    told = capsys.readouterr().err
    assert "table.json" in told and f"--out {reference} --run-folders" in told


def test_code_that_a_study_names_lies_beside_it_not_beside_its_problems(tmp_path: Path):
    """One is shipped, the other in a folder of its own."""
    (tmp_path / "problems").mkdir()
    (tmp_path / "problems" / "own.yaml").write_text(SMALL.read_text().replace("small", "own"))
    variants = {"search": {"optimizer": "search.py:Search"}, "law": {"law": "/abs/law.py:Law"}}
    given = {"problems": ["kdv", "problems/own.yaml"], "seeds": 1, "variants": variants}
    study = Study.of({**given, "settings": {"plant": "", "equation": "burgers"}}, tmp_path)
    assert study.variants["search"]["optimizer"] == f"{tmp_path}/search.py:Search"
    assert study.variants["law"]["law"] == "/abs/law.py:Law"
    assert study.settings["equation"] == "burgers"
    assert Study.of(study.content()).variants == study.variants


@pytest.mark.usefixtures("forked_workers")
def test_the_command_takes_an_own_equation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PDELOOP_EQUATIONS", "")  # to be as it was after the test
    monkeypatch.chdir(tmp_path)
    assert main(["new", "own"]) == 0
    settings = {"rollouts": 9, "horizon": 40, "evaluation_fields": 2}
    (tmp_path / "study.yaml").write_text(
        json.dumps({"problems": ["own/own.yaml"], "settings": settings})
    )
    words = ["study", "study.yaml", "--out", "out", "--processes", "1"]
    assert main(words) == 1 and not Path("out").exists()
    assert main([*words, "--equation", "own/own.py:Own"]) == 0
    assert "own/default/0/result.json" in contents(Path("out"))


def test_an_interrupted_command_ends_its_processes_in_the_middle(tmp_path: Path):
    file, out = tmp_path / "study.yaml", tmp_path / "out"
    endless = {"rollouts": 2_000_000, "optimizer": "two_point"}
    file.write_text(json.dumps({"problems": [str(SMALL)], "seeds": 9, "settings": endless}))
    words = [sys.executable, "-m", "pdeloop.cli", "study", str(file), "--out", str(out)]
    named = ["--plant", "own.py:Own", "--processes", "2"]  # code has to be named again
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    process = subprocess.Popen(
        [*words, *named],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "TMPDIR": str(temporary)},
    )
    assert process.stdout is not None
    try:
        # A busy machine may say first that it compiles.
        assert any("0 of 9 trainings" in line for line in process.stdout)
        until(lambda: [*out.rglob("run.json")], LIMIT, "training that has files")
        process.send_signal(signal.SIGINT)
        told, _ = process.communicate(timeout=LIMIT)
    finally:
        process.kill()
    again = shlex.join(["pdeloop", "study", "--out", str(out), *named])
    assert process.returncode == 130 and f"continue with: {again}\n" in told
    assert "Traceback" not in told, told
    assert not list(out.rglob("result.json"))
    assert not [*temporary.iterdir()]


@pytest.mark.usefixtures("forked_workers")
def test_a_continued_study_never_mixes_two_problems(
    reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out, file = tmp_path / "out", tmp_path / "small.yaml"
    file.write_text(SMALL.read_text())
    study = Study.of({**CONTENT, "problems": [str(file)]})

    def stop_after_one(done: int, total: int, status: str) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(study, out, here, tell=stop_after_one)
    before = contents(out)
    file.write_text(SMALL.read_text().replace("reduced_order: 4", "reduced_order: 3"))
    assert main(["study", "--out", str(out)]) == 1
    told = capsys.readouterr().err
    assert "reduced_order: 4 there, 3 now" in told and "--again" in told and len(told) < 500
    assert contents(out) == before
    assert main(["study", "--out", str(out), "--again", "--processes", "1"]) == 0
    capsys.readouterr()
    assert {row["seeds"] for row in rows(study, out)} == {2}
    files = contents(out).items()
    assert all(b"reduced_order: 3" in own for name, own in files if name.endswith(".yaml"))


def test_exchanged_and_copied_results_are_refused(reference: Path, tmp_path: Path):
    study = Study.of(CONTENT)
    one, two = tmp_path / "exchanged", tmp_path / "copied"
    for place in (one, two):  # as copied from another machine, without the table
        with reading(reference) as results:
            for name in results.names():
                results.extract(name, place)
    a, b = (one / f"small/two-point/{seed}" for seed in range(2))
    a.rename(one / "c")
    b.rename(a)
    (one / "c").rename(b)
    with pytest.raises(StudyError, match=r"small/two-point/0 .*seed: 1 there, 0 now.*and 1 more"):
        run(study, one, here)
    shutil.rmtree(two / "small/model-based/1")
    shutil.copytree(two / "small/model-based/0", two / "small/model-based/1")
    with pytest.raises(StudyError, match=r"small/model-based/1 .*seed: 0 there, 1 now"):
        run(study, two, here)


PLANT = """
import numpy as np
import pdeloop

class Rod(pdeloop.Dynamics):
    n_z, n_a, horizon, sample_time = 5, 2, 6, 0.5
    radius = 0.9

    def initial_state(self, rng):
        return rng.standard_normal(5)

    def step(self, z, a):
        return self.radius * z + np.repeat(a, [2, 3])
"""


@pytest.mark.parametrize(
    ("word", "example", "name"),
    [
        ("law", "laws/saturating.py", "Saturating"),
        ("optimizer", "random_search.py", "RandomSearch"),
    ],
)
@pytest.mark.usefixtures("forked_workers")
def test_an_edited_law_or_optimizer_is_another_one(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    word: str,
    example: str,
    name: str,
):
    monkeypatch.setenv(f"PDELOOP_{word.upper()}S", "")  # to be as it was after the test
    source = (ROOT / "examples" / example).read_text()
    code, file, out = tmp_path / f"own_{word}.py", tmp_path / "study.yaml", str(tmp_path / "out")
    code.write_text(source)
    settings = {"rollouts": 12, "evaluation_fields": 2, "optimizer": "two_point"}
    settings[word] = f"{code}:{name}"
    file.write_text(json.dumps({"problems": [str(SMALL)], "seeds": 1, "settings": settings}))
    words = ["--out", out, f"--{word}", f"{code}:{name}", "--processes", "1"]
    assert main(["study", str(file), *words]) == main(["study", *words]) == 0
    code.write_text(source + "\nEDITED = True\n")
    capsys.readouterr()
    assert main(["study", *words]) == 1
    assert f"another plant, or the {word}: its code" in capsys.readouterr().err
    assert main(["study", *words, "--again"]) == main(["study", *words]) == 0


@pytest.mark.usefixtures("forked_workers")
def test_an_edited_plant_is_another_plant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("PDELOOP_PLANTS", "")  # to be as it was after the test
    code, file, out = tmp_path / "rod.py", tmp_path / "study.yaml", str(tmp_path / "out")
    (tmp_path / "rod.yaml").write_text(
        f"/**: {{ros__parameters: {{problem: rod, plant: {code}:Rod}}}}"
    )
    settings = {"rollouts": 7, "evaluation_fields": 2, "reduced_order": 2, "optimizer": "two_point"}
    file.write_text(json.dumps({"problems": ["rod.yaml"], "seeds": 1, "settings": settings}))
    words = ["--out", out, "--plant", f"{code}:Rod", "--processes", "1"]
    code.write_text(PLANT)
    assert main(["study", str(file), *words]) == main(["study", *words]) == 0
    code.write_text(PLANT.replace("0.9", "0.99"))
    capsys.readouterr()
    assert main(["study", *words]) == 1
    assert "another plant: its code or its data have changed" in capsys.readouterr().err
    assert main(["study", *words, "--again"]) == main(["study", *words]) == 0
