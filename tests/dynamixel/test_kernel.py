"""The compiled kernel does what the parser does, whatever arrives; goals by the rules of one servo."""

import math
import os
import re
import shutil
import time
import tty
from contextlib import suppress
from pathlib import Path
from threading import Thread, Timer

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.kit.awaited import until
from tests.kit.campaigns import campaign
from tests.kit.exchanges import AT_NS, GOOD, Host, SpoiltReplies, every
from tests.kit.loaded import loaded
from tests.kit.rigs import make_plan, make_rig, start_rig

import fuzz_kernel as fuzz
from dxlrun.channels.cycle import Commands, States
from dxlrun.dynamixel.dynamixel_hardware import DynamixelHardware, ServoArrays
from dxlrun.dynamixel.servo.life import ServoEvent
from dxlrun.errors import PortError
from dxlwire.clock import MonotonicClock
from dxlwire.exceptions import NotCompiled
from dxlwire.exchange import bus_engine, kernel
from dxlwire.exchange.bus_engine import FREE_NS, Lines
from dxlwire.exchange.cyclic_reads import CALM_CYCLES
from dxlwire.modes import Mode
from dxlwire.packets import RECORD_HEADER, PacketKind
from dxlwire.port import ports
from dxlwire.port.ports import SerialPort, SerialPorts
from dxlwire.wire import protocol1, protocol2

ROOT = Path(__file__).parents[2]
STEADY = b"\0\2" + bytes(8)
by_both = pytest.mark.parametrize("by_parser", [False, True], ids=["kernel", "parser"])


def test_numbers_that_both_sides_share_are_the_same():
    """The structs are read from `kernel.c`; these have a type in Python."""
    text = kernel.SOURCE.read_text()
    found = {name: int(value) for name, value in re.findall(r"#define (\w+) (\d+)", text)}
    for names in re.findall(r"^enum \{(.*?)\}", text, re.MULTILINE):
        place = -1
        for name, _, value in (one.partition(" = ") for one in names.split(", ")):
            found[name.strip()] = place = int(value or place + 1)
    of_engine = ("FREE_NS", "LATE_NS", "LOST", "ASKED_NS", "SILENCE_NS", "MOST_LATE_NS")
    shared = {one.name: int(one) for one in (*kernel.Answer, PacketKind.INSTRUCTION, PacketKind.STATUS)}
    shared |= {name: getattr(bus_engine, name) for name in of_engine}
    shared |= {name.upper(): value for name, value in kernel._ENCODINGS.items()}
    shared |= {"AWAITING": kernel.AWAITING, "RECORD_HEADER": RECORD_HEADER}
    shared |= {"WRITE_TIMEOUT_NS": ports._WRITE_TIMEOUT_NS}
    assert {name: found[name] for name in shared} == shared


@pytest.mark.parametrize(
    ("name", "streams", "by_kernel", "interrupted"),
    [
        ("single reads", 1_000, 50, 20),
        ("bulk read", 1_000, 50, 20),
        ("sync read", 1_000, 50, 20),
        ("fast sync read", 1_000, 50, 20),
        ("two layouts", 1_000, 50, 20),
        ("bulk read with devices", 500, 20, 10),
        ("fast bulk read with devices", 500, 20, 10),
    ],
)
def test_kernel_and_parser_agree_on_whatever_lines_say(name, streams, by_kernel, interrupted):
    tally = fuzz.campaign(streams, seed=len(name), names=[name])
    # neither side of the comparison is empty
    assert tally.by_kernel > by_kernel
    assert tally.interrupted > interrupted


@campaign(ci=1500, night=200_000, release=2_000_000)
def test_kernel_and_parser_agree_on_many_streams(amount, chance):
    fuzz.campaign(int(amount), seed=chance.getrandbits(32))


