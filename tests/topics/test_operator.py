# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What an operator does with the services: pause, step, resume, stop; the policy stays the same."""

from __future__ import annotations

import signal

import pytest

from pdeloop.messages.protocol import STOPPED
from tests.support.loop_harness import Processes, until
from tests.support.operator_harness import SLOW, full_speed, operator
from tests.support.small import SMALL
from tests.support.small_loop import (
    LIMIT,
    PARAMETERS,
    adapted,
    assert_same_training,
    in_process,
    start_pair,
    start_tuner,
)

pytestmark = pytest.mark.topics
ITERATIONS = 24


def complaints(text: str) -> list[str]:
    """Warnings and errors, but for what a busy machine does: a process starts late, or is stopped."""
    lines = [line for line in text.splitlines() if "[WARN]" in line or "[ERROR]" in line]
    late = "was suspended; joined the network again", "[tuner_node]: waiting for "
    return [line for line in lines if not any(words in line for words in late)]


JOINED_AGAIN = """
import rclpy
from rclpy.parameter import Parameter
from pdeloop.messages.parameters import PLANT
from pdeloop.ros.parameters import declare, on_change, take_over

rclpy.init()
former = rclpy.create_node("plant")
declare(former, PLANT, {})
on_change(former, PLANT, lambda values: None)
former.set_parameters([Parameter("action_timeout", value=0.5), Parameter("", value=1)])
former.destroy_node()
node = rclpy.create_node("plant")
take_over(node, former)
on_change(node, PLANT, lambda values: None)
print(node.get_parameter("action_timeout").value)
for name, value in ("action_timeout", -1.0), ("max_repeats", 7), ("publish_clock", False):
    print(node.set_parameters([Parameter(name, value=value)])[0].successful)
print([spec.name for spec in PLANT if not node.has_parameter(spec.name)])
"""


def test_a_node_that_joins_the_network_again_has_the_parameters_that_were_set(loop: Processes):
    lines = loop.wait(loop.start("-c", JOINED_AGAIN, name="again"), LIMIT).splitlines()
    printed = [line for line in lines if "[INFO]" not in line]
    assert printed == ["0.5", "False", "True", "False", "[]"]


def test_a_paused_and_stepped_plant_gives_the_same_policy_and_nobody_complains(
    loop: Processes, tmp_path
):
    # The state would be void after 1 s without an answer, the episode silent after 2 s.
    running = start_pair(loop, max_repeats=20)
    out, iterations = tmp_path / "run", 150  # it goes on when the operator comes
    with operator(loop) as desk:
        running["tuner"] = start_tuner(loop, out, iterations=iterations, episode_timeout=2.0)
        until(lambda: adapted(out) >= 5, LIMIT, "iteration 5")
        desk.call("/pde_sim_node/pause")
        until(lambda: desk.values("pde_sim_node").get("paused") == "yes", LIMIT, "paused plant")
        desk.wait_for_reports("tuner_node", 2)  # the cost of an episode that ended just then is in
        done = adapted(out)
        desk.wait_for_reports("pde_sim_node", 4)
        assert adapted(out) == done
        _, level, message, values = desk.status("pde_sim_node")
        assert level == 1
        assert message.startswith("paused at step ")
        assert desk.status("controller_node")[1] == 0
        assert desk.values("controller_node")["plant paused"] == "yes"
        assert desk.values("tuner_node")["paused plants"] == "1"
        step = int(values["step"])
        for _ in range(3):
            desk.call("/pde_sim_node/step")
            step = step + 1 if step < 30 else 0
            until(
                lambda expected=str(step): desk.values("pde_sim_node")["step"] == expected,
                LIMIT,
                f"step {step}",
            )
            desk.wait_for_reports("pde_sim_node", 2)
            assert desk.values("pde_sim_node")["step"] == str(step)
        desk.call("/pde_sim_node/resume")
        loop.wait(running["tuner"], LIMIT)
        assert_same_training(out, in_process(iterations=iterations))
        until(
            lambda: desk.status("controller_node")[2] == "no episode under way",
            LIMIT,
            "end of the last episode",
        )
    for process in running.values():
        assert complaints(loop.output(process)) == []
    assert '"repeated"' not in (out / "progress.jsonl").read_text()


