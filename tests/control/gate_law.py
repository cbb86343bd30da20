"""The law of gate.c in Python, joint by joint: what the compiled gate must do to the bit."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from math import inf, isfinite, isinf, isnan, nan, sqrt

from dxlrun.channels.cycle import LIMP, Clamp
from dxlrun.control import gate
from dxlrun.plan.loop_plan import JointPlan
from dxlrun.plan.policy_plan import SLOW_SPEED, SLOW_START_NS
from dxlwire.modes import Mode

BRAKING_S = 0.1
"""Of this time's way a joint in velocity mode may come nearer to a limit"""
LAG_S = 0.15
"""How long a servo in velocity mode goes on as before"""
LED = (Mode.POSITION, Mode.EFFORT_POSITION)


def least(a: float, b: float) -> float:
    return a if isnan(a) or a < b else b


def most(a: float, b: float) -> float:
    return a if isnan(a) or a > b else b


def fleast(a: float, b: float) -> float:
    return a if isnan(b) or a < b else b


def fmost(a: float, b: float) -> float:
    return a if isnan(b) or a > b else b


def between(low: float, value: float, high: float) -> float:
    return least(most(value, low), high)


def braking_speed(distance: float, dt: float, acceleration: float) -> float:
    return 2.0 * distance / (dt + sqrt(dt * dt + 2.0 * distance / acceleration))


def or_inf(limit: float | None) -> float:
    return inf if limit is None else limit