def steady(side, dialect, second=STEADY):
    """Run a cycle in which everything says the same again, and the second device of a line these bytes."""

    def said(one):
        data = second if one.servo_id == 101 else STEADY
        return dialect.status_packet(one.servo_id, 0, data[: one.length])

    def answers(read):
        sent_ns = 10_000 * len(read.packet)
        return [(sent_ns + 500_000 * (3 + place), said(one)) for place, one in enumerate(read.awaited)]

    given = [[(read.packet, answers(read)) for read in line] for line in side.prepare()]
    side.cycle(given, np.full_like(side.goals.values, np.nan))


@by_both
def test_a_device_is_not_valid_where_any_part_of_it_is_no_number(by_parser):
    plans, dialect = fuzz.robot("bulk read with devices", 1)
    side = fuzz.Side(plans, by_parser=by_parser)
    for _ in range(8):
        steady(side, dialect)
    assert side.sources.valid.tolist() == [True] * 3
    assert (side.ended > 0) != by_parser
    steady(side, dialect, b"\xff" * 10)  # the float is in its second part
    assert side.sources.valid.tolist() == [True, False, True]


def test_the_replies_of_two_lines_have_room_in_the_log_beside_one_another():
    plans, dialect = fuzz.robot("sync read", 2)
    memory, size = bytearray(4096), 2048
    side = fuzz.Side(plans, memoryview(memory)[:size])
    for earlier in range(1000, 2000, 10):  # bytes of the period before that are not committed
        side.packets.packet(0, PacketKind.NOISE, 0, 0, 0, bytes(earlier))
        steady(side, dialect)
        assert not any(memory[size:]), f"behind {earlier} bytes"
    assert side.ended > 90


def test_an_object_that_is_absent_or_of_another_source_is_refused(tmp_path, monkeypatch):
    shutil.copy(kernel.LIBRARY, tmp_path / "libkernel.so")
    kernel.library(path=tmp_path / "libkernel.so")
    (tmp_path / "kernel.c").write_text("int changed;")
    monkeypatch.setattr(kernel, "SOURCE", tmp_path / "kernel.c")
    with pytest.raises(NotCompiled, match=r"does not match kernel\.c; install dxlrun again"):
        kernel.library(path=tmp_path / "libkernel.so")
    with pytest.raises(NotCompiled, match=r"^the compiled kernel is missing; install dxlrun again"):
        kernel.library(path=tmp_path / "absent.so")


@pytest.fixture
def rig():
    """Two servos that the kernel reads."""
    rig = start_rig(make_plan((1, 2)))
    rig.cycles(8)
    assert rig.hardware._by_kernel
    return rig


@pytest.mark.parametrize("call", ["wait_for_bytes", "write_packet", "read_into", "now_ns"])
def test_an_interrupt_on_virtual_time_comes_out_of_the_kernel(rig, monkeypatch, call):
    owner = {"wait_for_bytes": rig.ports, "now_ns": rig.hardware._kernel}.get(call, rig.ports.ports[0])

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(owner, "_now_ns" if call == "now_ns" else call, interrupted)
        with pytest.raises(KeyboardInterrupt):
            rig.hardware.read_states()
    rig.clock.wait_until(rig.clock.now_ns() + 100_000_000)
    rig.cycles(5)
    assert rig.states.valid.all()


@pytest.mark.parametrize("accident", [False, True])
def test_no_row_is_valid_of_a_line_that_took_no_goals(accident):
    rig = start_rig(make_plan((1, 2)), make_plan((3,), name="other", first_row=2))
    rig.cycles(5)
    assert rig.hardware._by_kernel
    rig.hardware.read_states()
    rig.ports.ports[0].unplug()
    rig.goals.position[:] += 0.1
    rig.hardware.write_goals()
    assert rig.hardware._buses[0].failure is not None
    if accident:  # on the other line: the parser ends the cycle
        rig.ports.ports[1]._arrived += b"\x55"
    rig.hardware.read_states()  # no gap came between, in which the lost line is set aside
    assert rig.states.valid.tolist() == [False, False, True]


