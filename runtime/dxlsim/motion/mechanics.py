"""All servos of one simulation as mechanics: stepped together on one grid of time.

In each step the profiles give where the servos' controllers want to be, the control law which torque their
motors give, and the plant what it moves. Commands act at the next point of the grid; between its points
angles go on with their velocity. While nothing moves, nothing is computed.
"""

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
"""Step of the grid. The fastest thing in a servo here is its motor's time constant: 13.6 ms and more."""

EAGER_NS, EASY_NS = 4_000_000, 1_000_000_000
"""In real time it is advanced so often while servos move and while they only cool: to catch up with a long
pause of the host would delay the next reply."""

STRAIN_NS = 100_000_000  # So often servos feel heat and load; a whole number of steps

_STEPS_A_LOOK = 16  # So often it is looked whether all rest

_STILL, _UNDRIVEN = 1e-6, 1e-8  # rad/s, and its change in a step: below both a servo rests


AMBIENT_C = 30.0  # degrees C of a servo at rest [i]

STALLED_RISE_C = 300.0
"""degrees C above ambient where a servo at stall would end: with 400 s it is at 80 after a minute [i]."""

COOLING_S = 400.0  # Time constant of housing and winding as one body [i]

OVERLOAD_PART = 0.8
"""Part of the torque that the limit allows, beyond which the servo counts as overloaded [i]"""

OVERLOAD_TICKS = 10  # Ticks of `Strain` that it may last: a second [i]

_STEADY_C = 1e-7  # degrees C in a tick; a smaller change shows nowhere in years

SUPPLY_OHM = 0.1  # Resistance of cable and plugs between supply and servo [i]


class _Hand(msgspec.Struct):
    speed: float  # rad/s
    steps: int  # of the grid that are left
    gives_way: Callable[[float], None]
    turned: float = 0.0  # rad so far


