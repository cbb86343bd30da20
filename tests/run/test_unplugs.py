"""Campaign: the adapter of one of two buses is pulled and comes back under another name, again and again.

Everything is real but the servos: processes, pseudo-terminals, a link to each as udev makes it, time. Judged
by the simulated buses' ledger: the other bus goes on, one that is back is read again, the log has all bytes,
and all servos end limp: by the loop, by the guardian when the loop is killed, or by the terminal's process
when both are.
"""

import os
import random
import re
import signal
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.campaigns import campaign
from tests.kit.live_run import DXLRUN, Running, Start

from dxlrun.channels.event_records import EventCode
from dxlsim.bus.ledger import LedgerEntry, read_ledger
from dxlwire.packets import PacketKind

MOST_PULLS = 10
"""Of one run."""
ENDS = {"loop": ("loop_process",), "both": ("guardian", "loop_process"), "none": ()}
"""What is killed at the end; without a loop and a guardian the terminal's process has the last hand."""
ROBOT = """\
name: pulled
arguments:
  left: {default: sim, help: "port of the left bus"}
  right: {default: sim, help: "port of the right bus"}
buses:
  left: {port: "${left}", protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 100 us}
  right: {port: "${right}", protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 100 us}
loop: {rate: 10}
joints:
  pan: {bus: left, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tilt: {bus: left, id: 7, model: AX-12A, reference: 150 deg, direction: -1}
  yaw: {bus: right, id: 11, model: XM430-W350, reference: 180 deg, direction: 1}
  nod: {bus: right, id: 12, model: XM430-W350, reference: 180 deg, direction: -1}
controllers:
  hold: {type: joint_group_position_controller, joints: [pan, tilt, yaw, nod]}
"""
NAMES = ("left", "right")
IDS = {"left": (3, 7), "right": (11, 12)}
LONG_NS = 600_000_000
ON_THE_WAY = 4
"""Packets that a host sends before it sees that its adapter is gone: in one exchange, at most."""
MARK = {"left": b"\xff\xff", "right": b"\xff\xff\xfd\x00"}


def draw_pulls(chance: random.Random, count: int) -> list[tuple[str, int, int]]:
    """Return pulls of an adapter: of which bus, after how long and for how long, ms."""
    return [(chance.choice(NAMES), chance.randint(0, 400), chance.randint(1, 900)) for _ in range(count)]


