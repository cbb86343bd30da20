"""A sensor stops, sends NaN, its process is killed: what the loop's end of its slot makes of it.

CI does it with the sensor's own process only; with all processes of a run, judged by its log and its servos:

    DXLRUN_SENSOR_RUNS=5 python -m pytest tests/run/test_sensors.py -q
"""

from __future__ import annotations

import os
import pty
import signal
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dxlrun.control.sensors.readings import Readings
from dxlrun.errors import PortError
from dxlrun.run import sensor_process, supervisor
from dxlrun.run.channels import slot
from dxlrun.run.channels.cycle import CycleRecord
from dxlrun.run.channels.events import EventCode
from dxlrun.run.run_processes import create_memory, start_sensor
from dxlrun.testing import plan_of

Start = Callable[..., Any]
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
        self.line: bytes | None = b"0.25,9.81\n"
        self._other = other
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._send)
        self._thread.start()

    def _send(self) -> None:
        while not self._stop.wait(PERIOD_S):
            if (line := self.line) is not None:
                with suppress(BlockingIOError):
                    os.write(self._end, line)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._end)
        os.close(self._other)


@pytest.fixture
def unit() -> Iterator[Unit]:
    unit = Unit()
    yield unit
    unit.close()


def sensor_of(run: Any, port: str) -> int | None:
    """Return the process that has the unit's port open."""
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if run.mark.encode() not in (path / "environ").read_bytes():
                continue
            if b"run.sensor_process" in (path / "cmdline").read_bytes() and port in {
                os.readlink(each) for each in (path / "fd").iterdir()
            }:
                return int(path.name)
    return None


def test_a_sensor_that_dies_sends_nan_or_stops_and_comes_back(
    tmp_path: Path, unit: Unit, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "_RESTART_S", 0.1)
    robot = tmp_path / "one.yaml"
    robot.write_text(ROBOT + SENSORS.format(port=unit.port))
    plan = plan_of(robot)
    memory, record, events = create_memory(plan), CycleRecord(plan.loop.layout), []

    class Sink:
        def emit(self, code: EventCode, severity: object, source: str, text: str) -> None:
            events.append(text.removeprefix("sensor imu").lstrip(": "))

    slots = [slot.shared(descriptor) for descriptor in memory.sensors]
    readings = Readings(plan.loop, slots, record, time.monotonic_ns, Sink())
    sensor = supervisor._SensorProcess(plan, 0, memory, start_sensor(plan, 0, memory))

    def read_until(valid: bool, *, value: float = 0.25) -> None:
        give_up = time.monotonic() + 60
        while True:
            sensor.look()
            readings.read()
            assert time.monotonic() < give_up, events
            time.sleep(0.01)
            if record.sources.valid[0] == valid and record.sources.values[0] == value:
                return

    try:
        sensor.child.ready()
        read_until(True)
        os.kill(sensor.child.process.pid, signal.SIGKILL)
        read_until(False)
        assert record.sources.age_ns[0] < 1_000_000_000  # at once, not by its timeout
        unit.line = b"0.5,9.81\n"
        read_until(True, value=0.5)
        unit.line = b"nan,9.81\n"
        read_until(False, value=0.5)
        unit.line = b"0.75,9.81\n"
        read_until(True, value=0.75)
        unit.line = None
        read_until(False, value=0.75)
        assert record.sources.age_ns[0] > 1_000_000_000
        began = time.monotonic()
        process = sensor.child.process
    finally:
        sensor.end()
    assert process.returncode == 0  # it closed its device in time
    assert time.monotonic() - began < sensor_process.END_S
    assert events[:5] == [
        "its process ended (signal SIGKILL), another one is started",
        "is gone; its values are not valid",
        "brings samples again",
        "angular_velocity.z is nan; its values are not used",
        "brings samples again",
    ]
    assert len(events) == 6
    assert events[5].startswith("brought no sample for 1")


