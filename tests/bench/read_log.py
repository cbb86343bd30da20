"""What reading a long log costs: processor time and the most memory, of slices alone and of `dxlrun analyze`.

    python tests/bench/read_log.py make SOURCE LOG CYCLES
    python tests/bench/read_log.py measure LOG...

`make` repeats the run in SOURCE, for example 20 s of `dxlrun robots/humanoid_20.yaml`, as often as needed:
its cycles and packets with times and numbers that go on, through the recorder's LogWriter. `measure` reads
each log in a process of its own; the sum over its threads counts.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from dxlrun.channels.packets import PacketBatch
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.reader import open_log, read_log

SLICES = """
import sys
from dxlrun.log.reader import open_log
cycles = packets = 0
for part in open_log(sys.argv[1]).slices():
    cycles += len(part.cycles)
    packets += len(part.packets)
print(f"{cycles} cycles, {packets} packets", end=", ")
"""
ANALYZE = """
import sys
from dxlrun.cli import main
main(["analyze", "--json", sys.argv[1]])
"""
TIMES = ("scheduled_ns", "woken_ns", "read_ns", "updated_ns", "written_ns")


def make(source: Path, log: Path, cycles: int) -> None:
    """Write a long log."""
    whole = read_log(source)
    header = replace(whole.header, attachments=whole.attachments, metadata=whole.metadata)
    header.metadata.pop("dxlrun", None)
    writer = LogWriter(log, header)
    batch = PacketBatch(Handover(writer.take))
    first, last = whole.cycles[0], whole.cycles[-1]
    count = int(last["cycle"]) - int(first["cycle"]) + 1
    length_ns = count * header.period_ns
    packets = [*zip(whole.packets.cycle.tolist(), whole.packets, strict=True)]
    packets.sort(key=lambda pair: pair[0])  # of all buses
    numbers = [number for number, _ in packets]
    begins = np.searchsorted(numbers, whole.cycles["cycle"], side="left").tolist()
    ends = np.searchsorted(numbers, whole.cycles["cycle"], side="right").tolist()
    if whole.activation is not None:
        writer.take(RecordKind.CYCLE, whole.activation.tobytes())
    done = turn = 0
    while done < cycles:
        rows = whole.cycles[: cycles - done].copy()
        rows["cycle"] += turn * count
        for name in TIMES:
            rows[name] += turn * length_ns
        raw = rows.view(np.dtype((np.void, rows.dtype.itemsize)))
        for row, begin, end in zip(range(len(rows)), begins, ends, strict=False):
            batch.wake(int(rows["cycle"][row]))
            for _, packet in packets[begin:end]:
                first_ns, last_ns = packet.first_ns + turn * length_ns, packet.last_ns + turn * length_ns
                batch.packet(packet.bus, packet.kind, packet.servo_id, first_ns, last_ns, packet.data)
            batch.commit()
            writer.take(RecordKind.CYCLE, raw[row].tobytes())
        done += len(rows)
        turn += 1
    writer.close()


def measure(log: Path) -> None:
    """Print what reading it costs."""
    messages = sum(topic.count or 0 for topic in open_log(log).topics.values())
    print(f"{log.name}: {log.stat().st_size >> 20} MB, {messages} messages")
    for name, program in (("slices", SLICES), ("analyze", ANALYZE)):
        child = subprocess.Popen([sys.executable, "-c", program, str(log)], stdout=subprocess.PIPE)
        assert child.stdout is not None
        text = child.stdout.read().decode() if name == "slices" else child.stdout.read() and ""
        _, _, used = os.wait4(child.pid, 0)
        seconds = used.ru_utime + used.ru_stime
        rate = f", {messages / seconds / 1000:.0f} thousand messages a second" if name == "slices" else ""
        print(f"  {name}: {text}{seconds:.1f} s of processor time{rate}, {used.ru_maxrss >> 10} MB")


def main(words: list[str]) -> None:
    """Make a log, or measure some."""
    match words:
        case ["make", source, log, cycles]:
            make(Path(source), Path(log), int(cycles.replace("_", "")))
        case ["measure", *logs] if logs:
            for log in logs:
                measure(Path(log))
        case _:
            sys.exit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
