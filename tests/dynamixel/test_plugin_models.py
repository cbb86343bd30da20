"""Servo models that a plug-in brings along: found by every process of a run, refused in one sentence."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.kit.answers import result_of

import dxlwire.control_table
import dxlwire.control_table.device_models
import dxlwire.control_table.servo_models
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.log.log_reader import read_log
from dxlwire.control_table import added_control_tables, find_table

pytestmark = pytest.mark.long

TABLES = Path(dxlwire.control_table.__file__).parent / "tables"
PLUGIN = """
from pathlib import Path
from dxlrun import hookimpl

@hookimpl
def dxlrun_contract():
    return 1

@hookimpl
def dxlrun_servo_models():
    return OFFER
"""

ROBOT = """\
name: foreign_servo
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000, adapter: {latency: 0 ms}}
loop: {rate: 50}
joints:
  elbow: {bus: main, id: 1, model: Mine-1, reference: 150 deg, direction: 1}
controllers:
  states: {type: joint_state_broadcaster}
"""

MAIN = "import sys; from dxlrun.cli import main; sys.exit(main(sys.argv[1:]))"


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """The data file of a servo that dxlrun does not know."""
    text = (TABLES / "protocol1" / "AX-12A.toml").read_text("utf-8")
    text = text.replace('model = "AX-12A"', 'model = "Mine-1"').replace('["AX-12", "AX-12+"]', "[]")
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("model_number = 12\n", "model_number = 60001\n"))
    return path


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Return a function that installs a plug-in which returns an expression as its servo models."""
    monkeypatch.setattr(dxlwire.control_table.servo_models, "_ADDED", {1.0: [], 2.0: []})
    monkeypatch.setattr(dxlwire.control_table.servo_models, "_TEXTS", {})
    monkeypatch.setattr(dxlwire.control_table.device_models, "_ADDED", [])
    monkeypatch.syspath_prepend(tmp_path)

    def put(offer: str) -> None:
        (tmp_path / "my_servos.py").write_text(PLUGIN.replace("OFFER", offer))
        info = tmp_path / "my_servos-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-servos\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text("[dxlrun]\nmy_servos = my_servos\n")

    yield put
    sys.modules.pop("my_servos", None)


@pytest.mark.parametrize("as_text", [False, True])
def test_a_table_is_taken_as_a_path_or_as_a_text(install, table, as_text):
    install(f"[{table.read_text()!r}]" if as_text else f"[Path({str(table)!r})]")
    assert load_plugins().broken == {}
    found = find_table("Mine-1", 1.0)
    assert (found.model_number, found.max_tick) == (60001, 1023)
    assert found.items["model_number"].initial == 60001
    assert added_control_tables(["AX-12A", "Mine-1", "Mine-1"]) == (table.read_text(),)
    assert load_plugins().broken == {}, "a process may load its plug-ins twice"


@pytest.mark.parametrize(
    ("offer", "told"),
    [
        ('"model = 1"', "does not return a list from dxlrun_servo_models"),
        ("[5]", "offers the servo model 5; it must be a TOML text or the path of a file"),
        ('[Path("/nowhere.toml")]', "an unusable servo model (/nowhere.toml) (FileNotFoundError"),
        ('["model = "]', "an unusable servo model (TOMLDecodeError"),
        ('["model = 1"]', "an unusable servo model (ValueError: the entry 'items' is missing)"),
        ("[TAKEN]", "is already used by the AX-12A"),
    ],
)  # fmt: skip
def test_a_servo_model_that_cannot_be_used_is_told_in_one_sentence(install, table, offer, told):
    taken = repr(table.read_text().replace("model_number = 60001", "model_number = 12"))
    install(offer.replace("TAKEN", taken))
    sentence = load_plugins().broken["my_servos"]
    assert sentence.startswith("plug-in my_servos of my-servos 1.0 ")
    assert told in sentence
    assert "\n" not in sentence


@pytest.fixture
def dxlrun_here(tmp_path: Path) -> Callable[..., str]:
    """Return a function that runs the program where the plug-in is installed; it returns its output."""

    def run(*words: str) -> str:
        ran = subprocess.run(
            [sys.executable, "-c", MAIN, *words],
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode == 0, ran.stdout + ran.stderr
        return ran.stdout

    return run


@pytest.mark.parametrize("words", [[], ["--virtual"]], ids=["processes", "virtual"])
def test_a_robot_of_foreign_servos_runs_in_simulation_and_its_model_is_listed(
    install, table, tmp_path, dxlrun_here, words
):
    install(f"[Path({str(table)!r})]")
    (tmp_path / "robot.yaml").write_text(ROBOT)
    dxlrun_here("robot.yaml", "--duration", "0.2", "--no-record", "--no-gateway", *words)
    if words:
        (told,) = result_of(dxlrun_here("models", "Mine-1", "--json"))
        assert told["model_number"] == 60001


BOARD = """
kind = "device"
model = "Theirs-1"
model_number = 60002
protocol = 1.0
cyclic = ["heat"]
items.heat = {address = 30, size = 1, tick = "1 degC", state = "temperature"}
"""


def test_a_robot_with_a_device_of_a_plug_in_runs_in_simulation(install, tmp_path, dxlrun_here):
    install(f"[{BOARD!r}]")
    device = "devices: {oven: {bus: main, id: 7, model: theirs-1}}\n"
    (tmp_path / "robot.yaml").write_text(ROBOT.replace("Mine-1", "AX-12A") + device)
    dxlrun_here("robot.yaml", "--duration", "0.3", "--no-gateway")
    (log,) = (tmp_path / "logs").glob("*.mcap")
    last = read_log(log).cycles["source_state"][-1]
    assert last.tolist() == [25.0]
    taken = BOARD.replace("60002", "12")
    with pytest.raises(ValueError, match="model number 12 of Theirs-1 is already used by the servo AX-12A"):
        dxlwire.control_table.device_models.add_device_table(taken)
