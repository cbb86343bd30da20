"""Loop state: what loop, gate and manager know at the end of a cycle, beside what the cycle's record has.

Written every 10 s into the log, so that a replay can begin there. MessagePack; arrays as their bytes.
"""

from __future__ import annotations

import msgspec

from dxlrun.plan.loop_plan import ControllerPlan


class GoalState(msgspec.Struct, frozen=True):
    """A goal that runs."""

    number: int
    controller: str
    kind: str
    origin: str
    cancelling: bool
    progress: float
    error: float
    reported_ns: int
    result: tuple[str, str, float, tuple[str, ...], int] | None = None
    """A `goals.Result` that is not certain yet."""


class MotionState(msgspec.Struct, frozen=True):
    """What the runtime plays by commands."""

    goal: int
    part: bytes
    """A PlayedPart as JSON."""
    commands: tuple[bytes, ...]
    begun_ns: int
    next: int


class WaitingGroup(msgspec.Struct, frozen=True):
    """Controllers that wait for modes."""

    names: tuple[str, ...]
    until_ns: int
    why: str


class ManagedState(msgspec.Struct, frozen=True):
    """What the manager knows of a controller."""

    active: bool
    failed: bool
    waiting: bool
    held: bool
    until_ns: int
    last_ns: int
    due_cycle: int
    divider: int
    nominal_ns: int
    goal: int
    """Its number; 0: none."""
    parameters: dict[str, bool | int | float]
    """Live ones that were changed."""
    commands: bytes
    inputs: tuple[bytes, ...]
    """What was gathered for it last."""
    seen: tuple[bytes, ...]
    """Of each claim, and so below."""
    taken: tuple[bytes, ...]
    device_commands: bytes = b""
    provided: bytes = b""


class ControllerState(msgspec.Struct, frozen=True):
    """The snapshot of one controller."""

    managed: ManagedState
    goal: GoalState | None
    kept: int
    """Number of the state that was kept last in the run, of any controller."""
    state: bytes
    """Its own."""
    problem: str = ""
    """Why it has none; empty: it has."""


class ManagerState(msgspec.Struct, frozen=True):
    """What the manager knows beside its controllers' own states."""

    next: int
    """Of the planned commands."""
    period_ns: int
    last_goal: int
    goals: tuple[GoalState, ...]
    motions: dict[str, MotionState]
    groups: tuple[WaitingGroup, ...]
    modes_requested: bool
    released: tuple[int, ...]
    lost: tuple[int, ...]
    loaded: tuple[tuple[int, ControllerPlan], ...]
    """Controllers that are not of the plan, with their places, the unloaded ones too."""
    unloaded: tuple[int, ...]
    """Places of controllers that were unloaded."""
    managed: dict[str, ManagedState]
    kept: int


class GateState(msgspec.Struct, frozen=True):
    """What the gate knows."""

    slow_ns: bytes
    longest_slow_ns: int
    moving: bytes
    target: bytes
    left: bytes
    driven: bytes = b""
    """What the DriveGate remembers."""


class LoopState(msgspec.Struct, frozen=True):
    """What a loop knows at the end of a cycle."""

    cycle: int
    schedule: dict[str, int]
    paused_until_ns: int
    stood: bool
    paused_cycles: int
    time_ns: int
    woken_ns: int
    skipped: int
    late: bool
    missed: bytes
    lost: tuple[int, ...]
    limp_groups: tuple[str, ...]
    halts: int
    """Commands that wait for the joints to stand still."""
    halt_began_ns: int
    halt_still_ns: int
    halt_before: bytes
    gate: GateState
    manager: ManagerState


def encoded(state: LoopState | ControllerState) -> bytes:
    """Return a state as bytes."""
    return msgspec.msgpack.encode(state)


def loop_state(data: bytes) -> LoopState:
    """Return the state of a loop. Raises ValueError when the bytes are none."""
    return msgspec.msgpack.decode(data, type=LoopState)


def controller_state(data: bytes) -> ControllerState:
    """Return the state of a controller. Raises ValueError when the bytes are none."""
    return msgspec.msgpack.decode(data, type=ControllerState)