def test_line_that_is_gone_gets_no_second_packet_with_goals():
    plans, _ = fuzz.robot("two layouts", 1)
    side = fuzz.Side(plans)
    (line,) = side.lines.ports
    side.goals.values[:] = 0.1
    line.lost = True
    side.hardware.write_goals()
    assert len(line.sent) == 1
    assert side.hardware._buses[0].failure is not None


@pytest.mark.parametrize("moved", [0.0, 0.2])
def test_servo_that_missed_a_reply_gets_its_goal_as_soon_as_its_torque_was_read(rig, moved):
    rig.servo(2).silence()
    rig.cycle()
    rig.goals.position[1] += moved  # nothing is sent to it in this state
    rig.servo(2).silence(False)
    since = len(rig.into_bus())
    rig.cycles(6)
    assert any(2 in ids for _, ids in rig.goals_sent(since))
    rig.cycles(30)
    assert rig.states.position[1] == pytest.approx(rig.goals.position[1], abs=0.01)


@pytest.mark.parametrize("queued", [0, 100], ids=["at once", "behind what the parser sent"])
def test_what_is_sent_behind_goals_is_awaited_from_when_they_are_off_the_wire(rig, queued):
    (bus,) = rig.hardware._buses
    rig.hardware.read_states()
    rig.goals.position[:] += 0.1
    before_ns = rig.clock.now_ns()
    if queued:
        bus.send(bytes(queued))  # such as reduced limits of torque
        before_ns = bus.words[FREE_NS]
    rig.hardware.write_goals()
    assert bus.words[FREE_NS] == before_ns + len(rig.into_bus()[-1]) * bus.byte_ns


@pytest.mark.parametrize(("buses", "servos"), [(40, 1), (1, 150), (1, 250)])
def test_a_robot_for_which_the_kernel_has_no_room_gets_its_goals_and_is_read_by_the_parser(buses, servos):
    plans = [
        make_plan(range(servos), name=f"bus{row}", first_row=row * servos, model="XM430-W350", protocol=2.0)
        for row in range(buses)
    ]
    side = fuzz.Side(plans, memoryview(bytearray(2064)))
    side.goals.values[:] = 0.0
    side.hardware.write_goals()
    assert all(line.sent for line in side.lines.ports)
    side.lines.clock.wait_until(50_000_000)  # until that is off the wire
    for _ in range(5):
        steady(side, protocol2)
        assert side.states.valid.all()
    assert side.began == 0


class Terminal:
    """Two servos on a pseudo-terminal, which a test answers itself."""

    def __init__(self, latency_ns=0):
        self.plan = make_plan((1, 2), model="XM430-W350", protocol=2.0, latency_ns=latency_ns)
        self.ours, self.theirs = os.openpty()
        for end in (self.ours, self.theirs):
            tty.setraw(end)
        self.rig, self.states = make_rig(self.plan), States.empty(2)
        serial = SerialPorts([SerialPort(self.theirs, "pty")])
        packets, beat = self.rig.packets, lambda: self.rig.beats.append(0)
        lines = Lines([self.plan], serial, MonotonicClock(), packets, beat)
        arrays = ServoArrays(self.states, Commands.empty(2))
        self.hardware = DynamixelHardware(lines, packets, arrays, self.rig.events)
        (self.servos,), (self.bus,) = self.hardware._servos, self.hardware._buses
        while self.servos.reads.plan().program is None:  # as after cycles in which every servo answered
            self.servos.reads.end_cycle()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for end in (self.ours, self.theirs):
            os.close(end)

    def answer(self, size, replies):
        """Answer a read on the other end, no sooner than the wire allows."""
        got = b""
        while len(got) < size:
            got += os.read(self.ours, size - len(got))
        time.sleep(0.002)
        os.write(self.ours, replies)


