"""Mechanics: motion of all servos of one simulation, stepped together on one time grid.

`mechanics.c` has the steps. Commands take effect at the next point of the grid; between grid points angles
are extrapolated with their velocity. Nothing is computed while all servos rest."""

from __future__ import annotations

import ctypes
import heapq
import math
from collections.abc import Callable
from functools import partial

import msgspec
import numpy as np

from dxlsim.motion.compiled_mechanics import AIM, SERVO, STRUCTS, StepResult, library
from dxlsim.motion.control_law import LIMP, ServoCommand
from dxlsim.motion.coupled_joints import CoupledJoints
from dxlsim.motion.link_motion import Shafts
from dxlsim.motion.motor import Motor
from dxlsim.motion.plant import Floats, IndependentJoints, Plant, PlantJoint, PlantMaker
from dxlsim.simulation_plan import Load, SimulationConfig

STEP_NS = 2_000_000
"""Step of the time grid, ns. The shortest time constant in a servo is that of its motor: 13.6 ms or more."""

STRAIN_NS = 100_000_000  # Interval at which heat and load are updated; a whole number of steps

AMBIENT_C = 30.0  # Temperature of a servo at rest, degrees C [i]

STALLED_RISE_C = 300.0
"""Steady-state temperature rise of a stalled servo, degrees C: with a time constant of 400 s the servo
reaches 80 after a minute [i]."""

COOLING_S = 400.0  # Time constant of housing and winding, modelled as one body [i]

OVERLOAD_PART = 0.8
"""Fraction of the torque allowed by the limit, above which the servo counts as overloaded [i]."""

OVERLOAD_TICKS = 10  # Tolerated duration in intervals of STRAIN_NS: a second [i]

_NEVER = 2**63 - 1
_AIMS = 64  # Room for goals that have not taken effect, at first
_COMMAND = [*ServoCommand._fields]

SUPPLY_OHM = 0.1  # Resistance of cable and connectors between supply and servo [i]


class _Hand(msgspec.Struct):
    speed: float  # rad/s
    steps: int  # remaining steps of the grid
    gives_way: Callable[[float], None]
    turned: float = 0.0  # rad so far


