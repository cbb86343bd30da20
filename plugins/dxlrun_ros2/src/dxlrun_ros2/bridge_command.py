"""`dxlrun-ros2`: bridge of a running robot to ROS 2."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from contextlib import suppress
from typing import TYPE_CHECKING

from dxlrun import DxlrunError, connect, running
from dxlrun_ros2 import CLIENT

if TYPE_CHECKING:
    from dxlrun_ros2.bridge import Bridge

NICENESS = 10
"""Same niceness as the gateway, so that ROS only gets the processor time that the loop leaves"""
RETRY_S = 0.2
"""Time between two attempts to connect to the robot, s"""


def arguments(words: list[str]) -> argparse.Namespace:
    """Parse the command line without ROS arguments; exit with usage if it is invalid or ambiguous."""
    parser = argparse.ArgumentParser(
        "dxlrun-ros2", description="Bridge a running robot to ROS 2, with the names of ros2_control."
    )
    parser.add_argument(
        "robot", nargs="?", help="name of the robot, if several run; NAME@HOST:PORT for another computer"
    )
    parser.add_argument(
        "--lease",
        type=float,
        default=0.5,
        help="time from the last message of a publisher until its joints hold, s; default 0.5",
    )
    found = parser.parse_args(words)
    if not 0.01 <= found.lease <= 60:
        parser.error(f"--lease {found.lease:g}: give 0.01 to 60 s")
    if found.robot is None and len(names := running()) > 1:
        parser.error(f"several robots run: {', '.join(names)}; name one")
    return found


def main() -> int:
    """Bridge the robot's run to ROS 2, and after its end each following run, until Ctrl-C or SIGTERM."""
    from rclpy.utilities import remove_ros_args

    from dxlrun_ros2.bridge import Bridge

    given = arguments(remove_ros_args(sys.argv)[1:])
    with suppress(OSError):
        os.nice(NICENESS)
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    address: str | None = given.robot
    said = ""
    while not stopped.is_set():
        try:
            with connect(address, CLIENT) as robot:
                address, said = address or robot.name, ""
                _bridge(Bridge(robot, address, given.lease), robot.name, stopped)
        except DxlrunError as error:
            if str(error) != said:
                said = str(error)
                print(f"{said}; waiting", file=sys.stderr, flush=True)
            stopped.wait(RETRY_S)
    return 0


def _bridge(bridge: Bridge, name: str, stopped: threading.Event) -> None:
    """Serve a run until it ends or `stopped` is set; then close the bridge. Raises DxlrunError."""
    try:
        print(f"{name} is in ROS 2; Ctrl-C ends the bridge, not the robot.", flush=True)
        bridge.spin(stopped)
    finally:
        bridge.close()