def test_a_reply_on_a_descriptor_is_taken_stamped_and_logged():
    with Terminal(latency_ns=10_000_000_000) as line:  # a reply may take so long
        (read,) = line.plan.reads
        said = b"".join(protocol2.status_packet(one.servo_id, 0, bytes(one.length)) for one in read.awaited)
        answering = Thread(target=line.answer, args=(len(read.packet), said))
        answering.start()
        line.hardware.read_states()
        answering.join()
        assert line.states.valid.tolist() == [True, True]
        sent, first, second = line.rig.packets.list
        assert [one.kind for one in (sent, first, second)] == [
            PacketKind.INSTRUCTION,
            *[PacketKind.STATUS] * 2,
        ]
        assert sent.first_ns <= sent.last_ns <= first.first_ns
        assert line.servos.reads._calm == CALM_CYCLES  # the parser has read none


def test_line_that_takes_no_bytes_is_lost_and_does_not_stop_the_loop():
    with Terminal() as line:
        emptied, full = os.pipe2(os.O_NONBLOCK)  # a terminal makes room by itself
        for size in (4096, 1):
            with suppress(BlockingIOError):
                while True:
                    os.write(full, bytes(size))
        os.dup2(full, line.theirs)
        line.servos.life.torqued[:] = True
        line.hardware._goals.position[:] = 0.1
        end = Timer(5.0, os.read, (emptied, 1 << 20))  # of a write that has none itself
        end.start()
        line.hardware.write_goals()
        end.cancel()
        for descriptor in (emptied, full):
            os.close(descriptor)
        assert "accepts no more bytes" in str(line.bus.failure)


def test_silence_ends_in_the_parser_and_the_loop_shows_that_it_lives():
    def beats() -> bool:
        """One a millisecond while replies are awaited; none where this process slept until the timeout."""
        with Terminal(latency_ns=50_000_000) as line:
            line.hardware.read_states()
            assert line.states.valid.tolist() == [False, False]
            assert line.servos.reads._calm == 0  # the parser ended the cycle
            return len(line.rig.beats) > 1

    assert until(beats)


def test_a_line_that_hangs_up_is_gone_and_names_its_port():
    with Terminal() as line:
        os.dup2(os.open(os.devnull, os.O_RDONLY), line.ours)  # the other end is closed
        line.hardware.read_states()
        assert "pty is gone" in str(line.bus.failure)
        assert not line.states.valid.any()


# The build


@pytest.fixture
def build(tmp_path, monkeypatch):
    """The build, in a folder that has the sources."""
    module = loaded(ROOT / "hatch_build.py")
    for source in module.SOURCES:
        (tmp_path / source).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / source, tmp_path / source)
    monkeypatch.chdir(tmp_path)
    return module


@pytest.mark.parametrize(
    ("compiler", "works"), [("cc -g", True), ("/nowhere/cc", False), ("false", False)], ids=str
)
def test_a_build_asks_for_a_compiler_where_none_works(build, tmp_path, monkeypatch, compiler, works):
    monkeypatch.setenv("CC", compiler)
    for kind in ("wheel", "editable"):
        monkeypatch.setattr(build.hatchling.build, f"get_requires_for_build_{kind}", lambda _: ["first"])
        needed = getattr(build, f"get_requires_for_build_{kind}")()
        assert needed == (["first"] if works else ["first", "ziglang"])
    found = build.system_compiler(tmp_path)
    assert found == (compiler.split() if works else [])
    source = next(one for one in build.SOURCES if one.name == kernel.SOURCE.name)
    why = build.compile_kernel(tmp_path, found or compiler.split(), tmp_path / "libkernel.so", source)
    assert bool(why) != works
    if works:
        kernel.library(path=tmp_path / "libkernel.so")


def test_a_build_without_any_compiler_fails_and_names_the_fix(build, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "/nowhere/cc")
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(build, "find_spec", lambda _: None)
    hook = build.KernelHook(str(tmp_path), {}, None, None, "", "wheel")
    with pytest.raises(RuntimeError, match=r"install a C compiler \(sudo apt install gcc\)"):
        hook.initialize("standard", {})