@pytest.mark.campaign
@pytest.mark.parametrize("number", range(int(os.environ.get("DXLRUN_SENSOR_RUNS", "0"))))
def test_a_sensor_that_dies_sends_nan_or_stops_costs_the_run_nothing_but_its_row(
    start: Start, tmp_path: Path, unit: Unit, number: int
) -> None:
    def wait_for(look: Callable[[], Any]) -> Any:
        give_up = time.monotonic() + 60
        while not (found := look()):
            assert run.process.poll() is None, run.finish()
            assert time.monotonic() < give_up
            time.sleep(0.05)
        return found

    robot = tmp_path / "pair.yaml"
    text = robot.read_text().replace("name: pair", "name: pair_imu")
    robot.write_text(text + SENSORS.format(port=unit.port))
    run = start()
    run.wait_until_moving()
    first = wait_for(lambda: sensor_of(run, unit.port))
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: sensor_of(run, unit.port) not in {None, first})
    time.sleep(0.3)
    unit.line = b"nan,9.81\n"
    time.sleep(0.3)
    unit.line = b"0.5,9.81\n"
    time.sleep(0.3)
    unit.line = None
    time.sleep(1.5)
    run.signal(signal.SIGINT)
    code, out, err = run.finish()
    assert code == 1, out + err  # it is no good run: errors were logged
    assert "All 2 servos answered every time" in out
    assert run.gone()
    log = run.log()
    found = [(event.code, event.text) for event in log.events if event.source == "imu"]
    ended = "sensor imu: its process ended (signal SIGKILL), another one is started"
    nan = "sensor imu: angular_velocity.z is nan; its values are not used"
    expected = [
        (EventCode.SENSOR, ended),
        (EventCode.SENSOR_LOST, "sensor imu is gone; its values are not valid"),
        (EventCode.SENSOR_BACK, "sensor imu brings samples again"),
        (EventCode.SENSOR_LOST, nan),
        (EventCode.SENSOR_BACK, "sensor imu brings samples again"),
    ]
    assert found[:-1] == expected
    assert found[-1][0] == EventCode.SENSOR_LOST
    assert found[-1][1].startswith("sensor imu brought no sample for 1")
    cycles = log.cycles
    valid = cycles["source_valid"][:, 0]
    assert cycles["valid"].all()  # of the servos
    assert set(np.unique(cycles["source_state"][:, 0]).tolist()) == {0.25, 0.5}
    assert np.isfinite(cycles["source_state"]).all()
    assert valid[:20].any()
    assert not valid[-5:].any()
    assert cycles["source_age_ns"][-1, 0] > 1_000_000_000


def test_a_device_that_is_not_there_at_the_start_is_a_sentence(tmp_path: Path) -> None:
    """The supervisor then ends the run, as for a port that is not there."""
    robot = tmp_path / "pair.yaml"
    robot.write_text(ROBOT + "sensors:\n  imu: {type: serial_imu, port: /dev/no_imu}\n")
    plan = plan_of(robot)
    memory = create_memory(plan)
    child = start_sensor(plan, 0, memory)
    with pytest.raises(PortError, match=r"sensor imu cannot be opened: could not open port /dev/no_imu"):
        child.ready()
    assert child.process.wait(20) == 1
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


def test_a_driver_that_does_not_close_ends_also_without_a_supervisor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "stubborn-1.0.dist-info"
    info.mkdir()
    (tmp_path / "stubborn_sensors.py").write_text(STUBBORN)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stubborn\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[dxlrun]\nstubborn = stubborn_sensors\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    robot = tmp_path / "one.yaml"
    robot.write_text(ROBOT + "sensors:\n  sonar: {type: stubborn}\n")
    plan = plan_of(robot)
    child = start_sensor(plan, 0, create_memory(plan))
    try:
        child.ready()
        child.process.terminate()  # as the kernel does when the supervisor is gone
        assert child.process.wait(20) == -signal.SIGALRM
    finally:
        child.kill()
