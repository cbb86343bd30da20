"""Plans of buses, units of joints, lines that go and come back, and the face of dxlwire."""

import ast
import contextlib
import doctest
import os
import select
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.plans import make_plan

import dxlwire
from dxlwire.bus_plan import BusPlan
from dxlwire.control_table import find_table, model_names
from dxlwire.exceptions import PortError
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit
from dxlwire.plan.line import LONGEST_RETURN_DELAY_NS, TIMEOUT_MARGIN_NS
from dxlwire.plan.planning import torque_off_ns
from dxlwire.port import reopening
from dxlwire.port.reopening import KeptLines, LineSettings, lasting_name


@pytest.mark.parametrize(("latency_ms", "total_ms", "rate_hz"), [(1, 14.1, 71), (16, 134, 7)])
def test_the_budget_of_protocol_md_by_the_latency_timer(latency_ms, total_ms, rate_hz):
    budget = make_plan(latency_ns=latency_ms * 1_000_000).budget
    assert (budget.wire_ns, budget.return_delay_ns) == (1_600_000 + 480_000, 4_000_000)
    assert budget.latency_ns == 8_000_000 * latency_ms
    assert budget.total_ns / 1e6 == pytest.approx(total_ms, abs=0.1)
    assert round(budget.highest_rate_hz) == rate_hz


def test_the_budget_of_protocol_md_for_eight_x_servos():
    budget = make_plan(protocol=2.0, model="XM430-W350", latency_ns=1_000_000).budget
    goals = 14 + 8 * 9
    assert budget.request_bytes == 22 + goals
    # fast sync read: 0.22 + 1.2 ms, and one return delay
    assert budget.wire_ns == 220_000 + 1_200_000 + goals * 10_000
    assert (budget.return_delay_ns, budget.latency_ns) == (500_000, 1_000_000)


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_every_model_has_a_plan_that_survives_json(protocol):
    for model in model_names(protocol):
        plan = make_plan((1, 2), model=model, protocol=protocol, reference=0.0, lower=-9.0, upper=9.0)
        layout, table = plan.servos[0].state, find_table(model, protocol)
        assert layout.address + layout.position.offset == table.items["present_position"].address
        assert len(plan.groups) == (1 if "bulk_read" in table.capabilities else 2)
        assert len(plan.limp) == 1
        assert msgspec.json.decode(msgspec.json.encode(plan), type=BusPlan) == plan


def test_reads_are_six_bytes_from_present_position_on_with_their_times():
    plan = make_plan()
    assert [read.packet[4:7].hex() for read in plan.reads] == ["022406"] * 8
    assert [read.servo_id for read in plan.reads] == [1, 3, 5, 6, 2, 4, 20, 21]
    assert {one.length for read in plan.reads for one in read.awaited} == {6}
    assert {read.due_ns for read in plan.reads} == {200_000 + 500_000}
    patient = make_plan(latency_ns=16_000_000, return_delay_ns=LONGEST_RETURN_DELAY_NS)
    assert {one.timeout_ns for one in patient.reads} == {200_000 + 508_000 + 16_000_000 + TIMEOUT_MARGIN_NS}


def test_torque_off_takes_a_broadcast_and_two_requests_of_each_servo():
    plan = make_plan((1, 7), latency_ns=1_000_000, return_delay_ns=500_000)
    (limp,) = plan.limp
    assert (limp.packet.hex(" "), limp.awaited) == ("ff ff fe 04 03 18 00 e2", ())
    broadcast_ns, write_ns, read_ns = 8 * 10_000, (8 + 6) * 10_000, (8 + 7) * 10_000
    each_ns = write_ns + read_ns + 2 * (500_000 + 1_000_000)
    assert torque_off_ns(plan) == broadcast_ns + 2 * each_ns


def test_limits_become_ticks_inside_them():
    plan = make_plan((1, 2), lower=-1.0, upper=0.5)
    for servo in plan.servos:
        ends = sorted((servo.joint_position(servo.lower_tick), servo.joint_position(servo.upper_tick)))
        assert ends[0] >= -1.0
        assert ends[1] <= 0.5
        assert ends[1] - ends[0] > 1.5 - 2 * servo.rad_per_tick
    assert plan.servos[0].joint_position(1023) == pytest.approx(-2.6179938779914944)