class ParserHost(Host):
    """Four servos that the parser alone reads."""

    by_parser = True

    def __init__(self, way):
        plans, self.dialect = fuzz.robot(way, 1)
        self.side = fuzz.Side(plans, by_parser=self.by_parser)
        self.goals = np.full_like(self.side.goals.values, np.nan)
        (self.bus,) = self.side.hardware._buses
        self.byte_ns = self.bus.byte_ns

    def reads(self):
        return self.side.prepare()[0]

    def exchange(self, given):
        self.ended = self.side.ended
        self.side.cycle([given], self.goals)
        return self.side.states.valid.tolist()

    @property
    def log(self):
        return [(one.kind, one.data, one.last_ns) for one in self.side.log]

    @property
    def errors(self):
        return self.side.hardware._servos[0].reads.errors

    @property
    def noise_bytes(self):
        return self.bus.noise_bytes


class KernelHost(ParserHost):
    """Four servos that the kernel reads."""

    by_parser = False

    def check_reader(self, by_kernel):
        assert (self.side.ended > self.ended) == by_kernel


class TestParser(SpoiltReplies):
    host = ParserHost


class TestKernel(SpoiltReplies):
    host = KernelHost

    @every
    def test_a_line_that_is_ready_without_a_byte_is_waited_for(self, line, monkeypatch):
        wait, calls = line.side.lines.wait_for_bytes, []

        def ready(deadline_ns):
            calls.append(deadline_ns)
            return [0] if len(calls) == 2 else wait(deadline_ns)

        monkeypatch.setattr(line.side.lines, "wait_for_bytes", ready)
        assert line.cycle(by_kernel=True) == GOOD
        assert len(calls) > 2

    @every
    def test_a_line_that_is_gone_is_left_to_the_parser_at_once(self, line, monkeypatch):
        looks = []

        def gone(buffer):
            looks.append(len(buffer))
            raise PortError("it is gone")

        monkeypatch.setattr(line.side.lines.ports[0], "read_into", gone)
        assert line.cycle(by_kernel=False) == [False] * 4
        assert str(line.bus.failure) == "it is gone"
        assert len(looks) == 2  # the kernel's, and the parser's, which has the reason

    @every
    def test_reply_is_awaited_from_when_the_host_had_sent_its_request(self, line):
        line.side.lines.ports[0].stall_ns = 50_000_000  # longer than any reply is awaited

        def pieces(packets):
            return [(50_000_000 + AT_NS, b"".join(packets))]

        assert line.cycle(pieces=pieces, by_kernel=True) == GOOD

    @every
    def test_reply_that_came_while_the_host_stood_still_is_taken(self, line, monkeypatch):
        wait = line.side.lines.wait_for_bytes

        def late(deadline_ns):
            if deadline_ns:
                line.side.lines.clock.wait_until(deadline_ns + 30_000_000)
                return []
            return wait(0)

        monkeypatch.setattr(line.side.lines, "wait_for_bytes", late)
        assert line.cycle(by_kernel=True) == GOOD


REPEATED = 50
LEADS = {Mode.VELOCITY: 1, Mode.EFFORT: 2, Mode.PWM: 3}
ODD = st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300, 5e-324, 0.0, -0.0]) | st.floats(-10, 10)
DIALECTS = {1.0: protocol1, 2.0: protocol2}


