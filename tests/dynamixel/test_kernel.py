"""The compiled kernel does what the parser does, whatever arrives; and what it promises by itself."""

import importlib.util
import math
import os
import shutil
import sys
import time
import tty
from pathlib import Path
from threading import Thread
from types import ModuleType

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.kit.rigs import make_plan, make_rig, start_rig

import fuzz_kernel as fuzz
from dxlrun.channels.cycle import Commands, States
from dxlrun.channels.packets import PacketKind
from dxlrun.clock import MonotonicClock
from dxlrun.dynamixel.exchange import kernel
from dxlrun.dynamixel.exchange.bus import FREE_NS
from dxlrun.dynamixel.exchange.cyclic_reads import CALM_CYCLES
from dxlrun.dynamixel.hardware import DynamixelHardware
from dxlrun.dynamixel.port.ports import SerialPort, SerialPorts
from dxlrun.dynamixel.wire import protocol2
from dxlrun.testing import simulated_robot

ROBOTS = Path(__file__).parents[2] / "robots"
pytestmark = pytest.mark.skipif(kernel.load() is None, reason="no C compiler: the kernel was not built")


@pytest.mark.parametrize("name", ["single reads", "bulk read", "sync read", "fast sync read", "two layouts"])
def test_kernel_and_parser_agree_on_whatever_lines_say(name):
    tally = fuzz.campaign(1_000, seed=len(name), names=[name])
    # neither side of the comparison is empty
    assert tally.by_kernel > 50
    assert tally.interrupted > 20


@pytest.mark.parametrize("name", ["bulk read with devices", "fast bulk read with devices"])
def test_kernel_and_parser_agree_on_devices(name):
    tally = fuzz.campaign(500, seed=len(name), names=[name])
    assert tally.by_kernel > 20
    assert tally.interrupted > 10


STEADY = b"\0\2" + bytes(8)


def steady(side, dialect, second=STEADY):
    """Run a cycle in which everything says the same again, and the second device of a line these bytes."""

    def said(one):
        return dialect.status_packet(
            one.servo_id, 0, (second if one.servo_id == 101 else STEADY)[: one.length]
        )

    given = [
        [
            (
                read.packet,
                [(1_500_000 + 500_000 * place, said(one)) for place, one in enumerate(read.awaited)],
            )
            for read in line
        ]
        for line in side.prepare()
    ]
    side.cycle(given, np.full_like(side.goals.values, np.nan))


@pytest.mark.parametrize("compiled", [True, False], ids=["kernel", "parser"])
def test_a_device_is_not_valid_where_any_part_of_it_is_no_number(compiled):
    plans, dialect = fuzz.robot("bulk read with devices", 1)
    side = fuzz.Side(plans, kernel.load() if compiled else None)
    for _ in range(8):
        steady(side, dialect)
    assert side.sources.valid.tolist() == [True] * 3
    assert (side.ended > 0) == compiled
    steady(side, dialect, b"\xff" * 10)  # the float is in its second part
    assert side.sources.valid.tolist() == [True, False, True]


def test_the_replies_of_two_lines_have_room_in_the_log_beside_one_another():
    plans, dialect = fuzz.robot("sync read", 2)
    memory, size = bytearray(4096), 2048
    side = fuzz.Side(plans, kernel.load(), memoryview(memory)[:size])
    for earlier in range(1000, 2000, 10):  # bytes of the period before that are not committed
        side.packets.packet(0, PacketKind.NOISE, 0, 0, 0, bytes(earlier))
        steady(side, dialect)
        assert not any(memory[size:]), f"behind {earlier} bytes"
    assert side.ended > 90


@pytest.mark.campaign
def test_kernel_and_parser_agree_on_many_streams():
    fuzz.campaign(int(os.environ.get("DXLRUN_STREAMS", "1500")), seed=int(os.environ.get("DXLRUN_SEED", "1")))


@pytest.mark.parametrize("name", ["bioloid_torso", "humanoid_20"])
def test_a_run_is_the_same_with_and_without_the_kernel(monkeypatch, name):
    def packets():
        robot = simulated_robot(ROBOTS / f"{name}.yaml", duration_s=0.4)
        robot.run()
        states = robot.record.states
        return [entry.data for entry in robot.ledger.entries], states.motion.tobytes(), states.age_ns.tolist()

    compiled = packets()
    monkeypatch.setattr(kernel, "load", lambda: None)
    assert packets() == compiled


