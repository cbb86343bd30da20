"""Beside the loop: what it notices of a program that shows the robot, and what that keeps of dying clients.

A robot runs in real time with its log, and the program, such as `dxlrun view`, beside it all the time. In
every other block a client looks as its users do; in the blocks between it sleeps. Each block with a client
gives a ratio to the two beside it, of medians: of how late the loop woke up, and of the time from there until
goals were sent. The interval is Student's, over the ratios' logarithms. Then clients connect, look, and die
one after the other.

    python bench/beside_loop.py view [--robot robots/humanoid_20.yaml] [--blocks 20] [--seconds 20]
    python bench/beside_loop.py foxglove
    DXLRUN_ROS2_PYTHON=PYTHON python bench/beside_loop.py ros2
"""

from __future__ import annotations

import argparse
import http.client
import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Protocol

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from scipy.stats import t as student
from tests.ros2 import started
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

import dxlrun
from dxlrun.log.log_reader import read_log

DXLRUN = Path(sys.executable).with_name("dxlrun")
ROBOT = Path(__file__).parents[1] / "robots" / "humanoid_20.yaml"
PERIOD_S = 0.04
RECONNECTIONS = 50
SETTLING_S = 4.0
"""At the begin of a block, which does not count: a ROS program has found the bridge by then."""


class Beside(Protocol):
    """A program beside the loop, and its clients."""

    command: Sequence[Path | str]
    """The first line that it prints has its address."""

    def look(self, address: str, seconds: float) -> None:
        """Let a client look for so long."""

    def die(self, address: str) -> None:
        """Let a client connect, look once, and die."""


class View:
    """`dxlrun view` and a browser, which looks 25 times a second with four curves."""

    command = (DXLRUN, "view", "--no-browser", "--listen", ":0")

    def look(self, address: str, seconds: float) -> None:
        connection, began = http.client.HTTPConnection(_host(address), timeout=10), time.monotonic()
        with dxlrun.connect() as client:
            joint = client.states().joints[0]
        curves = [f"{joint}/{kind}" for kind in ("position", "goal_position", "velocity", "effort")]
        for number in range(round(seconds / PERIOD_S)):
            now = self._asked(connection, address, shown=number % 12 == 0)
            self._asked(connection, address, spans=[{"names": curves, "begin": now - 10.0, "end": now}])
            time.sleep(max(0.0, began + (number + 1) * PERIOD_S - time.monotonic()))
        connection.close()

    def die(self, address: str) -> None:
        connection = http.client.HTTPConnection(_host(address), timeout=10)
        self._asked(connection, address, shown=True)
        connection.putrequest("POST", "/look")
        connection.close()  # in the middle of a question

    def _asked(self, connection: http.client.HTTPConnection, address: str, **asked: object) -> float:
        """Ask for what is drawn; return the time of the newest cycle, s."""
        token = re.findall(r"token=(\S+)", address)[0]
        headers = {"X-Dxlrun-Token": token, "Content-Type": "application/json"}
        connection.request("POST", "/look", json.dumps(asked), headers)
        answer = connection.getresponse()
        found = json.loads(answer.read())
        assert answer.status == 200, found
        return float(found["moment"]["time"])


class Foxglove:
    """`dxlrun foxglove` and a viewer, which has subscribed to all channels."""

    command = (DXLRUN, "foxglove", "--listen", ":0")

    def look(self, address: str, seconds: float) -> None:
        end = time.monotonic() + seconds
        with self._connected(address) as viewer:
            while time.monotonic() < end:
                self._take(viewer)

    def die(self, address: str) -> None:
        with self._connected(address) as viewer:
            while self._take(viewer):
                pass
            viewer.socket.shutdown(socket.SHUT_RDWR)

    def _connected(self, address: str) -> ClientConnection:
        url = re.findall(r"ws://\S+", address)[0]
        protocols = [Subprotocol("foxglove.websocket.v1")]
        return connect(url, subprotocols=protocols, compression=None, close_timeout=0.1, logger=SILENT)

    def _take(self, viewer: ClientConnection) -> bool:
        """Take a frame, and subscribe to new channels; return whether it was no message."""
        frame = viewer.recv(10.0)
        if isinstance(frame, bytes):
            return False
        words = json.loads(frame)
        if words["op"] == "advertise" and words["channels"]:
            rows = [{"id": one["id"], "channelId": one["id"]} for one in words["channels"]]
            viewer.send(json.dumps({"op": "subscribe", "subscriptions": rows}))
        return True