class Writer:
    """The kernel, as it writes the goals of one bus."""

    def __init__(self, plan):
        self.plan, self.side = plan, fuzz.Side([plan])
        (self.servos,) = self.side.hardware._servos
        self.goals = self.side.goals

    def include(self, servos):
        for index, torqued in enumerate(self.servos.life.torqued.tolist()):
            if torqued != (index in servos):
                self.servos.life.on(index, ServoEvent.DOUBT if torqued else ServoEvent.TORQUE_ON)

    def write(self):
        """Send what is due; return the packets."""
        (line,) = self.side.lines.ports
        line.sent = []
        self.side.hardware.write_goals()
        return line.sent

    def sent(self):
        """Send what is due; return each servo's bytes of each packet, by ID."""
        return [records(packet, self.plan.protocol) for packet in self.write()]


def records(packet, protocol):
    """Take a sync write apart by ID; it must be as the dialect would have written it."""
    dialect = DIALECTS[protocol]
    size = 1 if protocol == 1.0 else 2
    body = packet[5:-1] if protocol == 1.0 else protocol2.unstuffed(packet[7:-2])[1:]
    address, length = (int.from_bytes(body[at : at + size], "little") for at in (0, size))
    body = body[2 * size :]
    assert len(body) % (length + 1) == 0
    found = {body[at]: body[at + 1 : at + 1 + length] for at in range(0, len(body), length + 1)}
    assert packet == dialect.sync_write(address, length, found)
    return found


def tick(cell, goal, ceiling):
    """Return the integer of a goal, as `GoalCell` says."""
    if cell.magnitude:
        if cell.interface == 1 and not (math.isnan(ceiling) or abs(goal) <= ceiling):
            goal = ceiling
        exact = abs(goal) / cell.unit
        if cell.low <= exact <= cell.high:
            return math.floor(exact + 1e-6) if cell.interface == 1 else round(exact)
        return cell.low if exact < cell.low else cell.high if exact > cell.high else cell.free
    exact = (cell.sign * goal + cell.offset) / cell.unit
    found = round(exact) if cell.low <= exact <= cell.high else cell.low if exact < cell.low else cell.high
    return 0x400 - found if cell.place.encoding == "sign_magnitude" and found < 0 else found


def block(cells, length, goals, row, ceiling):
    """Return a servo's bytes in a sync write."""
    found = bytearray(length)
    for cell in cells:
        at, size = cell.place.offset, cell.place.size
        value = tick(cell, goals[cell.interface][row], ceiling) & ((1 << 8 * size) - 1)
        found[at : at + size] = value.to_bytes(size, "little")
    return bytes(found)


@settings(max_examples=40, deadline=None)
@given(
    moves=st.lists(
        st.tuples(st.sets(st.integers(0, 7)), st.sets(st.integers(0, 7)), st.integers(1, 60)), max_size=6
    )
)
def test_a_goal_is_sent_when_it_changed_once_more_and_every_so_many_cycles(moves):
    writer = Writer(make_plan())
    goals, servos = writer.goals, writer.plan.servos
    goals.velocity[:] = goals.effort[:] = goals.pwm[:] = np.nan
    goals.position[:] = 0.1
    last, asked, chosen, cycle = [0] * 8, [2] * 8, set(range(8)), 0
    for moved, without, cycles in [(set(), set(), 3), *moves]:
        for servo in moved:
            goals.position[servo] += 0.05 if goals.position[servo] < 0.5 else -0.9
        now = set(range(8)) - without
        for servo in moved | (now - chosen):
            asked[servo] = 2
        chosen = now
        writer.include(chosen)
        for _ in range(cycles):
            cycle += 1
            wanted = {s for s in chosen if asked[s] or cycle - last[s] >= REPEATED}
            asked = [max(0, count - 1) for count in asked]
            for servo in wanted:
                last[servo] = cycle
            found = writer.sent()
            assert [set(one) for one in found] == ([{servos[s].servo_id for s in wanted}] if wanted else [])


KINDS = [("AX-12A", 1.0), ("MX-64", 1.0), ("XM430-W350", 2.0), ("XL-320", 2.0)]