@pytest.mark.parametrize(("model", "protocol", "most"), [("AX-12A", 1.0, 50), ("XM430-W350", 2.0, 113)])
def test_goals_beyond_one_sync_write_are_counted_as_two(model, protocol, most):
    def goal_bytes(count):
        return make_plan(tuple(range(count)), model=model, protocol=protocol).budget.goal_bytes

    per_servo = goal_bytes(most) - goal_bytes(most - 1)
    assert goal_bytes(most + 1) == goal_bytes(most) + goal_bytes(1)
    assert goal_bytes(2) == goal_bytes(1) + per_servo


class Adapter:
    """A pseudo-terminal behind a link, as udev's are."""

    def __init__(self, link):
        self.link = link
        self.master, self._slave = os.openpty()
        self._point()

    def unplug(self):
        os.close(self.master)
        os.close(self._slave)
        self.link.unlink()

    def plug_in(self):
        self.master, self._slave = os.openpty()
        self._point()

    def heard(self):
        assert select.select([self.master], [], [], DEADLINE_S)[0]
        return os.read(self.master, 100)

    def _point(self):
        self.link.symlink_to(os.ttyname(self._slave))


@pytest.fixture
def adapters(tmp_path):
    both = [Adapter(tmp_path / "left"), Adapter(tmp_path / "right")]
    yield both
    for adapter in both:
        adapter.unplug()


@pytest.fixture
def kept(adapters):
    lines = KeptLines([LineSettings(str(adapter.link), 1_000_000, 0) for adapter in adapters])
    yield lines
    lines.close()


def returned(lines):
    assert select.select([lines], [], [], DEADLINE_S)[0]
    return [one.index for one in lines.returned()]


def test_a_socket_is_a_line_that_stays_lost():
    ours, theirs = socket.socketpair()
    with (
        ours,
        contextlib.closing(KeptLines([LineSettings("sim", 1_000_000, 0, socket=theirs.detach())])) as lines,
    ):
        os.write(lines.descriptors[0], b"goal")
        assert ours.recv(100) == b"goal"
        assert not lines.lost(0)


def test_a_line_that_is_back_under_another_name_has_its_old_descriptor_and_lock(adapters, kept):
    before, opened = list(kept.descriptors), len(os.listdir("/proc/self/fd"))
    adapters[1].unplug()
    assert kept.lost(1)
    assert os.readlink(f"/proc/self/fd/{kept.descriptors[1]}") == os.devnull
    assert kept.returned() == []
    adapters[1].plug_in()
    assert returned(kept) == [1]
    assert kept.descriptors == before
    assert len(os.listdir("/proc/self/fd")) == opened
    os.write(kept.descriptors[1], b"right")
    assert adapters[1].heard() == b"right"
    os.write(kept.descriptors[0], b"left")
    assert adapters[0].heard() == b"left"
    with pytest.raises(PortError, match="in use"):
        KeptLines([LineSettings(str(adapters[1].link), 1_000_000, 0)])


def test_a_line_that_is_gone_for_long_is_tried_each_two_seconds(adapters, kept, monkeypatch):
    pauses = []

    def sleep(pause_s):
        pauses.append(pause_s)
        if sum(pauses) > 10.0 and not adapters[0].link.exists():
            adapters[0].plug_in()

    monkeypatch.setattr(reopening, "time", SimpleNamespace(sleep=sleep))
    adapters[0].unplug()
    kept.lost(0)
    assert returned(kept) == [0]
    assert 10.0 < sum(pauses) <= 12.0
    assert max(pauses) == pauses[-1] == 2.0


def test_both_lines_may_be_gone_at_once_and_come_back_in_any_order(adapters, kept):
    for index in (0, 1):
        adapters[index].unplug()
        kept.lost(index)
    adapters[1].plug_in()
    assert returned(kept) == [1]
    adapters[0].plug_in()
    assert returned(kept) == [0]


def test_of_two_lines_of_which_one_is_missing_neither_is_kept(adapters):
    left = str(adapters[0].link)
    with pytest.raises(PortError, match="port /dev/ttyNOPE not found"):
        KeptLines([LineSettings(left, 1_000_000, 0), LineSettings("/dev/ttyNOPE", 1_000_000, 0)])
    KeptLines([LineSettings(left, 1_000_000, 0)]).close()


def test_the_name_by_which_an_adapter_is_found_again(tmp_path):
    device, stranger = tmp_path / "ttyUSB0", tmp_path / "ttyUSB1"
    device.touch()
    (tmp_path / "by-id").mkdir()
    link = tmp_path / "by-id/usb-FTDI_FT9HDA1"
    link.symlink_to(device)
    assert lasting_name(str(device), tmp_path) == str(link)
    assert lasting_name(str(link), tmp_path) == str(link)
    assert lasting_name(str(stranger), tmp_path) == str(stranger)
    assert lasting_name("/dev/pts/7", tmp_path) == ""


