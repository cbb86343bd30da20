"""A sensor stops, sends NaN, its process is killed: what the loop's end of its slot makes of it."""

import os
import pty
import re
import select
import signal
import sys
import threading
import time
import tty
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.packages import plugin_folder

from dxlrun.channels import slot
from dxlrun.channels.child_processes import RunMemory
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.shared_memory import mapped
from dxlrun.channels.slot import SlotReader, SlotState
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.control.sampled_sources import PlannedProcess, ReaderContext, SourceContext, planned_processes
from dxlrun.errors import PortError
from dxlrun.features.sensors.reader import Readings
from dxlrun.plan.robot_plan import Plan
from dxlrun.process_table import found_runs
from dxlrun.run import supervisor
from dxlrun.run.run_processes import create_memory, start_source
from dxlrun.testing import plan_of

pytestmark = pytest.mark.usefixtures("no_memory_left")

PERIOD_S = 0.01
ROBOT = """\
name: one
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}}
loop: {rate: 50}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
"""
SENSORS = """\
sensors:
  imu:
    {{type: serial_imu, port: {port}, timeout: 1 s, columns: [angular_velocity.z, linear_acceleration.z]}}
"""


class Unit:
    """Sends a line each period, on a pseudo-terminal; what is not read is dropped."""

    def __init__(self) -> None:
        self._end, other = pty.openpty()
        tty.setraw(other)
        os.set_blocking(self._end, False)
        self.port = os.ttyname(other)
        self.line = b"0.25,9.81\n"
        self._other = other
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._send)
        self._thread.start()

    def _send(self) -> None:
        while not self._stop.wait(PERIOD_S):
            with suppress(BlockingIOError):
                os.write(self._end, self.line)

    def send_last(self, line: bytes) -> None:
        """Send a line after which no other comes."""
        self._stop.set()
        self._thread.join()
        os.set_blocking(self._end, True)
        os.write(self._end, line)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._end)
        os.close(self._other)


@pytest.fixture
def unit():
    unit = Unit()
    yield unit
    unit.close()


def plan_with(folder: Path, sensors: str) -> Plan:
    robot = folder / "one.yaml"
    robot.write_text(ROBOT + sensors)
    return plan_of(robot)


def only_process(plan: Plan) -> PlannedProcess:
    """Return the process of the robot's only sensor."""
    (planned,) = planned_processes(plan.loop)
    return planned


def start_only(plan: Plan, memory: RunMemory) -> Any:
    """Start the process of the robot's only sensor."""
    return start_source(plan, only_process(plan), memory)


def test_a_sensor_that_dies_sends_nan_or_stops_and_comes_back(tmp_path, unit, monkeypatch):
    monkeypatch.setattr(supervisor, "_RESTART_S", 0.1)
    plan = plan_with(tmp_path, SENSORS.format(port=unit.port))
    memory, record, events = create_memory(plan), CycleRecord(plan.loop.layout), []

    class Sink:
        def emit_event(self, source, event):
            events.append(event.text.removeprefix("sensor imu").lstrip(": "))

    slots = [mapped(descriptor) for descriptor in memory.slots["sensors"]]
    now_ns = [time.monotonic_ns()]  # the loop's: it only passes where a sensor is silent
    readings = Readings(
        ReaderContext(plan.feature_plans["sensors"], slots, record, lambda: now_ns[0], Sink())
    )
    sensor = supervisor._SourceProcess(plan, only_process(plan), memory, start_only(plan, memory))

    def read_until(valid, *, value=0.25):
        def is_read():
            sensor.supervise_process()
            readings.read_sources()
            return record.sources.valid[0] == valid and record.sources.values[0] == value

        until(is_read, events)

    try:
        sensor.child.ready()
        read_until(True)
        found = {one.pid: one.role for run in found_runs() for one in run.processes}
        assert found[sensor.child.process.pid] == "sensor"
        os.kill(sensor.child.process.pid, signal.SIGKILL)
        read_until(False)
        assert record.sources.age_ns[0] == 0  # at once, not by its timeout
        unit.line = b"0.5,9.81\n"
        read_until(True, value=0.5)
        unit.line = b"nan,9.81\n"
        read_until(False, value=0.5)
        unit.send_last(b"0.75,9.81\n")
        read_until(True, value=0.75)
        now_ns[0] += 1_500_000_000
        read_until(False, value=0.75)
    finally:
        sensor.end_process()
    assert events[:5] == [
        "its process exited (signal SIGKILL) and is restarted",
        "has failed; its values are not valid",
        "delivers samples again",
        "angular_velocity.z is nan; its values are not used",
        "delivers samples again",
    ]
    assert len(events) == 6
    assert events[5].startswith("delivered no sample for 1500 ms")


