# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What of a user's ROS environment is left out, what is refused, and in which words."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

from pdeloop.process import ros_environment
from pdeloop.process.isolation import NETWORK, PROFILE, loopback_profile
from pdeloop.process.ros_environment import RosEnvironmentError, prepared, with_log_folder
from pdeloop.supervisor import Child
from pdeloop.training_run import Waiting

OWN = {"HOME": "/home/me", "ROS_DOMAIN_ID": "7"}


def test_an_environment_without_ros_gets_the_profile_and_needs_no_word() -> None:
    found, remarks = prepared(OWN)
    assert found == {**OWN, PROFILE: str(loopback_profile()), "SKIP_DEFAULT_XML_FILE": "1"}
    assert remarks == []
    assert prepared(found) == (found, [])


@pytest.mark.parametrize(
    ("name", "value", "instead"),
    [
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF", "SUBNET"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST", "SUBNET"),
        ("ROS_LOCALHOST_ONLY", "1", "0"),
        ("ROS_STATIC_PEERS", "192.168.1.5", None),
        ("ROS_DISCOVERY_SERVER", "192.168.1.5:11811", None),
        ("RMW_FASTRTPS_USE_QOS_FROM_XML", "1", "0"),
        ("FASTDDS_ENVIRONMENT_FILE", "/tmp/variables.json", None),
        ("FASTDDS_BUILTIN_TRANSPORTS", "LARGE_DATA", None),
    ],
)
def test_what_contradicts_messages_on_this_machine_is_left_out_by_name(
    name, value, instead
) -> None:
    found, (remark,) = prepared({**OWN, name: value})
    assert found.get(name) == instead
    assert remark == f"{name}={value} is ignored: the messages stay on this machine"
    if (name, value) != ("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF"):
        for open_one in ({NETWORK: "1"}, {PROFILE: "/home/me/profile.xml"}):
            given = {**OWN, **open_one, name: value}
            if not (name == "ROS_LOCALHOST_ONLY" and NETWORK in open_one):
                assert prepared(given) == (given, [])


def test_a_discovery_server_on_this_machine_is_kept() -> None:
    for servers in ("127.0.0.1:11811", "localhost:1;127.0.0.1:2", ";127.0.0.1"):
        found, remarks = prepared({**OWN, "ROS_DISCOVERY_SERVER": servers})
        assert found["ROS_DISCOVERY_SERVER"] == servers and remarks == []


def test_a_middleware_that_is_not_there_is_replaced_and_another_one_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = {**OWN, "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    found, (remark,) = prepared(given)
    assert found["RMW_IMPLEMENTATION"] == "rmw_fastrtps_cpp"
    assert (
        remark == "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp is not installed: rmw_fastrtps_cpp is used"
    )
    (tmp_path / "ros" / "lib").mkdir(parents=True)
    (tmp_path / "ros" / "lib" / "librmw_cyclonedds_cpp.so").touch()
    given["AMENT_PREFIX_PATH"] = str(tmp_path / "ros")
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "usr"))  # not that of the wheels
    with pytest.raises(
        RosEnvironmentError, match="RMW_IMPLEMENTATION=rmw_cyclonedds_cpp: only rmw_f"
    ):
        prepared(given)
    open_one = {**given, NETWORK: "1"}
    assert prepared(open_one) == (open_one, [])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"ROS_DOMAIN_ID": "lab"}, "ROS_DOMAIN_ID is 'lab'; expected a whole number from 0 to 232"),
        ({"ROS_DOMAIN_ID": "233"}, "ROS_DOMAIN_ID is '233'"),
        (
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "off"},
            "RANGE is 'off'; expected one of OFF, LOCALHOST",
        ),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", NETWORK: "1"}, "=OFF: no node finds another"),
        ({"ROS_LOCALHOST_ONLY": "1", NETWORK: "1"}, "contradict each other; unset one"),
        ({"ROS_SECURITY_ENABLE": "true"}, "ROS_SECURITY_"),
        ({"RCUTILS_COLORIZED_OUTPUT": "yes"}, "RCUTILS_COLORIZED_OUTPUT is 'yes'; expected 0 or 1"),
        ({"RCUTILS_LOGGING_USE_STDOUT": "2"}, "RCUTILS_LOGGING_USE_STDOUT is '2'"),
    ],
)
def test_what_cannot_work_is_refused_by_its_name(given: dict[str, str], words: str) -> None:
    with pytest.raises(RosEnvironmentError) as refused:
        prepared({"HOME": "/home/me", **given})
    assert words in str(refused.value) and "\n" not in str(refused.value)


def test_the_mark_of_another_shells_wheels_is_removed() -> None:
    mark = {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}
    assert "_ROS_WHEELS_BOOTSTRAP_COMPLETE" not in prepared({**OWN, **mark})[0]
    libraries = {"LD_LIBRARY_PATH": f"/opt/lib:{sys.prefix}/lib"}
    assert "_ROS_WHEELS_BOOTSTRAP_COMPLETE" in prepared({**OWN, **mark, **libraries})[0]


def test_logs_have_a_folder_where_the_home_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros_environment.tempfile, "gettempdir", lambda: str(tmp_path))
    mine = {"HOME": str(tmp_path / "me")}
    assert with_log_folder(mine) == (mine, [])
    blocked = tmp_path / "file"
    blocked.touch()
    found, (remark,) = with_log_folder({"HOME": str(blocked)})
    assert found["ROS_LOG_DIR"].startswith(f"{tmp_path}/pdeloop-logs-")
    assert "cannot be written: logs go to" in remark and "ROS_LOG_DIR" in remark
    with pytest.raises(RosEnvironmentError, match=r"ROS_LOG_DIR=.*file is not writable"):
        with_log_folder({"HOME": str(tmp_path), "ROS_LOG_DIR": str(blocked)})


def test_what_the_nodes_wait_for_is_said_once_where_a_training_stands_still(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, told = tmp_path / "tuner_node.log", list[str]()
    monkeypatch.setattr(time, "time", lambda: 1000.0)
    waiting = Waiting([Child("tuner_node", lambda: [], log)], told.append)
    begin = time.monotonic()
    waiting.look(begin + 6.0, False)
    log.write_text("[WARN] [900.5] [tuner_node]: waiting for the recorder for 3 s\n")
    waiting.look(begin + 8.0, False)
    assert told == []  # there was no warning, or one of long ago
    for seconds in (5, 10):
        with log.open("a") as file:
            file.write(
                f"[WARN] [998.5] [tuner_node]: waiting for plant for {seconds} s\n[INFO] ...\n"
            )
        waiting.look(begin + 10.0 + seconds, False)
    assert told == ["  [tuner_node]: waiting for plant for 5 s"]
    waiting.look(begin + 30.0, True)
    waiting.look(begin + 34.0, False)
    assert len(told) == 1
