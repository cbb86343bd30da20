"""View: what the loop of a robot notices of the page, and what the page's process keeps of browsers that die.

A robot runs in real time with its log, and `dxlrun view` beside it all the time. In every other block a
browser looks as the page does, 25 times a second with four curves; in the blocks between it sleeps. Each
block with a browser gives a ratio to the two beside it, of medians: of how late the loop woke up, and of
the time from there until goals were sent. The interval is Student's, over the ratios' logarithms. Then
browsers connect, look, and die one after the other.

    python tests/bench/view_loop.py [--robot robots/humanoid_20.yaml] [--blocks 20] [--seconds 20]
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.stats import t as student

import dxlrun
from dxlrun.log.reader import read_log

ROBOT = Path(__file__).parents[2] / "robots" / "humanoid_20.yaml"
PERIOD_S = 0.04
RECONNECTIONS = 50
SETTLING_S = 0.5
"""At the begin of a block, which does not count."""


class Browser:
    """A browser that looks as the page does."""

    def __init__(self, address: str) -> None:
        self._host, self._token = re.findall(r"http://([^/]+)/\?token=(\S+)", address)[0]
        self._connection = http.client.HTTPConnection(self._host, timeout=10)

    def look(self, **asked: object) -> float:
        """Ask for what is drawn; return the time of the newest cycle, s."""
        headers = {"X-Dxlrun-Token": self._token, "Content-Type": "application/json"}
        self._connection.request("POST", "/look", json.dumps(asked), headers)
        answer = self._connection.getresponse()
        found = json.loads(answer.read())
        assert answer.status == 200, found
        return float(found["moment"]["time"])

    def die(self) -> None:
        """Close the connection in the middle of a question."""
        self._connection.putrequest("POST", "/look")
        self._connection.close()


def looks(browser: Browser, curves: list[str], seconds: float) -> None:
    """Look at the robot for a time."""
    began = time.monotonic()
    for number in range(round(seconds / PERIOD_S)):
        now = browser.look(shown=number % 12 == 0)
        browser.look(spans=[{"names": curves, "begin": now - 10.0, "end": now}])
        time.sleep(max(0.0, began + (number + 1) * PERIOD_S - time.monotonic()))


def memory(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    """Run robot and page, and print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--robot", type=Path, default=ROBOT)
    parser.add_argument("--blocks", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    words = parser.parse_args()
    program = Path(sys.executable).with_name("dxlrun")
    duration = (2 * words.blocks + 1) * words.seconds + 120
    with tempfile.TemporaryDirectory() as folder:
        ran = [program, words.robot.resolve(), "--duration", str(duration)]
        with subprocess.Popen(ran, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as robot:
            while not dxlrun.running():
                time.sleep(0.05)
            time.sleep(3.0)
            shown = [program, "view", "--no-browser", "--port", "0"]
            with subprocess.Popen(shown, cwd=folder, stdout=subprocess.PIPE, text=True) as view:
                assert view.stdout is not None
                address = view.stdout.readline()
                with dxlrun.connect() as client:
                    log = Path(str(client.info()["log"]))
                    cycles = [client.states().cycle]
                    for block in range(2 * words.blocks + 1):
                        if block % 2:
                            joint = client.states().joints[0]
                            kinds = ("position", "goal_position", "velocity", "effort")
                            looks(Browser(address), [f"{joint}/{kind}" for kind in kinds], words.seconds)
                        else:
                            time.sleep(words.seconds)
                        cycles.append(client.states().cycle)
                        show(f"block {block + 1} of {2 * words.blocks + 1}")
                    memories = [memory(view.pid)]
                    for number in range(RECONNECTIONS):
                        browser = Browser(address)
                        browser.look(shown=True)
                        browser.die()
                        if number in {9, RECONNECTIONS - 1}:
                            memories.append(memory(view.pid))
                    files = len(os.listdir(f"/proc/{view.pid}/fd"))
                    client.stop()
                view.terminate()
            robot.wait()
        found = read_log(Path(folder, log)).cycles
    report(found, cycles)
    show(
        f"memory of the page's process: {memories[0]:.1f} MB, after 10 browsers {memories[1]:.1f}, "
        f"after {RECONNECTIONS} {memories[2]:.1f}; {files} open files"
    )


def report(cycles: np.ndarray, bounds: list[int]) -> None:
    """Print the ratios of each block with the page to those beside it."""
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
            f"{what}: median {np.median(closed) / 1e3:.2f} us without a browser, {middle:.3f} of it with one "
            f"(95 %: {low:.3f} to {high:.3f}, {len(ratios)} blocks)"
        )


def show(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