README = Path(dxlwire.__file__).with_name("README.md")
OWN = Path(__file__).parent
KIT = [OWN.parent / f"kit/{name}.py" for name in ("cases", "exchanges", "plans")]


def test_every_public_name_exists() -> None:
    assert dxlwire.__all__
    for name in dxlwire.__all__:
        assert getattr(dxlwire, name) is not None
    assert set(dxlwire.__all__) <= set(dir(dxlwire))
    with pytest.raises(AttributeError, match="has no attribute 'robots'"):
        dxlwire.robots  # noqa: B018  the access is what raises


def test_examples_of_docstring_and_readme_are_right() -> None:
    assert doctest.testmod(dxlwire).failed == 0
    result = doctest.testfile(str(README), module_relative=False)
    assert result.failed == 0
    assert result.attempted > 5


def test_import_loads_neither_numpy_nor_dxlrun() -> None:
    code = """
import sys, dxlwire
assert not {"numpy", "msgspec"} & set(sys.modules)
from dxlwire.control_table import all_tables
assert len(all_tables()) > 60
assert not {"numpy", "pydantic", "yaml", "serial", "dynamixel_sdk"} & set(sys.modules)
for name in dxlwire.__all__:
    getattr(dxlwire, name)
import dxlwire.exchange.kernel, dxlwire.exchange.idle, dxlwire.plan.planning, dxlwire.port.reopening
print(sorted(name for name in sys.modules if name.split(".")[0] in ("dxlrun", "dxlsim", "pydantic")))
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "[]\n"


def test_tests_of_dxlwire_need_neither_runtime_nor_simulation() -> None:
    found: dict[str, set[str]] = {}
    for path in (*OWN.rglob("*.py"), *KIT):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = {one.name for one in node.names}
            else:
                names = {node.module or ""} if isinstance(node, ast.ImportFrom) else set()
            found.setdefault(path.name, set()).update(names)
    own = {name for names in found.values() for name in names if name.split(".")[0] in ("dxlrun", "dxlsim")}
    assert own == set()
    kit = {name for names in found.values() for name in names if name.startswith("tests.")}
    assert kit == {"tests.kit.awaited", "tests.kit.cases", "tests.kit.exchanges", "tests.kit.plans"}


def test_texts_are_in_the_unit_that_people_read() -> None:
    assert (ROTARY.text(0.5), LINEAR.text(0.0123456)) == ("28.65 deg", "12.35 mm")
    assert (ROTARY.text(0.5, trim=True), LINEAR.text(0.03, trim=True)) == ("28.65 deg", "30 mm")
    assert (ROTARY.text(0.5, digits=0), LINEAR.text(0.0123, digits=1)) == ("29 deg", "12.3 mm")
    assert (ROTARY.speed_text(0.5), LINEAR.speed_text(0.5)) == ("28.65 deg/s", "500.00 mm/s")
    assert (ROTARY.exact_text(0.5), LINEAR.exact_text(0.0123456)) == ("28.6479 deg", "12.3456 mm")


def test_numbers_have_no_sign_before_zero() -> None:
    signed = [ROTARY.number(value, signed=True) for value in (0.5, -0.5, 0.0, -1e-9)]
    assert signed == ["+28.65", "-28.65", "0", "0"]
    assert [LINEAR.number(value, digits=0) for value in (0.1, -1e-9)] == ["100", "0"]


@pytest.mark.parametrize("unit", JointUnit)
def test_a_unit_is_found_by_each_of_its_quantities(unit: JointUnit) -> None:
    quantities = (unit.si, unit.speed, unit.acceleration, unit.effort_unit("Nm"))
    assert [JointUnit.find_by_quantity(one) for one in quantities] == [unit] * 4
    assert [unit.effort_unit(measured) for measured in ("A", "1")] == ["A", "1"]


def test_no_joint_has_a_quantity_of_another_unit() -> None:
    with pytest.raises(LookupError, match="A is not a unit of a joint"):
        JointUnit.find_by_quantity("A")


def test_plans_name_a_unit() -> None:
    assert msgspec.json.encode([ROTARY, LINEAR]) == b'["rad","m"]'
    assert msgspec.json.decode(b'"m"', type=JointUnit) is LINEAR
