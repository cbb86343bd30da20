"""A recorded bus: a host that does the same hears the same; another one reads registers that are known."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dynamixel_sdk import COMM_SUCCESS, PacketHandler
from msgspec.structs import replace
from tests.foreign.conftest import PatientPort
from tests.kit.campaigns import campaign
from tests.kit.line_faults import corrupt_next, truncate_next
from tests.kit.packets import packet1, packet2

from dxlrun.cli import main
from dxlrun.cli.sim import sim as sim_command
from dxlrun.errors import LogError
from dxlrun.log.columns import PacketColumns
from dxlrun.log.log_reader import Log, read_log
from dxlrun.log.recorded_packets import read_recorded_packets
from dxlrun.run import virtual_run
from dxlrun.run.simulation_front import SimulationResult
from dxlsim.bus.ledger import Ledger
from dxlsim.bus.recorded_bus import RecordedBus
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.messages import SimulationJob, SimulationMessage
from dxlsim.simulation_plan import BusConfig, SimulationConfig
from dxlwire.packets import PacketKind
from exchange.simulated import SimulatedServos

pytestmark = pytest.mark.long

ROBOT = """\
name: pair
arguments: {{port: {{default: sim, help: "serial port"}}}}
buses:
  main:
    {{port: "${{port}}", protocol: {protocol}, baud_rate: 1_000_000, return_delay_time: 100 us,
     adapter: {{latency: 1 ms}}}}
loop: {{rate: 50}}
joints:
  pan: {{bus: main, id: 1, model: {model}, reference: 150 deg, direction: 1}}
  tilt: {{bus: main, id: 2, model: {model}, reference: 150 deg, direction: 1}}
controllers:
  both: {{type: joint_trajectory_controller, joints: [pan, tilt]}}
recording: {{directory: {logs}}}
"""
MOTION = """\
name: swing
motions:
  - controller: both
    duration: 1 s
    samples: 20
    joints: {pan: {position: 0.4 * sin(4 * t)}, tilt: {position: 0.3 * sin(3 * t)}}