def test_an_object_of_another_source_is_not_used(tmp_path, monkeypatch):
    shutil.copy(kernel.LIBRARY, tmp_path / "libkernel.so")
    assert kernel.load(tmp_path / "libkernel.so") is not None
    (tmp_path / "kernel.c").write_text("int changed;")
    monkeypatch.setattr(kernel, "SOURCE", tmp_path / "kernel.c")
    assert kernel.load(tmp_path / "libkernel.so") is None
    assert kernel.load(tmp_path / "absent.so") is None


@pytest.mark.parametrize("call", ["wait", "write", "read_into", "now_ns"])
def test_an_interrupt_on_virtual_time_comes_out_of_the_kernel(monkeypatch, call):
    rig = start_rig(make_plan((1, 2)))
    rig.cycles(5)
    assert rig.hardware._by_kernel
    port = rig.ports.ports[0]
    owner = {"wait": rig.ports, "now_ns": rig.hardware._kernel}.get(call, port)

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(owner, "_now_ns" if call == "now_ns" else call, interrupted)
        with pytest.raises(KeyboardInterrupt):
            rig.hardware._kernel.read()
    rig.clock.wait_until(rig.clock.now_ns() + 100_000_000)
    rig.cycles(5)
    assert rig.states.valid.all()


@pytest.fixture
def two_lines():
    rig = start_rig(make_plan((1, 2)), make_plan((3,), name="other", first_row=2))
    rig.cycles(5)
    assert rig.hardware._by_kernel
    return rig


@pytest.mark.parametrize("accident", [False, True])
def test_no_row_is_valid_of_a_line_that_took_no_goals(two_lines, accident):
    rig = two_lines
    rig.hardware.read()
    rig.ports.ports[0].unplug()
    rig.goals.position[:] += 0.1
    rig.hardware.write()
    assert rig.hardware._buses[0].failure is not None
    if accident:  # on the other line: the parser ends the cycle
        rig.ports.ports[1]._arrived += b"\x55"
    rig.hardware.read()  # no gap came between, in which the lost line is set aside
    assert rig.states.valid.tolist() == [False, False, True]


@pytest.mark.parametrize("compiled", [True, False])
def test_what_is_sent_behind_goals_is_awaited_from_when_they_are_off_the_wire(compiled):
    rig = start_rig(make_plan((1, 2)), compiled=compiled)
    rig.cycles(5)
    (bus,) = rig.hardware._buses
    assert rig.hardware._by_kernel is compiled
    rig.hardware.read()
    rig.goals.position[:] += 0.1
    before_ns = rig.clock.now_ns()
    rig.hardware.write()
    assert bus.words[FREE_NS] == before_ns + len(rig.into_bus()[-1]) * bus.byte_ns


def test_goals_go_out_behind_what_the_parser_sent():
    rig = start_rig(make_plan((1, 2)))
    rig.cycles(5)
    (bus,) = rig.hardware._buses
    rig.hardware.read()
    rig.goals.position[:] += 0.1
    bus.send(bytes(100))  # such as reduced limits of torque
    before_ns = bus.words[FREE_NS]
    rig.hardware.write()
    assert bus.words[FREE_NS] == before_ns + len(rig.into_bus()[-1]) * bus.byte_ns


@pytest.mark.parametrize(
    ("buses", "servos", "compiled"), [(32, 1, True), (33, 1, False), (1, 150, True), (1, 250, True)]
)
def test_a_robot_that_the_kernel_has_no_room_for_is_left_to_the_parser(buses, servos, compiled):
    plans = [
        make_plan(
            range(servos), name=f"bus{index}", first_row=index * servos, model="XM430-W350", protocol=2.0
        )
        for index in range(buses)
    ]
    side = fuzz.Side(plans, kernel.load(), memoryview(bytearray(2064)))
    assert (side.hardware._kernel is not None) == compiled
    side.goals.values[:] = 0.0
    side.hardware.write()
    assert all(line.sent for line in side.lines.ports)


