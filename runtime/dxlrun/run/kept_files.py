"""Kept files: files of the states that controllers keep, read before a run and written during it.

A process other than the loop's writes them. A file is replaced atomically: the new file is written next to
the old one, synced to the disk, and renamed. After a crash of this process or of the machine, either the old
or the new file exists.
"""

from __future__ import annotations

import os
import stat
import threading
from contextlib import suppress
from pathlib import Path
from zlib import crc32

from dxlrun.channels.kept import (
    LONGEST_FILE,
    TOPIC,
    Assembly,
    Facts,
    KeptFile,
    KeptStates,
    opened_file,
)
from dxlrun.channels.ring import Gap, Payload, RecordKind, RingReader
from dxlrun.channels.tagged import decode
from dxlrun.channels.topic_messages import OpenedTopic, TopicRecord
from dxlrun.messages.cdr import Codec
from dxlrun.plan.loop_plan import JointPlan
from dxlrun.plan.robot_plan import Plan
from dxlsim.simulation_plan import NO_LOAD
from dxlwire.bus_plan import BusPlan, ServoPlan
from dxlwire.port.latency_timer import is_simulated

SUFFIX = ".kept"
_POLL_S = 0.1
_WRITING_TIMEOUT_S = 10.0
"""Longest wait for the disk at the end of a run, s."""


def state_directory(plan: Plan) -> Path | None:
    """Return the directory of the states of a robot's controllers; None without a home directory.

    The directory is `$XDG_STATE_HOME/dxlrun/ROBOT` (XDG Base Directory Specification; ~/.local/state by
    default), and `simulated` in it for simulated servos, including those of `dxlrun sim`: states learned in a
    simulation are not valid for real servos. A run that omits joints has a directory of its own in it,
    so that it does not replace what was learned with all joints.
    """
    named = Path(os.environ.get("XDG_STATE_HOME", ""))
    try:
        home = named if named.is_absolute() else Path.home() / ".local/state"
    except RuntimeError:
        return None
    robot = home / "dxlrun" / plan.robot
    if any(is_simulated(bus.port) for bus in plan.buses):
        robot /= "simulated"
    return robot / f"without-{_short(plan.omitted)}" if plan.omitted else robot


def read_states(plan: Plan, directory: Path | None) -> KeptStates:
    """Read the states that a robot's controllers kept in earlier runs; unreadable ones have a `problem`.

    Never raises.
    """
    files: dict[str, KeptFile] = {}
    if directory is not None:
        # Without a directory, no state was kept.
        with suppress(OSError):
            for path in sorted(directory.glob(f"*{SUFFIX}")):
                files[path.stem] = _read(path)
    return KeptStates(files, _facts_by_joint(plan))


def _facts_by_joint(plan: Plan) -> dict[str, Facts]:
    """Return the facts about the servos of each joint on which a kept state depends, by joint name."""
    servos, found = plan.servos_by_joint, dict[str, Facts]()
    for row, joint in enumerate(plan.loop.joints):
        mine = servos[joint.name]
        if len(mine) == 1:
            found[joint.name] = _facts(plan, joint, *mine[0])
            continue
        facts = {"mechanics": _short(plan.mechanics.moving(row))}
        for bus, servo in mine:
            of_one = _facts(plan, joint, bus, servo)
            facts |= {f"{key} of {servo.own_name}": value for key, value in of_one.items()}
        found[joint.name] = facts
    return found


def _facts(plan: Plan, joint: JointPlan, bus: BusPlan, servo: ServoPlan) -> Facts:
    """Return the facts about one servo of a joint that the plan has.

    Its firmware is only known after a read.
    """
    # An offset that the robot file declares belongs to the servo's count, not to the joint.
    reference = servo.reference if servo.unplaced_reference is None else servo.unplaced_reference
    facts = {
        "servo": "simulated" if is_simulated(bus.port) else "real",
        "model": servo.model,
        "ID": f"{servo.servo_id} on bus {bus.name}",
        "direction": str(servo.direction),
        "reference": f"{reference!r} rad",
    }
    if servo.ratio != 1.0:
        facts["ratio"] = repr(servo.ratio)
    facts |= {item: str(value) for item, value in servo.declared.items()}
    facts["motor file"] = _short(joint.motor)
    # For servos on a pseudo-terminal, only the other process has these figures.
    if bus.port == "sim":
        simulation = plan.simulation
        load = simulation.loads.get(joint.name, NO_LOAD)
        facts["load"] = f"{load.inertia:g} kg m^2, {load.friction:g} Nm, {load.gravity or load.steady:g} Nm"
        name = servo.own_name
        others = (simulation.motors.get(name), simulation.times.get(name), load.gravity_angle)
        facts["simulation"] = _short(others)
    return facts