@dataclass
class Joint:
    """One joint: its plan, what is measured of it and commanded, its goals, and what is done to them."""

    plan: JointPlan
    mode: int
    position: float
    accelerates: bool
    """A joint of the robot has an acceleration limit"""
    velocity: float = 0.0
    torque: int = 1
    commands: list[float] = field(default_factory=lambda: [nan] * 4)
    goals: list[float] = field(default_factory=lambda: [nan] * 4)
    clamped: int = 0
    slow_ns: int = SLOW_START_NS
    moving: float = 0.0
    last: float = 0.0
    rise: float = 0.0
    limp: bool = False

    def __post_init__(self) -> None:
        plan = self.plan
        self.acceleration, self.own = or_inf(plan.acceleration), or_inf(plan.top_speed)
        self.effort, self.share = (
            least(plan.highest_effort, 1.7976931348623157e308),
            plan.slow_speed / SLOW_SPEED,
        )
        self.low, self.high = between(-1e9, plan.lower, 1e9), between(-1e9, plan.upper, 1e9)
        self.fence = [inf, inf]
        if self.mode in LED:
            self.goals[0] = self.position
        self.rest()

    def rest(self) -> None:
        self.moving, self.target, self.left = 0.0, self.goals[0], self.goals[0]

    def flag(self, condition: bool, bit: Clamp) -> None:
        if condition:
            self.clamped |= bit

    def stay(self) -> None:
        if self.mode in LED and isfinite(self.position):
            self.goals[:2] = self.position, nan
            self.rest()

    def enter(self, mode: int) -> None:
        """Take a mode; what leads somewhere else is forgotten, whichever joint enters another one."""
        self.fence = [inf, inf]
        if mode == self.mode:
            return
        self.mode, self.goals, self.slow_ns = mode, [nan] * 4, SLOW_START_NS
        if mode in LED:
            self.goals[0] = self.position
        elif mode:
            self.goals[mode - 1] = 0.0
        self.rest()

    def begin(self, dt_ns: int) -> bool:
        """Begin a cycle; return whether the goal may go to its command at once."""
        was, self.limp = self.limp, self.torque in LIMP
        self.slow_ns = SLOW_START_NS if was and not self.limp else self.slow_ns
        if was or self.limp:
            self.stay()
        speed = self.plan.step_speed
        self.speed = least(speed, self.plan.slow_speed) if self.slow_ns > 0 else speed
        self.slow_ns -= dt_ns if self.slow_ns > 0 else 0
        self.dt_ns, self.dt, self.clamped = dt_ns, max(dt_ns, 1) * 1e-9, 0
        return self.mode not in LED or self.lead()

    def lead(self) -> bool:
        goal, position, speed, dt = self.goals[0], self.commands[0], abs(self.commands[1]), self.dt
        lower, upper = fleast(self.plan.lower, goal), fmost(self.plan.upper, goal)
        low, high = fmost(goal - self.speed * dt, lower), fleast(goal + self.speed * dt, upper)
        self.inside, self.moves = between(low, position, high), isfinite(position)
        self.toward = between(0.0, speed, least(self.plan.highest_speed, 1.7976931348623157e308))
        fast = self.moves and not isnan(speed) and self.toward != speed
        self.flag(isinf(position) or (fast and isinf(speed)), Clamp.NOT_FINITE)
        self.flag(fast and isfinite(speed), Clamp.VELOCITY)
        self.toward = nan if fast and isinf(speed) else self.toward
        self.flag(self.moves and position < lower, Clamp.LOWER)
        self.flag(self.moves and position > upper, Clamp.UPPER)
        kept = between(lower, position, upper)
        self.flag(
            self.moves and self.speed < self.own and isinf(self.acceleration) and self.inside != kept,
            Clamp.STEP,
        )
        self.desired = self.inside if self.moves else goal
        step, change = self.desired - goal, self.acceleration * (1 + 1e-9) * (dt * dt)
        end = abs(step) * step * (0.5 / self.acceleration) / (dt * dt) + self.desired
        over = abs(step - self.moving * dt) > change or abs(self.target - goal) > change
        return isinf(self.acceleration) or not (
            over or abs(end - (self.low + self.high) / 2) > (self.high - self.low) / 2
        )

    def steer(self) -> None:
        goal, dt, limit, highest = self.goals[0], self.dt, self.acceleration, least(self.speed, self.own)
        desired = goal
        if self.moves:
            desired = between(fleast(self.plan.lower, goal), self.commands[0], fmost(self.plan.upper, goal))
        if goal != self.left:
            self.rest()
        own = (desired - self.target) / dt
        own = own if abs(own) <= highest else 0.0
        behind, fastest = desired - goal - own * dt, highest
        if self.moves and not isnan(self.toward):
            fastest = fleast(highest, fmost(fmost(self.toward, 0.01), abs(own)))
        velocity = own + math.copysign(braking_speed(abs(behind), dt, limit), behind)
        velocity = between(-fastest, velocity, fastest)
        velocity = between(self.moving - limit * dt, velocity, self.moving + limit * dt)
        down, up = (braking_speed(fmost(way, 0.0), dt, limit) for way in (goal - self.low, self.high - goal))
        velocity = between(-down, velocity, up)
        stepped = between(fleast(self.low, goal), goal + velocity * dt, fmost(self.high, goal))
        self.moving, self.target, self.left, self.inside = velocity, desired, stepped, stepped
        self.flag(self.moves and abs(stepped - desired) > 1e-9, Clamp.STEP)
        self.toward, self.moves = self.toward if self.moves else self.goals[1], True

    def end(self, all_pass: bool) -> None:
        """Set the goals; `all_pass`: every joint's goal may go to its command at once."""
        if self.mode in LED:
            if isfinite(self.acceleration) and all_pass:
                self.moving = (self.desired - self.goals[0]) / self.dt
                self.target = self.left = self.desired
            elif isfinite(self.acceleration):
                self.steer()
            if self.moves:
                self.goals[:2] = self.inside, self.toward
            ceiling = least(self.speed, self.plan.highest_speed) if self.speed < self.own else nan
            if self.goals[0] < self.plan.lower or self.goals[0] > self.plan.upper:
                ceiling = fleast(ceiling, gate.BACK_SPEED * self.share)
            self.goals[1] = fleast(self.goals[1], ceiling)
        elif self.mode == Mode.VELOCITY:
            self.goals[1] = self.drive()
        elif self.mode == Mode.EFFORT:
            self.goals[2] = self.brake(self.commands[2], self.effort, Clamp.EFFORT)
        elif self.mode == Mode.PWM:
            self.goals[3] = self.brake(self.commands[3], self.plan.highest_pwm, Clamp.PWM)
        if self.mode == Mode.EFFORT_POSITION:
            value = abs(self.commands[2])
            self.flag(value > self.effort, Clamp.NOT_FINITE if isinf(value) else Clamp.EFFORT)
            self.goals[2] = least(value if isfinite(value) else self.goals[2], self.effort)
        if self.limp:
            self.clamped &= Clamp.NOT_FINITE
            self.fence = [inf, inf]
            self.stay()

    def bounded(self, value: float, highest: float, bit: Clamp) -> float:
        self.flag(isinf(value), Clamp.NOT_FINITE)
        value = value if isfinite(value) else 0.0
        self.flag(abs(value) > highest, bit)
        return between(-highest, value, highest)

    def inward(self, down: float, value: float, up: float) -> float:
        if not self.plan.bounded:
            return value
        self.flag(value > up or value < down, Clamp.OUTWARD)
        return between(down, value, up)

    def drive(self) -> float:
        command, last, highest = self.commands[1], self.goals[1], least(self.speed, self.plan.highest_speed)
        slow = highest < self.plan.highest_speed
        value = self.bounded(command, highest, Clamp.STEP if slow else Clamp.VELOCITY)
        if self.accelerates:
            before, change = 0.0 if isnan(last) else last, self.acceleration * self.dt
            ramped = between(before - change, value, before + change)
            self.flag(ramped != value and isfinite(command), Clamp.STEP)
            value = ramped
        ahead = self.velocity * (LAG_S + 1e-9 * self.dt_ns)
        seconds = fmost(BRAKING_S, 2e-9 * self.dt_ns)
        ways = (
            fmost(self.plan.upper - self.position - fmost(ahead, 0.0), 0.0),
            fmost(self.position - self.plan.lower + fleast(ahead, 0.0), 0.0),
        )
        up, down = (
            braking_speed(way, seconds, self.acceleration) if self.accelerates else way / seconds
            for way in ways
        )
        return self.inward(-down, value, up)

    def brake(self, command: float, highest: float, bit: Clamp) -> float:
        value, dt, brakes = self.bounded(command, highest, bit), self.dt, self.acceleration
        brakes = fmost(gate.BRAKING * self.share, brakes if isfinite(brakes) else 0.0)
        rise = abs(self.velocity - self.last) / dt
        self.rise, self.last = fmost(rise, self.rise * max(0.0, 1.0 - dt / 0.5)), self.velocity
        band, ends = fmost(self.share, 2.0 * dt * self.rise), []
        for side, limit in enumerate((self.plan.upper, -self.plan.lower)):
            sign = (1.0, -1.0)[side]
            self.fence[side] = fmost(limit, fleast(self.fence[side], sign * self.position))
            left = self.fence[side] - sign * self.position
            inside = fmost(left / BRAKING_S, -gate.BACK_SPEED * self.share)
            if left > 0.0:
                inside = braking_speed(left, 2.0 * dt, brakes)
            share = between(-1.0, (inside - sign * self.velocity) / band, 1.0 if left > 0.0 else 0.0)
            ends.append((0.0 if isnan(left) else share) * highest)
        return self.inward(-ends[1], value, ends[0])
