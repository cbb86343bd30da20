"""The section `lights` (add-a-section.md) on virtual time; the LED registers of the servos judge it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from dxlrun import InputError, RemoteRobot
from dxlrun.testing import installed, plan_of, read_log, simulated_robot
from dxlrun.tooling.output import show_parts
from dxlrun.tooling.runs import VirtualLink
from dxlrun_lights import table
from dxlsim import SimulatedBus

PROJECT = Path(__file__).parents[1]
ROBOT = PROJECT / "lights.yaml"
LIGHTS = "lights:\n  left: {joint: pan_joint}\n  right: {joint: tilt_joint}\n"
LED = 25  # AX-12A


@pytest.fixture(autouse=True)
def with_lights() -> Iterator[None]:
    """Let dxlrun find the package, whether it is installed or not."""
    with installed(PROJECT):
        yield


class Run:
    """A robot on virtual time, with a client."""

    def __init__(self, file: Path = ROBOT, log: Path | None = None) -> None:
        self.link = VirtualLink(plan_of(file), log=log)
        self.bus: SimulatedBus = self.link.simulated.buses[0]
        self._robot = RemoteRobot(self.link.name, self.link)

    def send(self, **values: float) -> None:
        command = {"values": {f"lights/{name}": value for name, value in values.items()}}
        self._robot.send("lamps", "device_commands", command)

    def run(self, duration_s: float) -> None:
        end_s = self.link.now_s + duration_s
        while self.link.now_s < end_s:
            self.link.run_cycle()

    def leds(self) -> list[int]:
        return [servo.registers["led"] for servo in self.bus.servos]

    def writes(self) -> int:
        """Return how many writes of LEDs the servos received."""
        return sum(bytes([4, 3, LED]) in entry.data for entry in self.link.simulated.ledger.entries)


@pytest.fixture
def run() -> Iterator[Run]:
    made = Run()
    yield made
    made.link.close()


def written(path: Path, lights: str) -> Path:
    """Return a robot file with another section `lights`."""
    file = path / "robot.yaml"
    file.write_text(ROBOT.read_text().replace(LIGHTS, lights))
    return file


def test_light_follows_its_command_and_is_written_only_when_that_changes(run: Run) -> None:
    run.send(left=1.0)
    run.run(0.2)
    assert run.leds() == [1, 0]
    run.send(left=0.0, right=1.0)
    run.run(0.2)
    assert run.leds() == [0, 1]
    writes = run.writes()
    run.run(3.0)
    assert run.writes() == writes


def test_led_that_was_lit_before_the_run_is_switched_off() -> None:
    robot = simulated_robot(ROBOT, duration_s=1.0)
    registers, seen = robot.buses[0].servo(1).registers, list[int]()
    registers["led"] = 1
    for t_ns in (0, 900_000_000):
        robot.buses[0].at(t_ns, lambda: seen.append(registers["led"]))
    robot.run()
    assert seen == [1, 0]


def test_rebooted_servo_lights_its_led_again(run: Run) -> None:
    run.send(left=1.0, right=1.0)
    run.run(0.2)
    run.bus.servo(1).cut_power(run.link.simulated.clock.now_ns() + 300_000_000)
    run.run(0.1)
    assert run.leds() == [0, 1]
    run.run(2.0)
    assert run.leds() == [1, 1]


def test_lost_write_is_repeated_after_a_second(run: Run) -> None:
    run.run(0.2)
    writes = run.writes()
    lost: list[bytes] = []

    def lose_write(data: bytes) -> bytes:
        lost.append(data)
        return b"" if bytes([4, 3, LED]) in data else data

    run.send(left=1.0)
    for _ in range(20):
        if not any(bytes([4, 3, LED]) in data for data in lost):
            run.bus.alter_next_instruction("loses a write of an LED", lose_write)
            run.run(0.001)
    run.run(0.5)
    assert (run.leds(), run.writes() - writes) == ([0, 0], 1)
    run.run(1.0)
    assert (run.leds(), run.writes() - writes) == ([1, 0], 2)


def test_lights_are_off_at_the_end_and_other_leds_stay(tmp_path: Path) -> None:
    file = written(tmp_path, "lights:\n  left: {joint: pan_joint}\n")
    file.write_text(file.read_text().replace(", lights/right", ""))
    run = Run(file)
    run.bus.servo(2).registers["led"] = 1
    run.send(left=1.0)
    run.run(0.2)
    assert run.leds() == [1, 1]
    run.link.close()
    assert run.leds() == [0, 1]


def test_first_servo_of_a_joint_of_several_has_the_light(tmp_path: Path) -> None:
    file = tmp_path / "several.yaml"
    file.write_text(
        "name: several\n"
        "buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}\n"
        "loop: {rate: 50}\n"
        "joints:\n"
        "  knee: {bus: main, model: XL430-W250, reference: 180 deg, direction: 1, "
        "servos: [{id: 1}, {id: 2, direction: -1}]}\n"
        "lights: {knee: {joint: knee}}\n"
        "controllers:\n  lamps: {type: device_command_controller, commands: [lights/knee]}\n"
    )
    run = Run(file)
    run.send(knee=1.0)
    run.run(0.2)
    assert run.leds() == [1, 0]
    run.link.close()
    assert run.leds() == [0, 0]


def test_light_that_is_not_confirmed_off_is_a_warning_and_the_log_has_its_command(tmp_path: Path) -> None:
    log = tmp_path / "silent.mcap"
    run = Run(log=log)
    run.send(left=1.0)
    run.run(0.2)
    run.bus.servo(1).silence()
    run.run(0.1)
    run.link.close()
    read = read_log(log)
    texts = [event.text for event in read.events if event.text.startswith("light ")]
    assert texts == ["light left (ID 1 on bus main) may still be on: no answer"]
    assert read.cycles["device_command"][-1][0] == 1.0


def test_plan_names_the_package() -> None:
    plan = plan_of(ROBOT)
    assert plan.features[-1].name == "lights"
    assert plan.packages["dxlrun_lights"] == "dxlrun-lights"
    assert plan.loop.source_commands == ("lights/left", "lights/right")


def test_check_lists_the_lights(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    rows = list(table.STAGE.rows(plan_of(ROBOT)))
    assert rows[0] == {"name": "left", "joint": "pan_joint", "bus": "main", "id": 1}
    show_parts(table.STAGE.table(rows))
    out = capsys.readouterr().out
    assert "Lights" in out
    assert "left   pan_joint   main   1" in out


@pytest.mark.parametrize(
    ("lights", "message"),
    [
        (
            "lights: {left: {joint: pan}}\n",
            "light left: pan is not a joint; known: pan_joint, tilt_joint",
        ),
        ("lights: {left: {}}\n", "lights.left has no joint"),
        (
            "lights: {left: {joint: pan_joint}, right: {joint: pan_joint}}\n",
            "light right: light left already uses the LED of pan_joint; name another joint",
        ),
    ],
)
def test_mistake_is_named(tmp_path: Path, lights: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        plan_of(written(tmp_path, lights))
    found = [f"{problem.what}; {problem.fix}" for problem in error.value.problems]
    assert any(message in each for each in found), found


def test_robot_without_the_section_does_not_use_the_feature(tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(ROBOT.read_text().replace(LIGHTS, "").partition("controllers:")[0])
    plan = plan_of(file)
    assert "lights" not in [feature.name for feature in plan.features]
    assert "dxlrun_lights" not in plan.packages
