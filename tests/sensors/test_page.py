"""sensors.md, typed as it stands."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
from tests.kit.pages import page_text

from dxlrun import SensorContext
from dxlrun.cli import main
from dxlrun.cli.examples import schema_text
from dxlrun.features.sensors.offer import sensor_breach

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
