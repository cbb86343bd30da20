"""serial_imu over a pseudo-terminal, and the page of sensors."""

import json
import math
import os
import pty
import re
import shutil
import sys
import time
import tty
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import msgspec
import numpy as np
import pytest
from tests.kit.pages import page_text

from dxlrun import SensorContext
from dxlrun.channels import slot
from dxlrun.channels.slot import SlotReader, SlotState, SlotWriter
from dxlrun.cli import main
from dxlrun.cli.examples import schema_text
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.control.sampled_sources import SourceContext
from dxlrun.features.sensors.offer import sensor_breach
from dxlrun.features.sensors.plan import SensorPlan
from dxlrun.features.sensors.process import build_sampled_sensor
from dxlrun_controllers.sensors.serial_imu import SerialImu, SerialImuParameters, checked

LINE = b"0.5,-0.25,9.75,1,2,-3\n"


@dataclass
class Device:
    """The unit's end of a serial line, under a name that stays."""

    name: Path
    said: list[str] = field(default_factory=list)
    end: int = -1

    def plug(self) -> None:
        self.end, other = pty.openpty()
        tty.setraw(other)
        self.name.unlink(missing_ok=True)
        self.name.symlink_to(os.ttyname(other))
        self.held = other  # so that bytes written before it is opened stay

    def pull(self) -> None:
        os.close(self.end)
        os.close(self.held)
        self.end = -1

    def send(self, data: bytes) -> None:
        os.write(self.end, data)

    def sensor(self, **keys: object) -> SerialImu:
        imu = SerialImu(SerialImuParameters.model_validate({"port": str(self.name), **keys}))
        imu.open(SensorContext("imu", 10_000_000, time.monotonic_ns, self.said.append))
        self.send(b"half a li")
        self.send(b"ne\n")
        while not imu._begun:  # what was sent arrives in one piece or in two
            sample(imu)
        return imu


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    device = Device(tmp_path / "imu")
    device.plug()
    yield device
    if device.end >= 0:
        device.pull()


def sample(imu: SerialImu) -> list[float] | None:
    values = np.full(len(imu.states(imu.parameters)), np.nan)
    before = time.monotonic_ns()
    t_ns = imu.read(values)
    if t_ns is None:
        return None
    assert before <= t_ns <= time.monotonic_ns()
    return values.tolist()


def test_a_line_is_a_sample_and_the_first_one_is_not_trusted(device):
    imu = device.sensor()
    device.send(LINE)
    assert sample(imu) == [0.5, -0.25, 9.75, 1.0, 2.0, -3.0]
    assert imu.states(imu.parameters)[5] == "angular_velocity.z"
    device.send(LINE[:9])
    assert sample(imu) is None
    device.send(LINE[9:])
    assert sample(imu) == [0.5, -0.25, 9.75, 1.0, 2.0, -3.0]
    device.send(b"1 1 1 1 1 1\r\n2 2 2 2 2 2\r\n3 3 3")
    assert sample(imu) == [2.0] * 6  # the newest whole one
    assert device.said == []
    imu.close()


def test_columns_scale_and_prefix(device):
    keys = {
        "columns": ["-", "angular_velocity.z", "linear_acceleration.x"],
        "scale": {"linear_acceleration": 9.80665},
        "prefix": "$IMU,",
    }
    imu = device.sensor(**keys)
    device.send(b"$IMU,12:30,0.5,2\n$GPS,1,2,3\n$IMU,0,0.5,-\n")
    assert imu.states(imu.parameters) == ("angular_velocity.z", "linear_acceleration.x")
    assert sample(imu) == [0.5, 2 * 9.80665]
    assert device.said == ["2 lines are not a sample of 3 numbers; last line: $IMU,0,0.5,-"]
    imu.close()


@pytest.mark.parametrize(
    "garbage", [b"\xff\xfe\x00\n", b"1,2,3\n", b"1,2,3,4,5,six\n", b"1,2,3,4,5,6,7\n", b"x" * 5000]
)
def test_garbage_is_reported_and_not_used(device, garbage):
    imu = device.sensor()
    device.send(LINE)
    sample(imu)
    for start in range(0, len(garbage), 2000):
        device.send(garbage[start : start + 2000])
        assert sample(imu) is None
    assert len(device.said) == 1
    assert "a sample of 6 numbers" in device.said[0]
    assert len(device.said[0]) < 300
    device.send(b"\n" + LINE)
    assert sample(imu) is not None
    for _ in range(5):
        device.send(garbage[:100].replace(b"x", b"y") + b"\n")
        sample(imu)
    assert len(device.said) == 1  # once a second at most
    imu.close()