def test_a_plant_that_dies_in_a_pause_is_paused_again_and_so_is_nothing_changed(
    loop: Processes, tmp_path
):
    running = start_pair(loop, max_repeats=20, real_time_factor=SLOW)
    out = tmp_path / "run"
    with operator(loop) as desk:
        tuner = start_tuner(loop, out, iterations=ITERATIONS)
        until(lambda: adapted(out) >= 2, LIMIT, "iteration 2")
        desk.call("/pde_sim_node/pause")
        for process in running.values():  # the controller as well
            process.send_signal(signal.SIGKILL)
            process.wait()
        start_pair(loop, max_repeats=20)
        until(
            lambda: desk.status("pde_sim_node")[2].startswith("paused at step 0"),
            LIMIT,
            "paused plant",
        )
        done = adapted(out)
        desk.wait_for_reports("pde_sim_node", 3)
        assert adapted(out) == done
        assert desk.status("pde_sim_node")[2].startswith("paused at step 0")
        assert desk.call("/pde_sim_node/resume") == "resumed"
        loop.wait(tuner, LIMIT)
    assert_same_training(out, in_process(iterations=ITERATIONS))


def test_a_paused_tuner_begins_no_episode_and_keeps_the_plant_from_another_tuner(
    loop: Processes, tmp_path
):
    start_pair(loop, run_hold=3.0, real_time_factor=SLOW)
    out = tmp_path / "run"
    with operator(loop) as desk:
        tuner = start_tuner(loop, out, iterations=ITERATIONS)
        until(lambda: adapted(out) >= 2, LIMIT, "iteration 2")
        desk.call("/tuner_node/pause")
        until(
            lambda: desk.values("tuner_node").get("episodes under way") == "0", LIMIT, "quiet loop"
        )
        desk.wait_for_reports("pde_sim_node", 2)
        done = adapted(out)
        episodes = desk.values("pde_sim_node")["episodes"]
        desk.wait_for_reports("tuner_node", 5)  # longer than run_hold
        second = start_tuner(loop, tmp_path / "second", seed=1)
        text = loop.wait(second, LIMIT, code=1)
        assert "another tuner publishes /episode/start" in text.strip().splitlines()[-1]
        assert adapted(out) == done
        assert adapted(tmp_path / "second") == 0
        assert desk.values("pde_sim_node")["episodes"] == episodes
        tuner.send_signal(signal.SIGKILL)
        tuner.wait()
        tuner = start_tuner(loop, out, iterations=ITERATIONS, resume=True)
        until(
            lambda: "paused, as it was when its previous process ended" in loop.output(tuner),
            LIMIT,
            "restart",
        )
        desk.wait_for_reports("tuner_node", 3)
        assert adapted(out) == done
        # The last report of that name may be the refused one's.
        until(
            lambda: desk.status("tuner_node")[2].startswith("paused in rollout "),
            LIMIT,
            "report of the first tuner",
        )
        full_speed(desk)
        assert desk.call("/tuner_node/resume") == "resumed"
        loop.wait(tuner, LIMIT)
    assert_same_training(out, in_process(iterations=ITERATIONS))
    assert '"repeated"' not in (out / "progress.jsonl").read_text()


@pytest.mark.parametrize("paused", [False, True], ids=["running", "paused"])
def test_a_tuner_that_was_asked_to_stop_is_continued_to_the_same_policy(
    loop: Processes, tmp_path, paused
):
    start_pair(loop, real_time_factor=SLOW)
    out = tmp_path / "run"
    with operator(loop) as desk:
        tuner = start_tuner(loop, out, iterations=ITERATIONS)
        until(lambda: adapted(out) >= 2, LIMIT, "iteration 2")
        if paused:
            desk.call("/tuner_node/pause")
        desk.call("/tuner_node/stop")
        text = loop.wait(tuner, LIMIT, code=STOPPED)
        assert "stopped on request" in text
        assert 2 <= adapted(out) < ITERATIONS
        until(
            lambda: desk.status("pde_sim_node")[2] == "no run; ready for one", LIMIT, "free plant"
        )
        full_speed(desk)
    again = start_tuner(loop, out, iterations=ITERATIONS, resume="true")
    loop.wait(again, LIMIT)
    assert_same_training(out, in_process(iterations=ITERATIONS))