class Mechanics:
    """Shafts, controllers and temperatures of all servos of one simulation, stepped together; time comes
    from the callers, and an earlier time is ignored."""

    def __init__(self, start_ns: int, plant: PlantMaker | None = None) -> None:
        self._make_plant: PlantMaker = plant or IndependentJoints
        self._motors: list[Motor] = []
        self._loads: list[Load] = []
        self._recounted: list[float] = []
        self._watchers: dict[int, Callable[[], None]] = {}
        self._agenda: list[tuple[int, int, Callable[[], None]]] = []
        self._hands: dict[int, _Hand] = {}
        self._state = STRUCTS["Mechanics"](
            step_ns=STEP_NS,
            strain_step_ns=STRAIN_NS,
            start_ns=start_ns,
            grid_ns=start_ns,
            strain_ns=start_ns + STRAIN_NS,
            agenda_ns=_NEVER,
            step_s=STEP_NS * 1e-9,
            strain_part=STRAIN_NS * 1e-9 / COOLING_S,
            ambient_c=AMBIENT_C,
            stalled_rise_c=STALLED_RISE_C,
            overload_part=OVERLOAD_PART,
            overload_ticks=OVERLOAD_TICKS,
        )
        self._library = library()
        self._aims = np.zeros(0, dtype=AIM)
        self.address = ctypes.addressof(self._state)
        """Address of the struct `Mechanics` of mechanics.c."""
        self.servos = np.zeros(0, dtype=SERVO)
        """Struct `Servo` of mechanics.c for each servo: command, setpoint, torque (Nm), duty, temperature
        (degrees C)."""
        self._build(np.zeros(0), np.zeros(0))

    @property
    def grid_ns(self) -> int:
        """Time of the last step, ns."""
        grid_ns: int = self._state.grid_ns
        return grid_ns

    @property
    def still(self) -> bool:
        """True while all servos rest without new commands."""
        return bool(self._state.still)

    # Servos

    def add_servo(self, motor: Motor, load: Load, angle: float) -> int:
        """Add a servo at rest and limp, with its shaft at `angle`, rad from its raw 0; return the index by
        which other methods address it."""
        self._motors.append(motor)
        self._loads.append(load)
        self._recounted.append(0.0)
        added = np.zeros(1, dtype=SERVO)
        added[_COMMAND][0] = LIMP._replace(goal=angle)
        added["setpoint"], added["motor_damping"] = angle, motor.damping
        added["stall"] = added["nominal_stall"] = motor.stall_torque
        added["temperature"] = AMBIENT_C
        # The arrays of a plant have a fixed size, so it is rebuilt, and its state is copied.
        plant, self.servos = self.plant, np.append(self.servos, added)
        self._build(np.append(plant.angle, angle), np.append(plant.velocity, 0.0))
        self._wake()
        return len(self._motors) - 1

    def jam_shaft(self, index: int, on: bool) -> None:
        """Block a servo's shaft at its present angle, or release it."""
        self.plant.jam(index, on)
        self._wake()

    def motor(self, index: int) -> Motor:
        """Return the motor of a servo."""
        return self._motors[index]

    def watch_servo(self, index: int, act: Callable[[], None]) -> None:
        """Call `act` whenever a servo's temperature changes by a degree, and when it has been overloaded
        for too long."""
        self._watchers[index] = act

    def supply(self, index: int, volts: float) -> None:
        """Set a servo's supply voltage, V; its stall torque and no-load speed change in proportion."""
        motor = self._motors[index]
        self.servos["stall"][index] = motor.stall_torque * (volts / motor.voltage if motor.voltage else 1.0)
        self._wake()

    def command_servo(self, index: int, command: ServoCommand) -> None:
        """Give a servo's controller new parameters. Its trajectory continues from its setpoint, or from
        the shaft if it was limp."""
        servo = self.servos[index]
        was_limp, was_turning = servo["limit"] == 0.0, servo["turning"] != 0.0
        self._commands[index] = command
        if command.limit == 0.0:
            servo["goal"] = self.plant.angle[index]
        if was_limp or command.limit == 0.0 or was_turning != (command.turning != 0.0):
            servo["setpoint"] = self.plant.angle[index]
            servo["setpoint_velocity"] = self.plant.velocity[index] if command.turning else 0.0
            servo["integral"] = 0.0
        self._wake()

    def aim(self, index: int, goal: float, speed: float, acceleration: float) -> None:
        """Change only a servo's goal, rad, and the speed, rad/s, and acceleration, rad/s^2, of its
        trajectory."""
        self._library.motion_aim(self.address, index, goal, speed, acceleration)

    def follow_plan(self, shaft_address: int) -> None:
        """Let the trajectory that was planned for a `Shaft` of mechanics.c take effect after its response
        delay."""
        while not self._library.motion_follow(shaft_address):
            self._aims = np.resize(self._aims, 2 * len(self._aims) + _AIMS)
            self._state.aims, self._state.aim_room = self._aims.ctypes.data, len(self._aims)

    def withdraw(self, index: int) -> None:
        """Withdraw the trajectories of a servo that have not taken effect."""
        self._library.motion_withdraw(self.address, index)

    def move_shaft(self, index: int, angle: float) -> None:
        """Move a resting shaft to an angle, rad, at once; its trajectory begins there."""
        self.plant.place_shaft(index, angle)
        servo = self.servos[index]
        servo["setpoint"], servo["setpoint_velocity"] = angle, 0.0
        if servo["limit"] == 0.0:
            servo["goal"] = angle
        self._state.arrived = self._state.still = False

    def recount_turns(self, index: int, angle: float) -> None:
        """Stop a shaft, and change its count of turns so that its angle becomes `angle`, rad; its
        trajectory begins there."""
        turns = math.tau * round((angle - self.plant.angle.item(index)) / math.tau)
        if turns:
            self._recounted[index] += turns
            self.plant.shift_angle(index, turns)
        self.move_shaft(index, angle)

    def turn_shaft(self, index: int, by: float, duration_ns: int, gives_way: Callable[[float], None]) -> None:
        """Turn a servo's shaft as by hand, evenly by an angle, starting now.

        The hand lets go of a servo that drives or holds its shaft.

        Args:
            index: The servo.
            by: Angle, rad.
            duration_ns: Duration, ns.
            gives_way: Called when the hand lets go, with the angle turned until then, rad.
        """
        steps = max(1, round(duration_ns / STEP_NS))
        self._hands[index] = _Hand(by / (steps * STEP_NS * 1e-9), steps, gives_way)
        self._state.hands = len(self._hands)
        self._state.still = False

    def heat(self, index: int, celsius: float) -> None:
        """Set a servo's temperature, degrees C; it then approaches the temperature that its load causes."""
        self.servos["temperature"][index] = celsius
        self._state.calm = False

    def overloaded(self, index: int) -> bool:
        """Return True if a servo has been overloaded for OVERLOAD_TICKS or longer."""
        return bool(self.servos["overloaded"][index] >= OVERLOAD_TICKS)

    # For sensors on the bodies

    @property
    def acceleration(self) -> Floats:
        """Accelerations of the shafts in the last step, rad/s^2."""
        if self.still:
            return np.zeros(len(self._motors))
        return (self.plant.velocity - self._before) / (STEP_NS * 1e-9)

    def shafts(self, now_ns: int, count: int) -> Shafts:
        """Return the motion of the first `count` shafts at a time, extrapolated with their velocity
        between grid points."""
        self.step_to(now_ns)
        velocity = self.plant.velocity[:count].copy()
        angle = self.plant.angle[:count] + velocity * (max(0, now_ns - self.grid_ns) * 1e-9)
        return Shafts(now_ns, angle, velocity, self.acceleration[:count].copy())

    # Time

    def call_at(self, t_ns: int, action: Callable[[], None]) -> None:
        """Call `action` at the first grid point at or after `t_ns`."""
        heapq.heappush(self._agenda, (t_ns, self._state.order, action))
        self._state.order += 1
        self._state.agenda_ns, self._state.agenda_order, _ = self._agenda[0]

    def step_to(self, now_ns: int) -> None:
        """Step all servos up to the last grid point at or before `now_ns`."""
        while (answer := self._library.motion_step_to(self.address, now_ns)) != StepResult.DONE:
            self._state.busy = True  # Callbacks may read the time, but must not advance it
            try:
                if answer == StepResult.ACTION:
                    self._act()
                elif answer == StepResult.STRAINED:
                    self._call_watchers()
                else:
                    self._step()
            finally:
                self._state.busy = False

    def _act(self) -> None:
        _, _, action = heapq.heappop(self._agenda)
        head = self._agenda[0] if self._agenda else (_NEVER, 0)
        self._state.agenda_ns, self._state.agenda_order = head[:2]
        action()

    def _call_watchers(self) -> None:
        news = np.flatnonzero(self.servos["news"]).tolist()
        self.servos["news"] = self._state.news = 0
        for index in news:
            if (act := self._watchers.get(index)) is not None:
                act()

    def _step(self) -> None:
        """Take one step of a plant that is not in C, or one in which shafts that are turned by hand follow
        the hand, unless the servo drives them."""
        angles = {index: self.plant.angle.item(index) for index in self._hands}
        self._library.motion_drive(self.address)
        self.plant.step_shafts(self._drive, self._damping, self._state.step_s)
        self._library.motion_check_rest(self.address)
        for index, angle in angles.items():
            hand, way = self._hands[index], self._hands[index].speed * STEP_NS * 1e-9
            if self._drives(index):
                del self._hands[index]
                hand.gives_way(hand.turned)
                continue
            hand.steps, hand.turned = hand.steps - 1, hand.turned + way
            self.move_shaft(index, angle + way)
            if hand.steps:
                self.plant.velocity[index] = hand.speed
            else:
                del self._hands[index]
        self._state.hands = len(self._hands)
        self._library.motion_end_step(self.address)

    def _drives(self, index: int) -> bool:
        """Return True if a servo is commanded to a position, a speed, or a torque other than 0."""
        command = ServoCommand(*self._commands[index].item())
        able = command.limit > 0.0 and command.torque_limit > 0.0
        return able and any((command.bias, command.turning, command.p_ccw, command.p_cw))

    def _wake(self) -> None:
        self._state.calm = self._state.still = self._state.arrived = False

    def _build(self, angle: Floats, velocity: Floats) -> None:
        self.plant: Plant = self._make_plant(
            [
                PlantJoint(motor, load, each, recounted)
                for motor, load, each, recounted in zip(
                    self._motors, self._loads, angle.tolist(), self._recounted, strict=True
                )
            ]
        )
        self.plant.velocity[:] = velocity
        self._before, self._drive, self._damping = velocity.copy(), *np.zeros((2, len(velocity)))
        self._commands, state, plant = self.servos[_COMMAND], self._state, self.plant
        state.count, state.servos = len(self.servos), self.servos.ctypes.data
        state.joints, state.coupling_count = None, 0
        if isinstance(plant, IndependentJoints):
            state.joints = plant.joints.ctypes.data
            state.couplings, state.coupling_count = ctypes.addressof(plant.couplings), len(plant.couplings)
        for name, values in {
            "angle": plant.angle,
            "velocity": plant.velocity,
            "before": self._before,
            "drive": self._drive,
            "damping": self._damping,
        }.items():
            setattr(state, name, values.ctypes.data)


def plant_of(config: SimulationConfig) -> PlantMaker:
    """Return the function that makes a simulation's plant: of its bodies in MuJoCo, or of joints without
    bodies.

    Raises:
        InputError: MuJoCo is not installed, cannot load the URDF, or would move nothing.
    """
    if config.bodies is not None:
        # Imported here because it takes long, and servos without bodies do not need it.
        from importlib.metadata import entry_points

        (found,) = entry_points(group="dxlrun.physics", name="mujoco")  # In a package that is slow to import
        maker: PlantMaker = found.load()(config.bodies)
        return maker
    if all(one.is_single for one in config.mechanisms):
        return IndependentJoints
    return partial(CoupledJoints, config.mechanisms)