class Ros2:
    """`dxlrun-ros2` and a ROS program that hears the joint states by a reliable subscription."""

    command = (Path(started.PYTHON).with_name("dxlrun-ros2"),) if started.PYTHON else ()

    def look(self, address: str, seconds: float) -> None:
        end = time.monotonic() + seconds
        listener = self._hearing()
        time.sleep(max(0.0, end - time.monotonic()))
        listener.end()

    def die(self, address: str) -> None:
        self._hearing().end(signal.SIGKILL)

    def _hearing(self) -> started.Foreign:
        listener = started.Foreign("listener", os.environ)
        listener.do("hear", "states", "/joint_states", "sensor_msgs/msg/JointState")
        listener.do("heard", "states")
        return listener


SILENT = logging.Logger("clients", logging.CRITICAL)
BESIDE: Mapping[str, Beside] = {"view": View(), "foxglove": Foxglove(), "ros2": Ros2()}


def _host(address: str) -> str:
    return re.findall(r"http://([^/]+)/", address)[0]


def memory(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    """Run robot and page, and print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("beside", choices=BESIDE)
    parser.add_argument("--robot", type=Path, default=ROBOT)
    parser.add_argument("--blocks", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    words = parser.parse_args()
    if not BESIDE[words.beside].command:
        parser.error("DXLRUN_ROS2_PYTHON names no Python that has rclpy and dxlrun_ros2")
    duration = 2 * (2 * words.blocks + 1) * words.seconds + 120
    with tempfile.TemporaryDirectory() as folder:
        environment = started.environment(Path(folder))
        os.environ.clear()
        os.environ.update(environment)
        ran = [DXLRUN, words.robot.resolve(), "--duration", str(duration)]
        with subprocess.Popen(ran, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as robot:
            while not dxlrun.running():
                time.sleep(0.05)
            time.sleep(3.0)
            beside = BESIDE[words.beside]
            with subprocess.Popen(beside.command, cwd=folder, stdout=subprocess.PIPE, text=True) as view:
                assert view.stdout is not None
                address = view.stdout.readline()
                with dxlrun.connect() as client:
                    log = Path(str(client.info()["log"]))
                    cycles = [client.states().cycle]
                    for block in range(2 * words.blocks + 1):
                        if block % 2:
                            beside.look(address, words.seconds)
                        else:
                            time.sleep(words.seconds)
                        cycles.append(client.states().cycle)
                        show(f"block {block + 1} of {2 * words.blocks + 1}")
                    memories = [memory(view.pid)]
                    for number in range(RECONNECTIONS):
                        beside.die(address)
                        if number in {9, RECONNECTIONS - 1}:
                            memories.append(memory(view.pid))
                    files = len(os.listdir(f"/proc/{view.pid}/fd"))
                    client.stop()
                view.terminate()
            robot.wait()
        found = read_log(Path(folder, log)).cycles
    report(found, cycles)
    show(
        f"memory of {words.beside}: {memories[0]:.1f} MB, after 10 dead clients {memories[1]:.1f}, "
        f"after {RECONNECTIONS} {memories[2]:.1f}; {files} open files"
    )


def report(cycles: np.ndarray, bounds: list[int]) -> None:
    """Print the ratios of each block with a client to those beside it."""
    rate = len(cycles) / (cycles["woken_ns"][-1] - cycles["woken_ns"][0]) * 1e9
    late, own = [], []
    for begin, end in pairwise(bounds):
        rows = cycles[(cycles["cycle"] >= begin + SETTLING_S * rate) & (cycles["cycle"] < end)]
        late.append(np.median(rows["woken_ns"] - rows["scheduled_ns"]))
        own.append(np.median(rows["written_ns"] - rows["woken_ns"]))
    for what, medians in (("wake-up", np.array(late)), ("cycle", np.array(own))):
        closed = np.sqrt(medians[:-2:2] * medians[2::2])  # of the two blocks beside each
        ratios = np.log(medians[1::2] / closed)
        half = student.ppf(0.975, len(ratios) - 1) * ratios.std(ddof=1) / np.sqrt(len(ratios))
        low, middle, high = np.exp([ratios.mean() - half, ratios.mean(), ratios.mean() + half])
        show(
            f"{what}: median {np.median(closed) / 1e3:.2f} us without a client, {middle:.3f} of it with one "
            f"(95 %: {low:.3f} to {high:.3f}, {len(ratios)} blocks)"
        )


def show(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
