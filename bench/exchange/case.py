"""A case to be measured: a bus of equal servos, as in a robot file, and the registers of an exchange."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from msgspec import structs

from dxlrun.compile.robot_compiler import compile_robot
from dxlrun.compile.simulation import simulation_of
from dxlrun.description.reading import Description, read_robot
from dxlrun.plan.robot_plan import Plan
from dxlsim.simulation_plan import BusConfig

MODELS = {1.0: "AX-12A", 2.0: "XM430-W350"}
"""Protocol -> model of the servos of a case."""
NO_WIRE = 10_000_000_000
"""bit/s at which a byte takes no time: the canned responder has no wire."""
BUS = "main"


@dataclass(frozen=True, slots=True)
class Case:
    """So many servos of one model on one bus of one protocol."""

    protocol: float
    servos: int
    baud_rate: int = 1_000_000
    """bit/s, of the line; the canned responder has none, and the plan is then made for a line without."""

    @property
    def model(self) -> str:
        """The servos' model."""
        return MODELS[self.protocol]

    @property
    def ids(self) -> tuple[int, ...]:
        """The servos' IDs."""
        return tuple(range(1, self.servos + 1))

    def plan(self, *, wire: bool) -> Plan:
        """Compile the case; without a wire every byte of it takes no time."""
        with tempfile.TemporaryDirectory(prefix="dxlrun-bench-") as folder:
            path = Path(folder) / "bench.yaml"
            path.write_text(self.robot_file(), encoding="utf-8")
            description = read_robot(path, {})
        return compile_robot(description if wire else _without_wire(description), []).plan

    def simulated(self, name: str) -> BusConfig:
        """Return the bus with its servos, for a simulation, under a name."""
        (bus,) = simulation_of(self.plan(wire=True)).buses
        return structs.replace(bus, name=name)

    def robot_file(self) -> str:
        """Return the robot file of the case."""
        joints = "".join(
            f"  joint_{each}: {{bus: {BUS}, id: {each}, model: {self.model}, reference: 150 deg, "
            "direction: 1, limits: {position: [-90 deg, 90 deg]}}\n"
            for each in self.ids
        )
        # hosts take turns, so one host is silent for longer than a watchdog waits
        watchdog = ", bus_watchdog: 0 ms" if self.protocol == 2.0 else ""
        return (
            "name: bench\n"
            f"buses: {{{BUS}: {{port: sim, protocol: {self.protocol:.1f}, baud_rate: {self.baud_rate}, "
            f"adapter: {{latency: 0 ms}}, return_delay_time: 0 us{watchdog}}}}}\n"
            "loop: {rate: 10}\n"
            f"joints:\n{joints}"
            "controllers: {joint_state_broadcaster: {type: joint_state_broadcaster, rate: 10}}\n"
        )


@dataclass(frozen=True, slots=True)
class Registers:
    """What an exchange reads of each servo and writes to it; the same for every host."""

    read_address: int
    read_length: int
    values: tuple[tuple[int, int], ...]
    """Offset and size in what is read: position, velocity, effort."""
    write_address: int
    write_length: int
    goal: tuple[int, int]
    """Offset and size of the goal position in what is written; the rest is 0, as fast as the servo can."""
    ticks: tuple[int, int]
    """Two goals in turn, so that every exchange writes something new."""

    @classmethod
    def of(cls, plan: Plan) -> Registers:
        """Return what our plan reads and writes."""
        servo = plan.buses[0].servos[0]
        state, goal = servo.state, servo.goal
        position = goal.position
        assert position is not None  # no controller commands the joints of a case: they hold positions
        middle = (servo.lower_tick + servo.upper_tick) // 2
        return cls(
            read_address=state.address,
            read_length=state.length,
            values=tuple((each.offset, each.size) for each in (state.position, state.velocity, state.effort)),
            write_address=goal.address,
            write_length=goal.length,
            goal=(position.offset, position.size),
            ticks=(middle, middle + 1),
        )


def _without_wire(description: Description) -> Description:
    """Return the description with a line on which no byte takes time; no file may say such a rate."""
    robot = description.robot
    buses = {name: bus.model_copy(update={"baud_rate": NO_WIRE}) for name, bus in robot.buses.items()}
    return structs.replace(description, robot=robot.model_copy(update={"buses": buses}))
