"""How soon the guardian acts: kills or stops the loop of a simulated torso again and again, and measures.

    python bench/guardian.py [--runs 10] [--signal KILL|STOP]

Judged by the simulated bus' ledger: the time from the loop's last byte to the first byte of the broadcast
torque-off. The bound is 100 ms after the end of a loop, 5 periods + 100 ms (200 ms at 50 Hz) when it hangs.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from dxlsim.bus.ledger import read_ledger

DXLRUN = Path(sys.executable).with_name("dxlrun")
TORSO = Path(__file__).parents[1] / "robots/bioloid_torso.yaml"
LIMP = bytes.fromhex("fffffe04031800")  # broadcast: write 0 to torque enable (24)


def loop_of(directory: Path) -> int:
    """Return the process ID of the loop whose log lies in `directory`, once it has sent goals."""
    for _ in range(3000):
        time.sleep(0.01)
        paths = list(directory.glob("*.ledger.jsonl"))
        if not paths or not any(entry.data[4:5] == b"\x83" for entry in read_ledger(paths[0])):
            continue
        for path in Path("/proc").glob("[0-9]*"):
            try:
                ours = os.readlink(path / "cwd") == str(directory)  # others may run robots of theirs
                if ours and b"dxlrun.run.loop_process" in (path / "cmdline").read_bytes():
                    return int(path.name)
            except OSError:
                continue
    raise SystemExit("the loop never sent a goal")


def measure(number: signal.Signals, chance: random.Random) -> float:
    """Return milliseconds from the loop's last byte to the guardian's first."""
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name).resolve()
        run = subprocess.Popen(
            [DXLRUN, TORSO, "--ledger", "seen.ledger.jsonl"],
            cwd=directory,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        loop = loop_of(directory)
        time.sleep(chance.uniform(0.0, 0.1))
        os.kill(loop, number)
        if run.wait(30) != 1:
            raise SystemExit(f"exit code {run.returncode} instead of 1")
        ledger = read_ledger(next(directory.glob("*.ledger.jsonl")))
        sent = [entry for entry in ledger if entry.direction == "in"]
        first = next(index for index, entry in enumerate(sent) if entry.data.startswith(LIMP))
        if any(entry.data[4:5] == b"\x83" for entry in sent[first:]):
            raise SystemExit("a goal was sent after torque off")
        return (sent[first].t_ns - sent[first - 1].t_ns) / 1e6


def main() -> None:
    """Print median and maximum."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--signal", choices=("KILL", "STOP"), default="KILL")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    chance = random.Random(options.seed)
    number = signal.Signals[f"SIG{options.signal}"]
    results = [measure(number, chance) for _ in range(options.runs)]
    print(
        f"{number.name}, {options.runs} runs: guardian's first byte after the loop's last: "
        f"median {statistics.median(results):.1f} ms, maximum {max(results):.1f} ms"
    )


if __name__ == "__main__":
    main()