def _short(many: object) -> str:
    """Return a checksum as text that stands for many figures; `none` for None."""
    return "none" if many is None else f"{crc32(repr(many).encode()):08x}"


def _read(path: Path) -> KeptFile:
    try:
        # O_NONBLOCK, because a device or a pipe with this name must not block the start.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        with open(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                return KeptFile(str(path), problem="the state's path is not a regular file")
            state, made_with = opened_file(file.read(LONGEST_FILE + 1), path.stem)
    except OSError as error:
        return KeptFile(str(path), problem=f"the state's file cannot be read: {error.strerror or error}")
    except ValueError as error:
        return KeptFile(str(path), problem=f"the state's file {error}")
    return KeptFile(str(path), state, made_with)


class KeptFiles:
    """Joins kept states from the loop's messages, and writes each to the file of its controller."""

    def __init__(self, directory: Path | None) -> None:
        self._directory = directory
        self._topic = -1
        self._assembly: Assembly | None = None
        self.problems: dict[str, str] = {}
        """Reasons why the newest state of a controller is not in its file, by controller."""

    def process_record(self, kind: int, payload: Payload) -> None:
        """Process a record of the loop's message ring. Other topics are ignored. Never raises."""
        # The recorder reports damaged records.
        with suppress(ValueError):
            found = decode(payload) if kind == RecordKind.TAGGED else None
            if isinstance(found, OpenedTopic) and found.topic.name == TOPIC:
                self._topic, self._assembly = found.number, Assembly(Codec(found.topic.type))
            elif (
                isinstance(found, TopicRecord)
                and found.topic == self._topic
                and self._assembly
                and (whole := self._assembly.add_piece(found.data))
            ):
                self._write_file(*whole)

    def _write_file(self, controller: str, data: bytes) -> None:
        try:
            opened_file(data, controller)
            if self._directory is None:
                raise OSError("this user has no home directory")
            replace_file(self._directory, f"{controller}{SUFFIX}", data)
        except OSError as error:
            self.problems[controller] = f"{error.strerror or error}"
        except ValueError as error:
            self.problems[controller] = f"the state from the loop {error}"
        else:
            self.problems.pop(controller, None)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences for the user about states that were not written, at the end of the run."""
        problems = dict(self.problems)
        for controller in self._assembly.unfinished if self._assembly else ():
            problems[controller] = "the loop ended before it was complete"
        where = self._directory or "~/.local/state"
        return tuple(
            f"the last state of {controller} was not saved in {where}: {why}"
            for controller, why in problems.items()
        )


def replace_file(directory: Path, name: str, data: bytes) -> None:
    """Replace the content of a file with `data`, atomically even in a power failure. Raises OSError.

    Temporary files of killed processes are removed.
    """
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    for left in directory.glob(f".{name}.*"):
        with suppress(OSError):
            if not Path(f"/proc/{left.suffix[1:]}").exists():
                left.unlink()
    beside = directory / f".{name}.{os.getpid()}"
    descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
    try:
        with open(descriptor, "wb", buffering=0) as file:
            rest = memoryview(data)
            while rest:
                rest = rest[file.write(rest) :]
            os.fsync(descriptor)
        beside.replace(directory / name)
    except BaseException:
        with suppress(OSError):
            beside.unlink()
        raise
    entry = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(entry)
    finally:
        os.close(entry)


class KeptStateWriter(threading.Thread):
    """Thread that reads kept states from the ring of the loop's messages and writes their files.

    A disk may block for seconds, and the main thread must wait for signals: a second Ctrl-C cuts torque.
    """

    def __init__(self, ring: int, files: KeptFiles) -> None:
        super().__init__(name="kept states", daemon=True)
        self._ring = RingReader(ring)
        self._files = files
        self._ended = threading.Event()

    def run(self) -> None:
        """Write states until `write_remaining` is called and all records are read."""
        while not self._ended.wait(_POLL_S):
            self._drain()
        self._drain()

    def _drain(self) -> None:
        while (record := self._ring.read_record()) is not None:
            # Pieces after a gap do not fit together and are ignored later.
            if not isinstance(record, Gap):
                self._files.process_record(record.kind, record.payload)

    def write_remaining(self) -> tuple[str, ...]:
        """Write the remaining states after the end of the loop; return sentences about problems."""
        self._ended.set()
        self.join(_WRITING_TIMEOUT_S)
        if self.is_alive():
            return ("the disk is too slow: the last states of controllers were not saved",)
        return self._files.sentences
