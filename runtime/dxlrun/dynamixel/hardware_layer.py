"""Hardware layers: convert between the joints of the loop and the servos, for example where several servos
move one joint.

A layer converts the goals of the layer above into arrays of its own for the layer below, and, if it changes
them, states in the other direction. Without layers the servos' hardware uses the arrays of the loop.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Commands, States
from dxlrun.channels.event_records import EventSink
from dxlrun.contract.hardware import Hardware
from dxlrun.features import stages
from dxlrun.plan.loop_plan import ServoLimit
from dxlrun.plan.robot_plan import Plan


class HardwareLayer:
    """Base class of layers: forwards every call to the hardware below.

    A subclass overrides the methods whose behaviour it changes. A layer that converts only goals needs
    `start`, after which the goals below equal the present positions, `write_goals` and `follow_goals`.
    """

    def __init__(self, hardware: Hardware) -> None:
        self._hardware = hardware

    def start(self, engaging: Callable[[], None] = lambda: None) -> None:
        """Check the servos and switch their torque on at the present positions; `engaging` is called before
        any gets torque.
        """
        self._hardware.start(engaging)

    @property
    def servo_limits(self) -> Mapping[int, Sequence[ServoLimit]]:
        """Registers that limit the goals of each joint's servos, by row of the joint."""
        return self._hardware.servo_limits

    def read_states(self) -> None:
        """Read the servos' states into the state arrays."""
        self._hardware.read_states()

    def write_goals(self) -> None:
        """Send the goals in the goal arrays to the servos."""
        self._hardware.write_goals()

    def set_modes(self, modes: NDArray[np.uint8]) -> None:
        """Request operating modes for joints, shape (joints,); UNKNOWN keeps a joint's mode."""
        self._hardware.set_modes(modes)

    def write_register(
        self, row: int, item: str, value: int, done: Callable[[str, int | None], None]
    ) -> None:
        """Write a RAM item of a joint's servo; `done` receives the problem and the previous value."""
        self._hardware.write_register(row, item, value, done)

    def read_register(self, row: int, item: str, done: Callable[[str, int | None], None]) -> None:
        """Read an item of a joint's servo; `done` receives the problem and the value."""
        self._hardware.read_register(row, item, done)

    def switch_torque(self, row: int, on: bool, done: Callable[[str], None]) -> None:
        """Switch the torque of a joint on or off; `done` receives the problem, empty on success."""
        self._hardware.switch_torque(row, on, done)

    def follow_goals(self, rows: Sequence[int]) -> None:
        """Start sending goals to the joints of these rows, which were just given torque."""
        self._hardware.follow_goals(rows)

    def reboot_servo(self, row: int, done: Callable[[str], None]) -> None:
        """Reboot a joint's servo; `done` receives the problem, empty on success."""
        self._hardware.reboot_servo(row, done)

    def limit_torque(self, fraction: float) -> None:
        """Limit the torque of every servo to a fraction (0 to 1) of its own limit."""
        self._hardware.limit_torque(fraction)

    def idle(self, until_ns: int, time_ns: int) -> None:
        """Execute waiting reads and writes of registers until the next cycle starts at `until_ns`."""
        self._hardware.idle(until_ns, time_ns)

    def stop(self) -> tuple[str, ...]:
        """Switch torque off on every servo; return a sentence for each failure."""
        return self._hardware.stop()

    def leave_torque_on(self) -> None:
        """End the exchange but leave the servos' torque on."""
        self._hardware.leave_torque_on()


class PreparedLayer(msgspec.Struct, frozen=True):
    """A layer that a robot needs, with its arrays and the function that creates it once the hardware below
    exists.
    """

    states: States
    """State arrays that the hardware below the layer fills."""
    goals: Commands
    """Goal arrays that the hardware below the layer sends."""
    build: Callable[[Hardware], Hardware]
    """Creates the layer; the argument is the hardware below."""
    refusals: Callable[[], Sequence[str]] | None = None
    """Returns the reasons to refuse the start at the present positions, one sentence each; None: no check."""


class LayerStage(msgspec.Struct, frozen=True):
    """`STAGE` in a feature's file `layer.py`: called when a robot is assembled, before the hardware of its
    servos is built.

    The stages are called in the order of their features: the first is next to the loop, the last next to the
    servos. `prepare` receives the arrays of the layer above. It returns None if the plan does not need its
    layer.
    """

    FILE: ClassVar[str] = "layer"

    prepare: Callable[[Plan, States, Commands, EventSink], PreparedLayer | None]
    to_servos: bool = False
    """True if the arrays below have a row per servo and those above a row per joint. This one is placed
    below all others.
    """


class HardwareLayers:
    """The layers that a robot needs; `states` and `goals` are the arrays below the lowest layer, for the
    servos' hardware.
    """

    def __init__(self, plan: Plan, states: States, goals: Commands, events: EventSink) -> None:
        self.states = states
        self.goals = goals
        self._layers: list[PreparedLayer] = []
        found = (stage for _, stage in stages(LayerStage, plan.features))
        for stage in sorted(found, key=lambda stage: stage.to_servos):
            layer = stage.prepare(plan, self.states, self.goals, events)
            if layer is not None:
                self._layers.append(layer)
                self.states, self.goals = layer.states, layer.goals

    @property
    def refusals(self) -> Callable[[], Sequence[str]] | None:
        """Function that returns the reasons of all layers to refuse the start, from the lowest layer up;
        None: no layer checks.
        """
        checks = [one.refusals for one in reversed(self._layers) if one.refusals is not None]
        return (lambda: [text for check in checks for text in check()]) if checks else None

    def build(self, hardware: Hardware) -> Hardware:
        """Put the layers above the servos' hardware and return the top one; without layers return the
        hardware unchanged.
        """
        for layer in reversed(self._layers):
            hardware = layer.build(hardware)
        return hardware