def test_the_command_line_ends_with_a_stopped_tuner(loop: Processes, tmp_path):
    out = tmp_path / "run"
    options = ("--iterations", "100000", "--optimizer", "two_point", "--out", str(out))
    with operator(loop) as desk:
        run = loop.pdeloop("train", str(SMALL), *options)
        until(lambda: adapted(out) >= 2, LIMIT, "iteration 2")
        desk.call("/tuner_node/stop")
        text = loop.wait(run, LIMIT, code=130)
    assert f"stopped by request; continue with: pdeloop train --resume {out}" in text
    assert not (out / "result.json").exists()


QUEUED = """
import rclpy, threading
from std_srvs.srv import Trigger
from pdeloop.ros import node_loop
rclpy.init()
node_loop.SERVING = 60.0  # on a busy machine one call may take as long as a round has
node, desk = rclpy.create_node("served"), rclpy.create_node("desk")
loop, answered, rounds = node_loop.NodeLoop(node), [], []
loop.introspection.offer("~/act", lambda: answered.append(1) or "done")
client = desk.create_client(Trigger, "/served/act")
assert client.wait_for_service(60)
for _ in range(20):
    client.call_async(Trigger.Request())
def count(now):
    rounds.append(len(answered))
    if len(answered) == 20:
        loop.stop("answered")
loop.run(tick=lambda now: None, deadline=lambda: None, housekeeping=count)
groups = len({*rounds})
# Idle as one that has waited for long, but for a minute.
node_loop.IDLE_BACKOFF, node_loop.IDLE_HOUSEKEEPING = 1e9, 60.0
answered.clear(), rounds.clear(), loop.resume()
threading.Timer(1.0, client.call_async, [Trigger.Request()]).start()
def look(now):
    rounds.append(now)
    if answered:
        loop.stop("answered")
loop.run(tick=lambda now: None, deadline=lambda: None, housekeeping=look)
print(groups, len(rounds), flush=True)
"""


def test_requests_that_wait_are_answered_together_and_one_wakes_an_idle_node(loop: Processes):
    """Not one a round; they may come in a few groups."""
    said = loop.wait(loop.start("-c", QUEUED, name="queued"), LIMIT)
    groups, rounds = map(int, said.split()[-2:])
    assert groups < 10 and rounds < 10


def test_services_that_do_not_fit_the_moment_say_why(loop: Processes):
    start_pair(loop)
    with operator(loop) as desk:
        success, message = desk.ask(call="/pde_sim_node/step")
        assert not success
        assert message == "the plant is not paused; expected a pause before a step"
        assert desk.call("/pde_sim_node/resume") == "was not paused"
        desk.call("/pde_sim_node/pause")
        desk.call("/pde_sim_node/pause")  # again: no harm
        success, message = desk.ask(call="/pde_sim_node/step")
        assert not success
        assert message == "no episode is under way; a step needs one"
        assert desk.call("/pde_sim_node/resume") == "resumed"


def test_a_malformed_request_for_parameters_is_refused_and_harms_no_node(loop: Processes):
    plant = start_pair(loop)["plant"]
    viewer = loop.node("viewer_node", *PARAMETERS)  # the other kind of event loop
    with operator(loop) as desk:
        for name, process in ("/pde_sim_node", plant), ("/viewer_node", viewer):
            desk.ask(malform=name)
            refusal = f"refused 1 message(s), the last one because: {name}/set_parameters: 42 is"
            until(lambda p=process, r=refusal: r in loop.output(p), LIMIT, f"refusal by {name}")
            assert desk.ask(get=[name, "use_sim_time"]) is False


REFUSED_AT_THE_END = """
import rclpy
from pdeloop.ros import node_loop
rclpy.init()
loop = node_loop.NodeLoop(rclpy.create_node("served"))
rounds = 0
def end(now):
    global rounds
    rounds += 1
    if rounds == 2:  # the first round has reported; the next report is a second later
        loop.introspection.refuse("state", ValueError("expected another shape"))
        loop.stop("the end")
loop.run(housekeeping=end)
"""


def test_what_a_node_refused_just_before_its_end_is_logged(loop: Processes):
    node = loop.start("-c", REFUSED_AT_THE_END, name="refusing")
    assert "refused 1 message(s), the last one because: state: expected" in loop.wait(node, LIMIT)
