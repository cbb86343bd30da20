"""Mechanics: motion of all servos of one simulation, stepped together on one time grid.

In each step the profiles give the setpoints of the servos' controllers, the control law gives the torque
of the motors, and the plant gives the motion. Commands take effect at the next point of the grid; between
grid points angles are extrapolated with their velocity. Nothing is computed while all servos rest."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from functools import partial
from importlib.metadata import entry_points

import msgspec
import numpy as np

from dxlsim.motion.control_law import LIMP, ROWS, ControlLaw, Profiles, ServoCommand
from dxlsim.motion.coupled_joints import joints_without_bodies
from dxlsim.motion.link_motion import Shafts
from dxlsim.motion.motor import Motor
from dxlsim.motion.plant import Floats, IndependentJoints, Plant, PlantJoint, PlantMaker
from dxlsim.simulation_plan import Load, SimulationConfig

STEP_NS = 2_000_000
"""Step of the time grid, ns. The shortest time constant in a servo is that of its motor: 13.6 ms or more."""

EAGER_NS, EASY_NS = 4_000_000, 1_000_000_000
"""Intervals (ns) at which `step_to` is due in real time, while servos move and while they only cool.
Catching up after a long pause of the host would delay the next reply."""

STRAIN_NS = 100_000_000  # Interval at which heat and load are updated; a whole number of steps

_STEPS_A_LOOK = 16  # Steps between two checks for rest

_STILL, _UNDRIVEN = 1e-6, 1e-8  # rad/s, and its change in a step: a servo rests below both


AMBIENT_C = 30.0  # Temperature of a servo at rest, degrees C [i]

STALLED_RISE_C = 300.0
"""Steady-state temperature rise of a stalled servo, degrees C: with a time constant of 400 s the servo
reaches 80 after a minute [i]."""

COOLING_S = 400.0  # Time constant of housing and winding, modelled as one body [i]

OVERLOAD_PART = 0.8
"""Fraction of the torque allowed by the limit, above which the servo counts as overloaded [i]."""

OVERLOAD_TICKS = 10  # Tolerated duration in ticks of `Strain`: a second [i]

_STEADY_C = 1e-7  # degrees C in a tick; a smaller change has no visible effect in years

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
        self.grid_ns = start_ns  # Time of the last step
        self._start_ns = start_ns
        self._next_strain_ns = start_ns + STRAIN_NS
        self._motors: list[Motor] = []
        self._loads: list[Load] = []
        self._recounted: list[float] = []
        self._watchers: dict[int, Callable[[], None]] = {}
        self._agenda: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._hands: dict[int, _Hand] = {}
        self._busy = False
        self._commanded = False
        self.still = False  # True while all servos rest without new commands
        self._before: Floats | None = None
        """Velocities of the shafts before the last step, rad/s; None unless `sense` was called."""
        self._build(np.zeros(0), np.zeros(0))

    # Servos

    def add_servo(self, motor: Motor, load: Load, angle: float) -> int:
        """Add a servo at rest and limp, with its shaft at `angle`, rad from its raw 0; return the index by
        which other methods address it."""
        plant, profiles, law, strain = self.plant, self.profiles, self.law, self.strain
        commands, count = self._commands, len(self._motors)
        self._motors.append(motor)
        self._loads.append(load)
        self._recounted.append(0.0)
        # The arrays of a plant have a fixed size, so all parts are rebuilt, and their state is copied.
        self._build(np.append(plant.angle, angle), np.append(plant.velocity, 0.0))
        self._commands[:, :count] = commands
        self._commands[ROWS["goal"], count] = angle
        self.profiles.position[:count], self.profiles.velocity[:count] = profiles.position, profiles.velocity
        self.law.stall[:count], self.law.integral[:count] = law.stall, law.integral
        self.strain.temperature[:count] = strain.temperature
        self.strain.overloaded[:count] = strain.overloaded
        self._wake()
        return count

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
        self.law.stall[index] = motor.stall_torque * (volts / motor.voltage if motor.voltage else 1.0)
        self._wake()

    def command_servo(self, index: int, command: ServoCommand) -> None:
        """Give a servo's controller new parameters. Its trajectory continues from its setpoint, or from
        the shaft if it was limp."""
        was_limp = self._commands[ROWS["limit"], index] == 0.0
        was_turning = self._commands[ROWS["turning"], index] != 0.0
        self._commands[:, index] = command
        if command.limit == 0.0:
            self._commands[ROWS["goal"], index] = self.plant.angle[index]
        if was_limp or command.limit == 0.0 or was_turning != (command.turning != 0.0):
            self.profiles.position[index] = self.plant.angle[index]
            self.profiles.velocity[index] = self.plant.velocity[index] if command.turning else 0.0
            self.law.integral[index] = 0.0
        self._wake()

    def aim(self, index: int, goal: float, speed: float, acceleration: float) -> None:
        """Change only a servo's goal, rad, and the speed, rad/s, and acceleration, rad/s^2, of its
        trajectory."""
        self.profiles.aim(index, goal, speed, acceleration)
        self.strain.calm = False
        self.still = False

    def move_shaft(self, index: int, angle: float) -> None:
        """Move a resting shaft to an angle, rad, at once; its trajectory begins there."""
        self.plant.place_shaft(index, angle)
        self.profiles.position[index], self.profiles.velocity[index] = angle, 0.0
        if self._commands[ROWS["limit"], index] == 0.0:
            self._commands[ROWS["goal"], index] = angle
        self.profiles.arrived = False
        self.still = False

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
        self.still = False

    def heat(self, index: int, celsius: float) -> None:
        """Set a servo's temperature, degrees C; it then approaches the temperature that its load causes."""
        self.strain.temperature[index] = celsius
        self.strain.calm = False

    def overloaded(self, index: int) -> bool:
        """Return True if a servo has been overloaded for OVERLOAD_TICKS or longer."""
        return bool(self.strain.overloaded[index] >= OVERLOAD_TICKS)

    # For sensors on the bodies

    def sense(self) -> None:
        """Record velocities from the next step on, so that `acceleration` is available."""
        self._before = self.plant.velocity.copy()

    @property
    def acceleration(self) -> Floats:
        """Accelerations of the shafts in the last step, rad/s^2; zeros unless `sense` was called before."""
        if self.still or self._before is None or len(self._before) != len(self._motors):
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
        heapq.heappush(self._agenda, (t_ns, next(self._order), action))

    def due_ns(self) -> int | None:
        """Return the time at which `step_to` must be called in real time, even without requests of hosts;
        None if nothing moves or cools."""
        if not self._motors:
            return None
        if not self.still:
            return self.grid_ns + EAGER_NS
        agenda_ns = self._agenda[0][0] + STEP_NS if self._agenda else None
        if self.strain.calm:
            return agenda_ns
        easy_ns = self.grid_ns + EASY_NS
        return easy_ns if agenda_ns is None else min(easy_ns, agenda_ns)

    def step_to(self, now_ns: int) -> None:
        """Step all servos up to the last grid point at or before `now_ns`."""
        if self._busy or self.grid_ns + STEP_NS > now_ns:
            return
        self._busy = True  # Callbacks may read the time, but must not advance it
        try:
            while self.grid_ns + STEP_NS <= now_ns:
                self._advance_once(now_ns)
        finally:
            self._busy = False

    def _advance_once(self, now_ns: int) -> None:
        """Do the actions that are due, then take one step or skip the steps in which nothing happens;
        update temperatures if due."""
        while self._agenda and self._agenda[0][0] <= self.grid_ns:
            heapq.heappop(self._agenda)[2]()
        if self.still or not self._motors:
            self._skip(now_ns)
        else:
            if self._hands:
                self._step_with_hands()
            else:
                self._step()
            self.grid_ns += STEP_NS
        if self.grid_ns >= self._next_strain_ns:
            self._next_strain_ns = self._strain_after(self.grid_ns)
            self._feel()

    def _skip(self, now_ns: int) -> None:
        """Skip steps at once while all servos rest, up to the next action or change of temperature."""
        until_ns = now_ns if self.strain.calm else min(now_ns, self._next_strain_ns)
        if self._agenda:
            until_ns = min(until_ns, self._agenda[0][0])
        self.grid_ns += max(1, (until_ns - self.grid_ns) // STEP_NS) * STEP_NS

    def _strain_after(self, t_ns: int) -> int:
        return t_ns - (t_ns - self._start_ns) % STRAIN_NS + STRAIN_NS

    def _step(self) -> None:
        plant, profiles, law = self.plant, self.profiles, self.law
        if self._commanded:
            self._commanded = False
            profiles.commanded()
            law.commanded()
        profiles.advance_trajectories()
        law.compute_drive(profiles, plant.angle, plant.velocity)
        if self._before is not None:
            self._before = plant.velocity.copy()
        # A check for rest needs copies of the arrays, so it is not made in every step.
        if (self.grid_ns - self._start_ns) // STEP_NS % _STEPS_A_LOOK:
            plant.step_shafts(law.drive, law.damping, STEP_NS * 1e-9)
            return
        before = plant.velocity.copy()
        plant.step_shafts(law.drive, law.damping, STEP_NS * 1e-9)
        profiles.check_arrival()
        still = profiles.arrived and np.abs(plant.velocity).max() < _STILL and not law.winding
        if still and np.abs(before - plant.velocity).max() < _UNDRIVEN:
            plant.velocity.fill(0.0)
            self.still = True

    def _step_with_hands(self) -> None:
        """Take one step in which shafts that are turned by hand follow the hand, unless the servo drives
        them."""
        angles = {index: self.plant.angle.item(index) for index in self._hands}
        self._step()
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

    def _drives(self, index: int) -> bool:
        """Return True if a servo is commanded to a position, a speed, or a torque other than 0."""
        command = ServoCommand(*self._commands[:, index].tolist())
        able = command.limit > 0.0 and command.torque_limit > 0.0
        return able and any((command.bias, command.turning, command.p_ccw, command.p_cw))

    def _feel(self) -> None:
        if not self._motors:
            return
        most = self.law.stall * self._commands[ROWS["limit"]]
        for index in self.strain.tick(self.law.torque, most):
            if (act := self._watchers.get(index)) is not None:
                act()

    def _wake(self) -> None:
        self._commanded = True
        self.strain.calm = False
        self.still = False

    def _build(self, angle: Floats, velocity: Floats) -> None:
        count, dt_s = len(self._motors), STEP_NS * 1e-9
        self.plant: Plant = self._make_plant(
            [
                PlantJoint(motor, load, each, recounted)
                for motor, load, each, recounted in zip(
                    self._motors, self._loads, angle.tolist(), self._recounted, strict=True
                )
            ]
        )
        self.plant.velocity[:] = velocity
        self._commands = np.tile(np.array([LIMP]).T, (1, count))
        nominal = np.array([motor.stall_torque for motor in self._motors])
        self.profiles = Profiles(self._commands, self.plant.angle, dt_s)
        self.law = ControlLaw(self._commands, np.array([motor.damping for motor in self._motors]), dt_s)
        self.law.stall[:] = nominal
        self.strain = Strain(nominal, STRAIN_NS * 1e-9)
        self._next_strain_ns = self._strain_after(self.grid_ns)


class Strain:
    """Temperature of each servo from the copper loss (current squared, [i]: one body), and duration of its
    overload."""

    def __init__(self, nominal_stall: Floats, dt_s: float) -> None:
        size = len(nominal_stall)
        self._nominal_stall = nominal_stall
        self._part = dt_s / COOLING_S
        self.temperature: Floats = np.full(size, AMBIENT_C)  # degrees C
        self.overloaded = np.zeros(size, dtype=np.int64)  # Ticks since the beginning of the overload
        self.calm = False  # True if the same load would change nothing any more

    def tick(self, torque: Floats, most: Floats) -> list[int]:
        """Update temperatures and overloads for one tick of STRAIN_NS; return the servos with a new
        temperature or overload.

        Args:
            torque: Torque of each motor, Nm.
            most: Torque at standstill that duty limit and supply allow, Nm.
        """
        shown = np.rint(self.temperature)
        load = torque / self._nominal_stall
        change = (AMBIENT_C + STALLED_RISE_C * load * load - self.temperature) * self._part
        self.temperature += change
        too_much = (np.abs(torque) >= OVERLOAD_PART * most) & (most > 0.0)
        self.overloaded = np.where(too_much, self.overloaded + 1, 0)
        self.calm = bool(np.abs(change).max() < _STEADY_C and not too_much.any())
        news = (np.rint(self.temperature) != shown) | (self.overloaded == OVERLOAD_TICKS)
        return np.flatnonzero(news).tolist() if news.any() else []


def plant_of(config: SimulationConfig) -> PlantMaker:
    """Return the function that makes a simulation's plant: of its bodies in MuJoCo, or of joints without
    bodies.

    Raises:
        InputError: MuJoCo is not installed, cannot load the URDF, or would move nothing.
    """
    if config.bodies is not None:
        (found,) = entry_points(group="dxlrun.physics", name="mujoco")  # In a package that is slow to import
        maker: PlantMaker = found.load()(config.bodies)
        return maker
    if all(one.is_single for one in config.mechanisms):
        return IndependentJoints
    return partial(joints_without_bodies, config.mechanisms)