@dataclass
class Servos:
    """Simulated servos behind links, in a process of their own."""

    process: subprocess.Popen[str]
    ledger: Path
    links: dict[str, Path]

    def fault(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{text}\n")
        self.process.stdin.flush()

    def end(self) -> None:
        """End the process; the ledger is whole then."""
        self.process.terminate()
        self.process.communicate(timeout=DEADLINE_S)

    def entries(self) -> tuple[LedgerEntry, ...]:
        return read_ledger(self.ledger) if self.ledger.exists() else ()

    def of(self, bus: str, direction: str) -> list[LedgerEntry]:
        return [entry for entry in self.entries() if (entry.bus, entry.direction) == (bus, direction)]

    def plugged_in(self, bus: str) -> int:
        return sum(entry.note == "adapter plugged in" for entry in self.of(bus, "note"))

    def heard_since_return(self, bus: str) -> bool:
        """Say whether every servo of a bus has answered since its adapter came back."""
        entries = [entry for entry in self.entries() if entry.bus == bus]
        back = max(index for index, entry in enumerate(entries) if entry.note == "adapter plugged in")
        said = b"".join(entry.data for entry in entries[back:] if entry.direction == "out")
        return all(MARK[bus] + bytes((servo_id,)) in said for servo_id in IDS[bus])


@pytest.fixture
def servos(tmp_path):
    (tmp_path / "pulled.yaml").write_text(ROBOT)
    ledger, link = tmp_path / "servos.jsonl", tmp_path / "tty"
    command = [str(DXLRUN), "sim", "pulled.yaml", "--link", str(link), "--ledger", str(ledger), "--json"]
    process = subprocess.Popen(
        command, cwd=tmp_path, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert result_of(process.stdout.readline())
    yield Servos(process, ledger, {name: Path(f"{link}.{name}") for name in NAMES})
    process.kill()
    process.communicate()


@campaign(ci=1, night=3, release=10)
def test_an_adapter_that_is_pulled_costs_the_other_bus_nothing_and_comes_back(
    start: Start,
    servos: Servos,
    tmp_path: Path,
    *,
    number: int,
    amount: float,
    chance: random.Random,
) -> None:
    drawn = draw_pulls(chance, min(2 * int(amount), MOST_PULLS))
    killed = tuple(ENDS)[number % len(ENDS)]
    print(f"at the end, {killed} killed")
    run = start(*(f"{bus}:={link}" for bus, link in servos.links.items()), robot=tmp_path / "pulled.yaml")
    for name in NAMES:
        until(lambda name=name: len(servos.of(name, "in")) > 60, f"cycles on {name}")
    for bus, pause_ms, gone_ms in drawn:
        pull(servos, bus, pause_ms, gone_ms)
    for name in NAMES:
        count = len(servos.of(name, "in"))
        until(lambda name=name, count=count: len(servos.of(name, "in")) > count + 20, f"more on {name}")
    pids = [run.child(f"dxlrun.run.{victim}") for victim in ENDS[killed]]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)  # neither sees the other one die
    for pid in reversed(pids):
        os.kill(pid, signal.SIGKILL)
    if not pids:
        run.process.terminate()
    code, out, err = run.finish()
    assert "Traceback" not in err
    assert code == 1, err  # a run that lost a bus is no good one, however it ends
    if not pids:  # what a loop counted that is killed is lost; its log is not
        (lost,) = re.findall(r"failed: ([\w, ]+) (?:was|were) lost at", out)
        assert set(lost.split(", ")) == {bus for bus, *_ in drawn}, out
    if pids:
        assert "torque off was confirmed by all 4 servos" in err
    else:
        assert "torque" not in err  # nothing but the loop had to switch it off
    servos.end()
    the_other_bus_goes_on(servos)
    everybody_is_limp(servos)
    the_log_tells_each_loss_and_return(run, drawn)
    if not pids:  # a loop that is killed takes a packet along
        the_log_is_the_wire(run, servos, drawn)


def pull(servos: Servos, bus: str, pause_ms: int, gone_ms: int) -> None:
    """Let the other bus do some cycles, pull the adapter, wait until all its servos have answered again."""
    print(f"unplug bus={bus} for={gone_ms}ms, {pause_ms} ms after the one before was over")
    (other,) = (name for name in NAMES if name != bus)
    before, packets = servos.plugged_in(bus), len(servos.of(other, "in"))
    until(lambda: len(servos.of(other, "in")) >= packets + pause_ms // 50, "the moment")
    servos.fault(f"unplug bus={bus} for={gone_ms}ms")
    until(lambda: servos.plugged_in(bus) > before, f"the adapter of {bus}")
    until(lambda: servos.heard_since_return(bus), f"the servos of {bus}")


def the_other_bus_goes_on(servos: Servos) -> None:
    """Judge by what it heard while an adapter was away for so long that a loop that waits would be killed."""
    for entry in (entry for name in NAMES for entry in servos.of(name, "note")):
        if entry.note != "adapter unplugged":
            continue
        (other,) = (name for name in NAMES if name != entry.bus)
        back = (one.t_ns for one in servos.of(entry.bus, "note") if one.note == "adapter plugged in")
        back_ns = next(t_ns for t_ns in back if t_ns > entry.t_ns)
        heard = [one for one in servos.of(other, "in") if entry.t_ns < one.t_ns < back_ns]
        assert heard or back_ns - entry.t_ns < LONG_NS


def everybody_is_limp(servos: Servos) -> None:
    """Judge by the last answer of each servo to a read of its torque enable: 0."""
    for bus, ids in IDS.items():
        said = b"".join(entry.data for entry in servos.of(bus, "out"))
        for servo_id in ids:
            last = said.rindex(MARK[bus] + bytes((servo_id,)))
            status = said[last:]
            value = status[5] if bus == "left" else status[9]
            assert value == 0, (bus, servo_id, status[:12].hex(" "))


def the_log_tells_each_loss_and_return(run: Running, drawn: list[tuple[str, int, int]]) -> None:
    events = run.log().events
    for name in NAMES:
        times = sum(bus == name for bus, *_ in drawn)
        for code in (EventCode.PORT_LOST, EventCode.PORT_BACK):
            found = [event.text for event in events if (event.code, event.source) == (code, name)]
            assert len(found) == times, (name, code.name, found)


def the_log_is_the_wire(run: Running, servos: Servos, drawn: list[tuple[str, int, int]]) -> None:
    """Compare all bytes, but those that were on their way when an adapter went."""
    log = run.log()
    for index, name in enumerate(NAMES):
        pulled = sum(bus == name for bus, *_ in drawn)
        packets = [packet for packet in log.packets if packet.bus == index]
        said = [packet.data for packet in packets if packet.kind == PacketKind.INSTRUCTION]
        lost = missing(said, b"".join(entry.data for entry in servos.of(name, "in")))
        assert len(lost) <= pulled * ON_THE_WAY, [each.hex(" ") for each in lost]
        told = b"".join(entry.data for entry in servos.of(name, "out"))
        heard = [packet.data for packet in packets if packet.kind != PacketKind.INSTRUCTION]
        at = 0
        for each in heard:  # in order; what came while the line was closed is between
            at = told.index(each, at) + len(each)


def missing(said: list[bytes], wire: bytes) -> list[bytes]:
    """Return the packets that did not come to the wire; what did come was said, all of it and in order."""
    lost, at = [], 0
    for packet in said:
        if wire.startswith(packet, at):
            at += len(packet)
        else:
            lost.append(packet)
    assert at == len(wire)
    return lost