"""
ROBOTS = {"1.0": ("1.0", "AX-12A"), "1.0 bulk": ("1.0", "MX-64"), "2.0": ("2.0", "XL430-W250")}
LAPSES: dict[str, Callable[[SimulatedBus], None]] = {
    "": lambda bus: None,
    "corrupted": lambda bus: bus.after(60, lambda: corrupt_next(bus, 1)),
    "noise": lambda bus: bus.inject_noise(bytes(range(40)), 1_000_000_000),
    "together": lambda bus: bus.set_latency_timer(2_000_000),
    "silent": lambda bus: bus.after(80, lambda: truncate_next(bus, 2, 0)),
}
PAIRS = [("1.0", "silent"), ("1.0 bulk", "together"), ("2.0", "noise"), ("2.0", "corrupted")]
PAIRS += [(kind, lapse) for kind in ROBOTS for lapse in LAPSES if (kind, lapse) not in PAIRS]
"""A robot and a lapse of its line, which is recorded and replayed; those of CI come first."""
both = pytest.mark.parametrize("kind", ["1.0", "2.0"])


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Log]:
    """Run a robot on virtual time, on servos or on the bus of a log; return the log."""
    (tmp_path / "swing.yaml").write_text(MOTION)

    def run(kind: str, *, lapse: str = "", recorded: Path | None = None) -> Log:
        def bus(config: BusConfig, ledger: Ledger, start_ns: int, mechanics: Any) -> SimulatedBus:
            if recorded is None:
                made = SimulatedBus(config, ledger, start_ns, mechanics)
                LAPSES[lapse](made)
                return made
            config = replace(config, servos=(), recorded=str(recorded))
            packets = read_recorded_packets(recorded, config.name)
            return RecordedBus(config, ledger, start_ns, packets, mechanics)

        monkeypatch.setattr(virtual_run, "SimulatedBus", bus)
        protocol, model = ROBOTS[kind]
        logs, robot = tmp_path / ("again" if recorded else "logs"), tmp_path / "pair.yaml"
        robot.write_text(ROBOT.format(protocol=protocol, model=model, logs=logs))
        main([str(robot), "--virtual", "--play", str(tmp_path / "swing.yaml")])
        (path,) = logs.glob("*.mcap")
        return read_log(path)

    return run


def rows(packets: PacketColumns) -> list[tuple[str, int, bytes]]:
    return [(PacketKind(one.kind).name, one.last_ns, one.data) for one in packets]


def heard(log: Log) -> dict[bytes, list[bytes]]:
    """Return what was heard after each instruction, each time when anything was."""
    found: dict[bytes, list[bytes]] = {}
    asked = b""
    for packet in log.packets:
        if packet.kind == PacketKind.INSTRUCTION:
            asked = packet.data
            found.setdefault(asked, [])
        elif asked:
            found[asked].append(packet.data)
    return found


@campaign(ci=4, night=15, release=15)
def test_a_host_that_does_the_same_hears_the_same_at_the_same_times(run, number):
    """On virtual time to the nanosecond, from the first instruction of the set-up to the last of the end."""
    kind, lapse = PAIRS[number]
    print(kind, lapse)
    before = run(kind, lapse=lapse)
    after = run(kind, recorded=before.path)
    assert len(before.packets) > 300
    if lapse in ("noise", "corrupted"):
        noise = int((before.packets.kind == PacketKind.NOISE).sum())
        assert noise or any("lost" in event.text or "reply" in event.text for event in before.events)
    assert rows(after.packets) == rows(before.packets)
    assert np.array_equal(after.cycles["position"], before.cycles["position"], equal_nan=True)


class Host:
    """A host that writes an instruction and takes what comes within 20 ms."""

    def __init__(self, log: Path, protocol: float, baud_rate: int = 1_000_000) -> None:
        self.ledger = Ledger()
        config = BusConfig("main", 1_000_000, (), protocol, recorded=str(log))
        self.bus = RecordedBus(config, self.ledger, 0, read_recorded_packets(log, "main"))
        self.bus.baud_rate = baud_rate
        self._now_ns = 0

    def ask(self, instruction: bytes) -> bytes:
        self._now_ns += 20_000_000
        self.bus.receive_bytes(instruction, self._now_ns)
        return self.bus.drain_bytes(self._now_ns + 20_000_000)

    @property
    def notes(self) -> list[str]:
        return [entry.note for entry in self.ledger.entries if entry.direction == "note"]


def test_another_host_gets_what_was_recorded_and_nothing_is_made_up(run):
    log = run("1.0")
    ((instruction, replies),) = [
        (asked, found) for asked, found in heard(log).items() if asked[2] == 1 and asked[4:6] == b"\x02\x24"
    ]
    assert len(set(replies)) > 20
    host = Host(log.path, 1.0)
    assert [host.ask(instruction) for _ in replies] == replies
    assert [host.ask(instruction) for _ in range(3)] == replies[-1:] * 3, "behind the end the last again"
    host = Host(log.path, 1.0)
    assert host.ask(packet1(1, 2, 0, 2)) == packet1(1, 0, 12, 0)  # the model number of an AX-12A
    assert host.ask(packet1(1, 1)) == packet1(1, 0)  # a ping
    assert not host.notes
    assert host.ask(packet1(9, 1)) == b""  # a servo that was not there
    assert host.ask(packet1(1, 2, 50, 2)) == b""  # registers that nothing read
    assert host.ask(packet1(1, 3, 25, 1)) == b""  # the LED, which nothing wrote
    assert [note.split(":")[0] for note in host.notes] == ["instruction not in the recording"] * 3
    assert host.ask(packet1(0xFE, 3, 25, 1)) == b""  # nothing was to answer
    assert len(host.notes) == 3
    assert Host(log.path, 1.0, baud_rate=57600).ask(packet1(1, 1)) == b""
    with pytest.raises(LogError, match="the log has no bus left"):
        read_recorded_packets(log.path, "left")


def test_what_is_put_together_follows_what_was_heard_last(run):
    """Single positions of Protocol 2.0, of which the recording has only group reads."""
    log = run("2.0")
    host = Host(log.path, 2.0)
    cycle = [
        asked for asked, found in heard(log).items() if asked[7] in (0x82, 0x8A, 0x92) and len(found) > 20
    ]
    present, found = packet2(2, 2, bytes((132, 0, 4, 0))), []
    for _ in range(30):
        for instruction in cycle:
            host.ask(instruction)
        found.append(host.ask(present))
    if any(one[7] == 0x82 for one in cycle):
        ticks = [int.from_bytes(one[9:13], "little") for one in found]
        assert len(set(ticks)) > 5
        assert max(np.abs(np.diff(ticks))) < 200


@both
def test_the_makers_sdk_reads_registers_of_a_recorded_bus(run, kind, tmp_path):
    """In real time, on a terminal."""
    protocol, model = float(kind), {"1.0": 12, "2.0": 1060}[kind]
    bus = BusConfig("main", 1_000_000, (), protocol, recorded=str(run(kind).path))
    with SimulatedServos((bus,), -1, tmp_path / "ledger.jsonl") as served:
        port, packets = PatientPort(served.ports[0]), PacketHandler(protocol)
        assert port.setBaudRate(1_000_000)
        assert packets.ping(port, 1) == (model, COMM_SUCCESS, 0)
        assert packets.read2ByteTxRx(port, 2, 0) == (model, COMM_SUCCESS, 0)
        port.closePort()


@campaign(ci=0, night=1, release=1)
@both
def test_a_run_on_a_terminal_sends_and_receives_what_was_recorded(run, kind, tmp_path):
    """In real time: the set-up byte for byte."""
    log = run(kind)
    bus = BusConfig("main", 1_000_000, (), float(kind), recorded=str(log.path))
    with SimulatedServos((bus,), -1, tmp_path / "ledger.jsonl") as served:
        # good or not: a machine that is busy may be late
        main([str(tmp_path / "pair.yaml"), f"port:={served.ports[0]}", "--duration", "0.5"])
    (path,) = set((tmp_path / "logs").glob("*.mcap")) - {log.path}
    again, before = heard(read_log(path)), heard(log)
    first_ns, sent = log.cycles["woken_ns"][0], PacketKind.INSTRUCTION
    assert {one.data for one in log.packets if one.first_ns < first_ns and one.kind == sent} <= set(again)
    for instruction, replies in again.items():
        recorded = before.get(instruction, [])
        # the run waits for joints to stand, which are those of a recording: then the last reply is repeated
        known = iter([*recorded, *recorded[-1:] * len(replies)])
        # replies that came too late for the host are missing, nothing else
        assert all(reply in known for reply in replies), instruction
    assert max(map(len, again.values())) > 10


# The command


def test_the_command_serves_the_buses_of_the_log(run, monkeypatch, capsys):
    served: list[SimulationConfig] = []

    def serve(job: SimulationJob, *_: object, **__: object) -> SimulationResult:
        served.append(job.config)
        return SimulationResult(1.0, SimulationMessage(), ())

    monkeypatch.setattr(sim_command, "_serve", serve)
    log = run("2.0")
    assert main(["sim", "--recorded", str(log.path)]) == 0
    assert served[0].buses == (BusConfig("main", 1_000_000, (), 2.0, recorded=str(log.path)),)
    said = capsys.readouterr().out
    assert "pair, recorded: ended after 1.0 s. Instructions were answered as recorded" in said


@pytest.mark.parametrize("content", [b"", b"no log", None])
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["robot.yaml"], "--recorded and a robot file exclude each other; omit one of them"),
        (["--servo", "AX-12A:1", "--baud", "57600"], "--recorded and --servo and --baud exclude each other"),
        ([], "wrong.mcap"),
    ],
)
def test_wrong_words_and_logs_are_refused(tmp_path, capsys, words, said, content):
    path = tmp_path / "wrong.mcap"
    if content is not None:
        path.write_bytes(content)
    assert main(["sim", "--recorded", str(path), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert ("the file is empty" in line) == (content == b"" and not words)