@pytest.mark.parametrize("gone", [False, True], ids=["alone", "beside a lost line"])
def test_a_reply_from_before_its_request_is_stray_however_late_the_host_looks(gone):
    plans, dialect = fuzz.robot("single reads", 2)
    side = fuzz.Side(plans, kernel.load())
    goals = np.full_like(side.goals.values, np.nan)
    _, line = side.lines.ports
    before = b""
    for number in range(16):
        reads = side.prepare()
        data = bytes((240 + number, 1, 0, 0, 0, 0))
        replies = [
            [(one.packet, [(3_000_000, dialect.status_packet(one.servo_id, 0, data))]) for one in mine]
            for mine in reads
        ]
        if gone and number == 6:
            replies[0] = [(reads[0][0].packet, None)]
        if number == 15:
            assert side.hardware._by_kernel
            line.arriving.append((side.lines.clock.now_ns(), before))
            line.stall_ns = 2_000_000  # longer than the wire takes for both
        side.cycle(replies, goals)
        before = replies[1][0][1][0][1]
    assert str(side.hardware._buses[0].failure) == ("it is gone" if gone else "None")
    logged = [packet for packet in side.log if packet.bus == 1]
    assert logged[0].kind is not PacketKind.INSTRUCTION
    answers = [packet.data for packet in logged[1:] if packet.kind is PacketKind.STATUS]
    assert answers == [pieces[0][1] for _, pieces in replies[1]]
    assert side.states.valid[len(plans[0].servos) :].all()


@pytest.mark.parametrize("compiled", [True, False], ids=["kernel", "parser"])
def test_a_doubled_reply_is_logged_in_the_same_cycle_by_kernel_and_parser(compiled):
    plans, dialect = fuzz.robot("sync read", 3)
    side = fuzz.Side(plans, kernel.load() if compiled else None)
    goals = np.full_like(side.goals.values, np.nan)
    counts = []
    for number in range(8):
        replies = []
        for index, ((read,),) in enumerate(zip(side.prepare(), strict=True)):
            answers = [dialect.status_packet(one.servo_id, 0, bytes(one.length)) for one in read.awaited]
            pieces = [(2_000_000, b"".join(answers))]
            if number == 6 and index != 1:  # at the instant of the other lines' last replies
                pieces = [(2_000_000, b"".join([*answers, answers[0]])), (2_000_000, answers[0])]
            replies.append([(read.packet, pieces)])
        assert number != 6 or side.hardware._by_kernel is compiled
        side.cycle(replies, goals)
        counts.append(
            [sum(p.bus == bus and p.kind is PacketKind.STATUS for p in side.log) for bus in range(3)]
        )
        assert side.states.valid.all()
    # the parser hears every line that a wait has shown before it waits again; so does the kernel
    assert counts[5:] == [[4, 4, 4], [5, 4, 5], [5, 4, 5]]


class TestOnDescriptors:
    """A line that a test answers itself, through a pseudo-terminal."""

    @pytest.fixture
    def line(self, request):
        # a reply may take as long as the adapter is said to take
        latency_ns = getattr(request, "param", 0)
        plan = make_plan((1, 2), model="XM430-W350", protocol=2.0, latency_ns=latency_ns)
        ours, theirs = os.openpty()
        for end in (ours, theirs):
            tty.setraw(end)
        rig = make_rig(plan)
        states, goals = States.empty(2), Commands.empty(2)
        ports = SerialPorts([SerialPort(theirs, "pty")])
        hardware = DynamixelHardware(
            [plan],
            ports,
            MonotonicClock(),
            states,
            goals,
            rig.packets,
            rig.events,
            lambda: rig.beats.append(0),
            library=kernel.load(),
        )
        (servos,) = hardware._servos
        while servos.reads.plan().program is None:  # as after some cycles in which every servo answered
            servos.reads.end()
        yield plan, hardware, ours, states, rig
        for end in (ours, theirs):
            os.close(end)

    @pytest.mark.parametrize("line", [10_000_000_000], indirect=True)
    def test_a_reply_is_taken_stamped_and_logged(self, line):
        plan, hardware, ours, states, rig = line
        (read,) = plan.reads
        said = [protocol2.status_packet(one.servo_id, 0, bytes(one.length)) for one in read.awaited]
        answering = Thread(target=answer, args=(ours, len(read.packet), b"".join(said)))
        answering.start()
        hardware.read()
        answering.join()
        assert states.valid.tolist() == [True, True]
        kinds = [packet.kind for packet in rig.packets.list]
        assert kinds == [PacketKind.INSTRUCTION, PacketKind.STATUS, PacketKind.STATUS]
        sent, first, _ = rig.packets.list
        assert sent.first_ns <= sent.last_ns <= first.first_ns
        assert hardware._servos[0].reads._calm == CALM_CYCLES  # the parser has read none

    def test_silence_ends_in_the_parser_and_the_loop_shows_that_it_lives(self, line):
        _, hardware, _, states, rig = line
        hardware.read()
        assert states.valid.tolist() == [False, False]
        assert len(rig.beats) > 1  # a beat a millisecond while replies are awaited; a busy machine has fewer
        assert hardware._servos[0].reads._calm == 0  # the parser ended the cycle

    def test_a_line_that_hangs_up_is_gone_and_names_its_port(self, line):
        _, hardware, ours, states, _ = line
        os.dup2(os.open(os.devnull, os.O_RDONLY), ours)  # the other end is closed
        hardware.read()
        (bus,) = hardware._buses
        assert "pty is gone" in str(bus.failure)
        assert not states.valid.any()