def test_a_device_that_is_not_there_at_the_start_is_a_sentence(tmp_path):
    """The supervisor then ends the run, as for a port that is not there."""
    plan = plan_with(tmp_path, "sensors:\n  imu: {type: serial_imu, port: /dev/no_imu}\n")
    memory = create_memory(plan)
    child = start_only(plan, memory)
    with pytest.raises(PortError, match=r"sensor imu cannot be opened: port /dev/no_imu not found; "):
        child.ready()
    assert child.process.wait(DEADLINE_S) == 1
    child.kill()


STUBBORN = """\
from contextlib import suppress
from time import sleep
from dxlrun import CONTRACT_VERSION, Sensor, hookimpl

class Stubborn(Sensor):
    @classmethod
    def states(cls, parameters):
        return ("range",)

    def read(self, values):
        return None

    def close(self):
        while True:
            with suppress(BaseException):
                sleep(100)

@hookimpl
def dxlrun_contract():
    return CONTRACT_VERSION

@hookimpl
def dxlrun_sensors():
    return {"stubborn": Stubborn}
"""


def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> Plan:
    """Return the plan of a robot with the sensor of a plug-in."""
    plugin_folder(tmp_path, "stubborn_sensors", text, "stubborn")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "stubborn_sensors", raising=False)
    return plan_with(tmp_path, "sensors:\n  sonar: {type: stubborn}\n")


CLOSES = STUBBORN.replace("while True", "import os; os.mkdir('closed')\n        while False")


@pytest.mark.parametrize(
    ("text", "code", "state"),
    [(CLOSES, 0, SlotState.ENDED), (STUBBORN, -signal.SIGALRM, SlotState.OPEN)],
    ids=["closes", "does not close"],
)
def test_a_driver_is_closed_and_ends_also_without_a_supervisor(tmp_path, monkeypatch, text, code, state):
    monkeypatch.chdir(tmp_path)
    plan = installed(tmp_path, monkeypatch, text)
    memory = create_memory(plan)
    child = start_only(plan, memory)
    try:
        child.ready()
        child.process.terminate()  # as the kernel does when the supervisor is gone
        assert child.process.wait(DEADLINE_S) == code
    finally:
        child.kill()
    assert SlotReader(mapped(memory.slots["sensors"][0])).state is state
    assert (tmp_path / "closed").exists() == (text is CLOSES)


SPOILS = """
    def read(self, values):
        if not hasattr(self, "child"):
            self.child = subprocess.Popen(["sleep", "1000"])
            for number in os.listdir("/proc/self/fd"):
                if "dxlrun-sensor" in os.readlink(f"/proc/self/fd/{number}"):
                    os.pwrite(int(number), b"\\xff" * 300, 0)
                    os.truncate(f"/proc/self/fd/{number}", 0)

    def unused(self):
"""


@pytest.mark.parametrize("killed", [False, True])
def test_a_sensor_that_spoils_its_memory_costs_only_itself_and_its_children_end(
    tmp_path, monkeypatch, killed
):
    before, body = STUBBORN.split("    def read(self, values):\n")
    text = "import os, subprocess\n" + before + SPOILS.lstrip("\n") + "        pass\n\n"
    plan = installed(
        tmp_path, monkeypatch, text + body.split("return None\n\n")[1].replace("while True", "if False")
    )
    memory = create_memory(plan)
    child = start_only(plan, memory)
    sensor = supervisor._SourceProcess(plan, only_process(plan), memory, child)
    child.ready()
    reader = SlotReader(mapped(memory.slots["sensors"][0]))
    until(lambda: child.process.poll() is not None or reader.state is SlotState.FAILED)
    restarted = child.process.poll() is not None
    (grandchild,) = map(
        int, Path(f"/proc/{child.process.pid}/task/{child.process.pid}/children").read_text().split()
    )
    pidfd = os.pidfd_open(grandchild)
    assert not restarted
    assert os.fstat(memory.slots["sensors"][0]).st_size >= slot.size(1)
    if killed:
        os.kill(child.process.pid, signal.SIGKILL)
        until(lambda: sensor.child is None, check=sensor.supervise_process)
        assert (reader.state, reader.read_text()[:18]) == (SlotState.ENDED, "its process exited")
    else:
        sensor.end_process()
    assert select.select([pidfd], [], [], DEADLINE_S)[0]
    os.close(pidfd)


FUTURE = STUBBORN.replace("return None", "values[:] = 1.0; return time.monotonic_ns() + 5_000_000_000")


def test_a_time_in_the_future_is_reported(tmp_path, monkeypatch):
    plan = installed(tmp_path, monkeypatch, "import time\n" + FUTURE)
    memory = slot.private(1)
    reader, writer = SlotReader(memory), slot.SlotWriter(memory)
    planned, context = only_process(plan), SourceContext(load_plugins(), writer, time.monotonic_ns, None)
    sampled = planned.stage.build(planned.process.plan, context)
    sampled.open_first()
    for _ in range(2):
        assert sampled.sample()
    assert (reader.read_sample() or 1 << 62) <= time.monotonic_ns()
    assert re.fullmatch(
        r"its timestamps are [45]\d\d\d ms in the future; arrival times are used", reader.read_text()
    )