def test_checksums_are_those_of_nmea(device):
    # a sentence of NMEA 0183 as its description has it
    assert checked(b"$GPGLL,5300.97914,N,00259.98174,E,125926,A*28") is not None
    assert checked(b"$GPGLL,5300.97914,N,00259.98174,E,125926,A*29") is None
    assert checked(b"no star") is None
    assert checked(b"1,2*") is None
    imu = device.sensor(columns=["angular_velocity.x"], checksum=True, prefix="$")
    device.send(b"$1*31\n")
    assert sample(imu) == [1.0]
    device.send(b"$2*31\n")
    assert sample(imu) is None
    imu.close()


def test_a_nan_is_a_sample_for_the_loop_to_judge(device):
    imu = device.sensor()
    device.send(b"nan,0,0,0,0,inf\n")
    found = sample(imu)
    assert found is not None
    assert math.isnan(found[0])
    assert math.isinf(found[5])
    imu.close()


def test_a_port_in_use_is_refused(device):
    imu = device.sensor()
    with pytest.raises(OSError, match="is in use by"):
        device.sensor()
    imu.close()


def test_pulled_and_plugged_in_again_it_goes_on(device, monkeypatch):
    now_ns = time.monotonic_ns
    ahead_ns = 0
    parameters = json.dumps({"port": str(device.name)})
    plan = SensorPlan("imu", "serial_imu", "", parameters, (), 10_000_000, 50_000_000)
    memory = slot.private(6)
    reader = SlotReader(memory)
    context = SourceContext(load_plugins(), SlotWriter(memory), lambda: now_ns() + ahead_ns, None)
    sampled = build_sampled_sensor(msgspec.json.encode(plan), context)
    sampled.open_first()
    device.send(b"\n" + LINE)
    assert sampled.sample()
    assert (reader.read_sample() is not None, reader.state) == (True, SlotState.OPEN)
    device.pull()
    assert not sampled.sample()
    assert (reader.state, sampled.is_open) == (SlotState.FAILED, False)
    assert reader.read_text() == f"{device.name} is gone"
    ahead_ns += 500_000_000
    assert not sampled.sample()
    assert reader.read_text() == ""  # not asked again yet
    ahead_ns += 600_000_000
    assert not sampled.sample()
    assert f"port {device.name} not found" in reader.read_text()
    device.plug()
    ahead_ns += 1_100_000_000
    device.send(b"\n" + LINE)
    sampled.sample()
    assert (reader.state, reader.read_text()) == (SlotState.OPEN, "is open again")
    device.send(b"\n" + LINE)
    assert sampled.sample()
    assert reader.read_sample() is not None
    sampled.close()


ROOT = Path(__file__).parents[2]
PAGE = page_text("sensors.md")
COMMANDS = [line.strip() for line in PAGE.splitlines() if line.startswith("    dxlrun ")]


def test_its_commands_end_well(tmp_path, monkeypatch, capsys):
    shutil.copy(ROOT / "robots/bioloid_torso.yaml", tmp_path)
    (tmp_path / "urdf").symlink_to(ROOT / "robots/urdf")
    (robot,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "torso_imu.yaml").write_text(robot)
    monkeypatch.chdir(tmp_path)
    check, virtual, processes = COMMANDS
    assert main(check.split()[1:]) == 0
    assert "simulated_imu  dxlrun" in capsys.readouterr().out
    assert main(virtual.split()[1:]) == 0
    assert processes == "dxlrun torso_imu.yaml --duration 2 --no-gateway"  # tests/run has such a run


def test_it_has_the_table_of_keys_of_every_sensor():
    parts = {name for name in json.loads(schema_text("robot"))["$defs"] if name.startswith("sensor.")}
    assert len(parts) >= 5
    assert set(re.findall(r"^<!-- keys: (\S+) -->$", PAGE, re.MULTILINE)) == parts


def test_its_sensor_is_one(tmp_path, monkeypatch):
    (source,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    zone = tmp_path / "thermal_zone0"
    zone.mkdir()
    (zone / "temp").write_text("41500\n")
    module = ModuleType("page_of_sensors")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # where pydantic looks up names
    exec(source.replace("/sys/class/thermal", str(tmp_path)), module.__dict__)  # noqa: S102  (it is our page)
    (kind,) = module.dxlrun_sensors().values()
    assert sensor_breach(kind) is None
    sensor = kind(kind.Parameters())
    sensor.open(SensorContext("cpu", 1_000_000_000, lambda: 7, lambda text: None))
    values = np.full(1, np.nan)
    assert (sensor.read(values), values.tolist()) == (7, [41.5])
    sensor.close()
