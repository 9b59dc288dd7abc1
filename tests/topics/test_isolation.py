# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""By default nothing of a run leaves the machine, and two runs on it do not meet."""

from __future__ import annotations

import contextlib
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from pdeloop.domain import DomainError, own_domain
from pdeloop.messages.problem import config_folder
from pdeloop.process.isolation import (
    NETWORK,
    PROFILE,
    check_profile,
    loopback_environment,
    outside_sockets,
)
from tests.support.loop_harness import ROOT, Processes, udp_sockets, until
from tests.support.small_loop import (
    LIMIT,
    assert_same_training,
    in_process,
    start_pair,
    start_tuner,
)

pytestmark = pytest.mark.topics


OF_ANOTHER_TYPE = """
import time
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from pdeloop.messages import topics
rclpy.init()
node = rclpy.create_node("of_another_type")
names = [value.name for value in vars(topics).values() if isinstance(value, topics.Topic)]
quality = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
made = [node.create_publisher(String, name, quality) for name in names]
print(len(made), flush=True)
while True:
    for publisher in made:
        publisher.publish(String(data="x" * 1000))
    time.sleep(0.01)
"""


def test_publishers_of_another_type_on_every_topic_change_nothing(
    loop: Processes, tmp_path: Path
) -> None:
    stranger = loop.start("-c", OF_ANOTHER_TYPE, name="of_another_type")
    until(lambda: loop.output(stranger), LIMIT, "publishers")
    assert int(loop.output(stranger)) >= 9
    nodes = start_pair(loop)
    tuner = start_tuner(loop, tmp_path / "run", iterations=5)
    assert "Traceback" not in loop.wait(tuner, LIMIT)
    assert_same_training(tmp_path / "run", in_process(iterations=5))
    assert stranger.poll() is None and all(node.poll() is None for node in nodes.values())


def test_the_hundred_and_third_node_of_a_domain_has_its_ports_and_all_on_loopback(loop: Processes):
    first = 7410 + 250 * int(loop.environment["ROS_DOMAIN_ID"])
    with contextlib.ExitStack() as held:
        for port in range(first, first + 2 * 102):
            taken = held.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            taken.bind(("127.0.0.1", port))
        node = loop.node("controller_node")
        until(lambda: "tracking law" in loop.output(node), LIMIT, "start of the node")
        own = udp_sockets(node.pid)
    assert {address for address, _ in own} == {"0100007F", "0100FFEF"}  # 127.0.0.1, 239.255.0.1
    assert ("0100007F", first + 2 * 102) in own, "no port on which others tell it what they have"


def test_a_profile_without_effect_is_noticed_and_refused(loop: Processes, tmp_path):
    # In the node's own copy of the configuration nothing has an effect; Fast DDS would only log that.
    # It runs in a network namespace without any interface, so that its defaults reach nobody.
    alone = ("unshare", "-n", "-m")
    if not shutil.which(alone[0]) or subprocess.run([*alone, "true"]).returncode != 0:
        pytest.skip("needs root, and the right to make namespaces")
    sources = tmp_path / "copy"
    for folder in ("pdeloop", "controller_node", "config"):
        shutil.copytree(ROOT / folder, sources / folder)
    (sources / "config" / "fastdds_loopback.xml").write_text(
        "<dds><profiles><nothing/></profiles></dds>"
    )
    environment = {**loop.environment, "PYTHONPATH": str(sources)}
    del environment[PROFILE]
    done = subprocess.run(
        # With a /dev/shm of its own: the defaults use it, and other tests watch the common one.
        [
            *alone,
            "sh",
            "-c",
            'mount -t tmpfs tmpfs /dev/shm && exec "$0" -m controller_node.node',
            sys.executable,
        ],
        env=environment,
        cwd=sources,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert "did not take effect" in done.stderr.strip().splitlines()[-1]


@pytest.mark.parametrize("content", [None, "", "<dds>broken", "<dds></dds>", "x" * 2**21])
def test_a_profile_that_is_none_is_refused_before_there_is_a_socket(tmp_path, monkeypatch, content):
    path = tmp_path / "mine.xml"
    if content is not None:
        path.write_text(content)
    monkeypatch.setenv(PROFILE, str(path))
    with pytest.raises(ValueError, match="is not a Fast DDS profile") as refusal:
        check_profile()
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)
    command = [sys.executable, "-m", "controller_node.node"]
    if content is None:
        done = subprocess.run(command, capture_output=True, text=True, timeout=600)
        assert (done.returncode, done.stderr) == (1, f"controller_node: {refusal.value}\n")
    monkeypatch.setenv(PROFILE, str(config_folder() / "fastdds_loopback.xml"))
    check_profile()


def test_a_socket_on_every_interface_counts_as_outside():
    before = outside_sockets()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as inside:
        inside.bind(("127.0.0.1", 0))
        assert outside_sockets() == before
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outside:
            outside.bind(("0.0.0.0", 0))
            assert outside_sockets() == [*before, "0.0.0.0"]


def test_the_user_opens_the_network_on_purpose(monkeypatch):
    expected = {PROFILE: str(config_folder() / "fastdds_loopback.xml")}
    assert loopback_environment() == expected
    monkeypatch.setenv(NETWORK, "1")
    assert loopback_environment() == {}
    monkeypatch.setenv(NETWORK, "0")
    monkeypatch.setenv(PROFILE, "/my/profile.xml")
    assert loopback_environment() == {}


def test_every_run_has_a_domain_of_its_own_unless_the_user_sets_one(monkeypatch):
    with own_domain() as first, own_domain() as second:
        assert first != second
        monkeypatch.setattr("pdeloop.domain.DOMAINS", (first, second))
        with pytest.raises(DomainError, match="are in use"), own_domain():
            pass
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    with own_domain() as chosen:
        assert chosen == 7
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(DomainError, match="'many'; expected a whole number"), own_domain():
        pass


@pytest.mark.parametrize("participant", [0, 3])
def test_a_domain_in_which_somebody_is_left_is_not_given_out(monkeypatch, participant):
    with own_domain() as first, own_domain() as second:
        pass
    monkeypatch.setattr("pdeloop.domain.DOMAINS", (first, second))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as busy:
        busy.bind(("127.0.0.1", 7410 + 250 * first + 2 * participant))
        for _ in range(10):
            with own_domain() as chosen:
                assert chosen == second


TAKES_A_DOMAIN = """
import sys
from pdeloop import domain
domain.DOMAINS = [int(sys.argv[1])]
with domain.own_domain():
    print("taken")
"""


def test_a_program_of_a_test_takes_no_domain_of_another_test() -> None:
    with own_domain() as held:
        command = [sys.executable, "-c", TAKES_A_DOMAIN, str(held)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 1 and "are in use" in done.stderr, done.stdout