class Mechanics:
    """Servos that are stepped together; time comes from the callers, and going back is ignored."""

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
        self.still = False  # True while all servos rest, uncommanded
        self._before: Floats | None = None
        """Velocities before the last step, if accelerations are sensed"""
        self._build(np.zeros(0), np.zeros(0))

    # Servos

    def add(self, motor: Motor, load: Load, angle: float) -> int:
        """Add a servo with its shaft at an angle, rad from its raw 0, at rest and limp; return its index."""
        plant, profiles, law, strain = self.plant, self.profiles, self.law, self.strain
        commands, count = self._commands, len(self._motors)
        self._motors.append(motor)
        self._loads.append(load)
        self._recounted.append(0.0)
        self._build(np.append(plant.angle, angle), np.append(plant.velocity, 0.0))
        self._commands[:, :count] = commands
        self._commands[ROWS["goal"], count] = angle
        self.profiles.position[:count], self.profiles.velocity[:count] = profiles.position, profiles.velocity
        self.law.stall[:count], self.law.integral[:count] = law.stall, law.integral
        self.strain.temperature[:count] = strain.temperature
        self.strain.overloaded[:count] = strain.overloaded
        self._wake()
        return count

    def jam(self, index: int, on: bool) -> None:
        """Block a shaft where it is, or free it."""
        self.plant.jam(index, on)
        self._wake()

    def motor(self, index: int) -> Motor:
        """Return a servo's motor."""
        return self._motors[index]

    def watch(self, index: int, act: Callable[[], None]) -> None:
        """Call `act` when a servo's temperature changes by a degree, or when it is overloaded."""
        self._watchers[index] = act

    def supply(self, index: int, volts: float) -> None:
        """Give a servo another voltage: its stall torque and no-load speed go with it."""
        motor = self._motors[index]
        self.law.stall[index] = motor.stall_torque * (volts / motor.voltage if motor.voltage else 1.0)
        self._wake()

    def command(self, index: int, command: ServoCommand) -> None:
        """Command a servo; its trajectory continues from where it is, that of a limp one from the shaft."""
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
        """Change the goal of a servo and its profile, and nothing else; as in `ServoCommand`."""
        self.profiles.aim(index, goal, speed, acceleration)
        self.strain.calm = False
        self.still = False

    def place(self, index: int, angle: float) -> None:
        """Put a shaft somewhere, rad, at rest; its trajectory begins there."""
        self.plant.place(index, angle)
        self.profiles.position[index], self.profiles.velocity[index] = angle, 0.0
        if self._commands[ROWS["limit"], index] == 0.0:
            self._commands[ROWS["goal"], index] = angle
        self.profiles.arrived = False
        self.still = False

    def recount(self, index: int, angle: float) -> None:
        """Put a shaft to rest and count its angle, rad, in another turn; its trajectory begins there."""
        turns = math.tau * round((angle - self.plant.angle.item(index)) / math.tau)
        if turns:
            self._recounted[index] += turns
            self.plant.recount(index, turns)
        self.place(index, angle)

    def turn(self, index: int, by: float, duration_ns: int, gives_way: Callable[[float], None]) -> None:
        """Let a hand turn a shaft evenly by an angle, rad, from now on.

        It gives way to a servo that drives or holds its shaft; `gives_way` is then called with its way, rad.
        """
        steps = max(1, round(duration_ns / STEP_NS))
        self._hands[index] = _Hand(by / (steps * STEP_NS * 1e-9), steps, gives_way)
        self.still = False

    def heat(self, index: int, celsius: float) -> None:
        """Bring a servo to a temperature, degrees C; it returns to that of its load."""
        self.strain.temperature[index] = celsius
        self.strain.calm = False

    def overloaded(self, index: int) -> bool:
        """Return whether a servo has been overloaded for too long."""
        return bool(self.strain.overloaded[index] >= OVERLOAD_TICKS)

    # What sensors on the bodies see

    def sense(self) -> None:
        """Keep what `acceleration` needs, from the next step on."""
        self._before = self.plant.velocity.copy()

    @property
    def acceleration(self) -> Floats:
        """Accelerations of the shafts in the last step, rad/s^2; `sense` was called before."""
        if self.still or self._before is None or len(self._before) != len(self._motors):
            return np.zeros(len(self._motors))
        return (self.plant.velocity - self._before) / (STEP_NS * 1e-9)

    def shafts(self, now_ns: int, count: int) -> Shafts:
        """Return the first shafts at a time; between points of the grid they go on with their velocity."""
        self.advance(now_ns)
        velocity = self.plant.velocity[:count].copy()
        angle = self.plant.angle[:count] + velocity * (max(0, now_ns - self.grid_ns) * 1e-9)
        return Shafts(now_ns, angle, velocity, self.acceleration[:count].copy())

    # Time

    def call_at(self, t_ns: int, action: Callable[[], None]) -> None:
        """Let something happen at the first point of the grid that is not before a time."""
        heapq.heappush(self._agenda, (t_ns, next(self._order), action))

    def due_ns(self) -> int | None:
        """Return when it should be advanced in real time, whatever hosts do; None: it has nothing to do."""
        if not self._motors:
            return None
        if not self.still:
            return self.grid_ns + EAGER_NS
        agenda_ns = self._agenda[0][0] + STEP_NS if self._agenda else None
        if self.strain.calm:
            return agenda_ns
        easy_ns = self.grid_ns + EASY_NS
        return easy_ns if agenda_ns is None else min(easy_ns, agenda_ns)

    def advance(self, now_ns: int) -> None:
        """Step up to the last point of the grid before a time."""
        if self._busy or self.grid_ns + STEP_NS > now_ns:
            return
        self._busy = True  # what is called on the way may look at the time, not change it
        try:
            while self.grid_ns + STEP_NS <= now_ns:
                self._advance_once(now_ns)
        finally:
            self._busy = False

    def _advance_once(self, now_ns: int) -> None:
        """Take one step, or as many as nothing happens in."""
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
        """Let the time pass in which nothing moves, and nothing gets warmer or colder."""
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
        profiles.step()
        law.step(profiles, plant.angle, plant.velocity)
        if self._before is not None:
            self._before = plant.velocity.copy()
        if (self.grid_ns - self._start_ns) // STEP_NS % _STEPS_A_LOOK:
            plant.step(law.drive, law.damping, STEP_NS * 1e-9)
            return
        before = plant.velocity.copy()
        plant.step(law.drive, law.damping, STEP_NS * 1e-9)
        profiles.look()
        still = profiles.arrived and np.abs(plant.velocity).max() < _STILL and not law.winding
        if still and np.abs(before - plant.velocity).max() < _UNDRIVEN:
            plant.velocity.fill(0.0)
            self.still = True

    def _step_with_hands(self) -> None:
        """Take one step; what a hand turns is where the hand is."""
        angles = {index: self.plant.angle.item(index) for index in self._hands}
        self._step()
        for index, angle in angles.items():
            hand, way = self._hands[index], self._hands[index].speed * STEP_NS * 1e-9
            if self._drives(index):
                del self._hands[index]
                hand.gives_way(hand.turned)
                continue
            hand.steps, hand.turned = hand.steps - 1, hand.turned + way
            self.place(index, angle + way)
            if hand.steps:
                self.plant.velocity[index] = hand.speed
            else:
                del self._hands[index]

    def _drives(self, index: int) -> bool:
        """Return whether a servo is commanded to a position, a speed, or a torque that is not 0."""
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
    """Temperature by the copper's loss (current squared, [i]: one body), and time under too much load."""

    def __init__(self, nominal_stall: Floats, dt_s: float) -> None:
        size = len(nominal_stall)
        self._nominal_stall = nominal_stall
        self._part = dt_s / COOLING_S
        self.temperature: Floats = np.full(size, AMBIENT_C)  # degrees C
        self.overloaded = np.zeros(size, dtype=np.int64)  # Ticks since the load became too much
        self.calm = False  # True when the same load would change nothing any more

    def tick(self, torque: Floats, most: Floats) -> list[int]:
        """Let a time pass under torques, Nm; return the servos that have something new to notice.

        `most`: the torque that duty limit and supply allow at standstill, Nm.
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
    """Return what makes the plant of a simulation: of its bodies, or of joints that move without them.

    Raises InputError when MuJoCo is not installed, cannot take the URDF, or would move nothing.
    """
    if config.bodies is not None:
        (found,) = entry_points(group="dxlrun.physics", name="mujoco")  # of a package, and slow to import
        maker: PlantMaker = found.load()(config.bodies)
        return maker
    if all(one.is_single for one in config.mechanisms):
        return IndependentJoints
    return partial(joints_without_bodies, config.mechanisms)