def answer(terminal, size, replies):
    """Answer a read on the other end, no sooner than the wire allows."""
    got = b""
    while len(got) < size:
        got += os.read(terminal, size - len(got))
    time.sleep(0.002)
    os.write(terminal, replies)


@pytest.mark.parametrize(
    ("compiler", "built"), [("{cc} -g", True), ("/nowhere/cc", False), ("false", False)], ids=str
)
def test_the_build_takes_a_compiler_with_options_and_goes_on_without_one(
    tmp_path, monkeypatch, compiler, built
):
    name = "hatchling.builders.hooks.plugin.interface"
    stub = ModuleType(name)  # the build has hatchling, tests need none of it
    stub.BuildHookInterface = dict
    monkeypatch.setitem(sys.modules, name, stub)
    spec = importlib.util.spec_from_file_location("hatch_build", Path(__file__).parents[2] / "hatch_build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    (tmp_path / module.FOLDER).mkdir(parents=True)
    shutil.copy(kernel.SOURCE, tmp_path / module.FOLDER)
    monkeypatch.setenv("CC", compiler.format(cc=shutil.which("cc") or shutil.which("gcc")))
    target = module.compile_kernel(tmp_path)
    assert (target is not None) == built
    assert not built or kernel.load(target) is not None


@pytest.mark.parametrize("compiled", [True, False], ids=["kernel", "parser"])
@pytest.mark.parametrize(
    "case", [("AX-12A", 1.0, [50, 20]), ("XM430-W350", 2.0, [113, 37])], ids=["protocol 1", "protocol 2"]
)
def test_goals_beyond_one_sync_write_are_split(compiled, case):
    model, protocol, counts = case
    plan = make_plan(range(sum(counts)), model=model, protocol=protocol)
    side = fuzz.Side([plan], kernel.load() if compiled else None, memoryview(bytearray(2064)))
    side.goals.values[:] = 0.0
    side.hardware.write()
    (line,) = side.lines.ports
    side.packets.commit()
    assert [packet.data for packet in side.log] == line.sent
    size = plan.servos[0].goal.length + 1
    for packet, count in zip(line.sent, counts, strict=True):
        if protocol == 1.0:
            assert packet[3] == len(packet) - 4 == 4 + count * size
            assert (sum(packet[2:]) & 0xFF) == 0xFF
        else:
            assert int.from_bytes(packet[5:7], "little") == len(packet) - 7


ODD = st.floats(-4, 4) | st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -0.0, 1e300, 5e-324])


@pytest.mark.parametrize("name", ["single reads", "sync read", "two layouts"])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_goals_become_the_same_packets_in_kernel_and_parser(name, data):
    plans, _ = fuzz.robot(name, 1)
    sides = [fuzz.Side(plans, kernel.load()), fuzz.Side(plans, None)]
    count = len(plans[0].servos)
    modes = [data.draw(st.sampled_from([one.mode for one in servo.modes])) for servo in plans[0].servos]
    ceiling = data.draw(st.lists(st.just(math.nan) | st.floats(0, 5), min_size=count, max_size=count))
    for side in sides:
        (servos,) = side.hardware._servos
        servos.life.ceiling[:] = ceiling
        for index, mode in enumerate(modes):
            servos.goals.set_mode(index, mode)
    for _ in range(4):
        goals = data.draw(st.lists(st.lists(ODD, min_size=count, max_size=count), min_size=4, max_size=4))
        repeats = data.draw(st.sampled_from([1, 2, 51]))
        for _ in range(repeats):
            for side in sides:
                side.write(np.array(goals), 0)
            assert sides[0].lines.ports[0].sent == sides[1].lines.ports[0].sent