@pytest.mark.parametrize("kind", KINDS, ids=str)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_servo_with_torque_and_a_goal_in_its_mode_gets_that_and_no_other_does(kind, data):
    model, protocol = kind
    writer = Writer(make_plan((1, 2, 3), model=model, protocol=protocol))
    servos = writer.plan.servos
    modes = [
        data.draw(st.sampled_from([one.mode for one in servo.modes] + [Mode.UNKNOWN])) for servo in servos
    ]
    torqued = data.draw(st.sets(st.integers(0, 2)))
    writer.include(torqued)
    ceiling = data.draw(st.lists(st.just(np.nan) | ODD.map(abs), min_size=3, max_size=3))
    writer.goals.values[:] = data.draw(
        st.lists(st.lists(ODD, min_size=3, max_size=3), min_size=4, max_size=4)
    )
    writer.servos.life.ceiling[:] = ceiling
    for index, mode in enumerate(modes):
        writer.servos.goals.set_mode(index, mode)
    values = writer.goals.values.tolist()
    expected = []
    for one in writer.servos.goals.sync_writes:
        rows = [
            at
            for at, row in enumerate(one.rows)
            if one.members[at] in torqued and not math.isnan(values[one.lead][row])
        ]
        expected.append(
            {
                one.ids[at]: block(
                    one.cells[at], one.layout.length, values, one.rows[at], ceiling[one.members[at]]
                )
                for at in rows
            }
        )
    assert writer.sent() == [one for one in expected if one]
    assert {servo_id for one in expected for servo_id in one} == {
        servo.servo_id
        for index, (servo, mode) in enumerate(zip(servos, modes, strict=True))
        if index in torqued
        and mode is not Mode.UNKNOWN
        and not math.isnan(values[LEADS.get(mode, 0)][servo.row])
    }


@pytest.mark.parametrize("dialect", [protocol1, protocol2], ids=["protocol 1", "protocol 2"])
def test_goals_are_stuffed_and_sealed_as_the_e_manual_says(dialect):
    ids, model = range(1, 41), "AX-12A" if dialect is protocol1 else "XM430-W350"
    change = {"model": model, "protocol": dialect.PROTOCOL, "reference": 0.0}
    ticks = [100 + servo_id for servo_id in ids]
    if dialect is protocol2:  # in which 40 servos have a length of two bytes
        change |= {"continuous": True, "lower": -1000.0, "upper": 1000.0}
        # FF FF FD FF, and what is nearly so: FF 00 FD, FF FF 00, 00 FF FD
        ticks[:4] = [-131073, -196353, 65535, -131328]
    writer = Writer(make_plan(ids, **change))
    for index, servo in enumerate(writer.plan.servos):
        writer.servos.goals.set_mode(index, Mode.POSITION)
        writer.goals.position[index] = servo.direction * ticks[index] * servo.rad_per_tick
    (packet,) = writer.write()
    place = writer.plan.servos[0].mode_plan(Mode.POSITION).goals[0].position
    found = records(packet, dialect.PROTOCOL)
    raw = [found[one][place.offset : place.offset + place.size] for one in ids]
    assert [int.from_bytes(one, "little", signed=place.size > 2) for one in raw] == ticks
    assert dialect is protocol1 or b"\xff\xff\xfd\xfd\xff" in packet


@pytest.mark.parametrize(
    "case", [("AX-12A", 1.0, [50, 20]), ("XM430-W350", 2.0, [113, 37])], ids=["protocol 1", "protocol 2"]
)
def test_goals_beyond_one_sync_write_are_split_and_logged(case):
    model, protocol, counts = case
    plan = make_plan(range(sum(counts)), model=model, protocol=protocol)
    side = fuzz.Side([plan], memoryview(bytearray(2064)))  # a batch of the log that holds but one of them
    side.goals.values[:] = 0.0
    side.hardware.write_goals()
    (line,) = side.lines.ports
    side.packets.commit_packets()
    assert [packet.data for packet in side.log] == line.sent
    assert [len(records(packet, protocol)) for packet in line.sent] == counts
