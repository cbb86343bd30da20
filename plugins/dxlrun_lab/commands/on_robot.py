"""Experiments of commands on a robot: common options, choice of the robot, confirmation, countdown, abort.

dxlrun characterize robots/single_joint.yaml port:=/dev/ttyUSB0 joint --range joint=-20deg..20deg
dxlrun identify elbow --robot arm
"""

from __future__ import annotations

import math
import os
import select
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Generic, NamedTuple, TypeVar

import msgspec
from cyclopts import Parameter
from msgspec.structs import replace

from dxlrun import DxlrunError, InputError
from dxlrun.tooling.output import counted, err, print_error, print_warning
from dxlrun.tooling.verbs import DebugFlag, Flag, JsonFlag, compiled

if TYPE_CHECKING:
    from dxlrun.tooling.plans import Plan
    from dxlrun_lab.guided.experiment import Experiment, ExperimentOutcome, Situation
    from dxlrun_lab.guided.rig import Rig
    from dxlrun_lab.guided.segment import Segment

R = TypeVar("R")
COUNTDOWN_S = 3, 1.0
"""Countdown before a real joint moves: number of counts, and duration of each, s"""
_LOOK_S = 0.1
INTERRUPTED = 130
NOTHING_MOVED = "nothing was moved"

Words = Annotated[str, Parameter(name="[ROBOT.yaml [arg:=value ...]] JOINT")]


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class ExperimentOptions:
    """Robot and ranges of its joints, confirmation, and form of the output.

    Parameters
    ----------
    range
        Range of a joint: JOINT=-30deg..30deg. Can be given several times. Default: 30 deg to each side of the
        present position, within the joint's limits.
    robot
        Name of the robot, if several run and no robot file is given.
    virtual
        Run on virtual time, with simulated servos. Requires a robot file.
    yes
        Do not ask for confirmation before a real joint moves. The countdown remains.
    report
        HTML file for a report with all numbers and plots.
    """

    range: Annotated[tuple[str, ...], Parameter(negative=(), show_default=False)] = ()
    robot: str | None = None
    virtual: Flag = False
    yes: Flag = False
    report: Path | None = None
    as_json: JsonFlag = False
    debug: DebugFlag = False


DEFAULTS = ExperimentOptions()


class RobotFileArguments(NamedTuple):
    """Parsed arguments of a command: `[ROBOT.yaml [arg:=value ...]] JOINT ...`"""

    file: Path | None
    """Robot file; None for a running robot"""
    assignments: tuple[str, ...]
    """Arguments of the robot file: `arg:=value`"""
    joints: tuple[str, ...]

    @classmethod
    def parse_words(cls, words: Sequence[str]) -> RobotFileArguments:
        """Split the words of a command line. Raises InputError for `arg:=value` without a robot file."""
        rest = list(words)
        file = None
        if rest and (rest[0].endswith((".yaml", ".yml")) or os.sep in rest[0]):
            file = Path(rest.pop(0))
        assignments = tuple(word for word in rest if ":=" in word)
        joints = tuple(word for word in rest if ":=" not in word)
        if assignments and file is None:
            raise InputError(
                f"{assignments[0]} is an argument of a robot file, but no file is given; "
                "write ROBOT.yaml first"
            )
        return cls(file, assignments, joints)


class ExperimentRun(msgspec.Struct, Generic[R], frozen=True):
    """Outcome of an experiment on a robot: its result, and how it ended"""

    result: R | None
    """Result of the experiment; None if nothing was recorded"""
    robot: str
    log: Path | None
    """Log of the run"""
    why: str
    """Reason for an early end, one sentence; empty on success"""
    problems: tuple[str, ...]
    """State that was not restored, and errors of a run that the command started"""
    interrupted: bool
    """True if the user aborted or did not confirm"""

    @property
    def failures(self) -> tuple[str, ...]:
        """Reason for an early end, and problems; empty on success"""
        return (*filter(None, (self.why,)), *self.problems)

    @property
    def exit_code(self) -> int:
        """Exit code: 0 success, 1 early end or state not restored, 130 aborted"""
        return INTERRUPTED if self.interrupted else int(bool(self.why or self.problems))


class Course(msgspec.Struct, frozen=True):
    """Settings of `perform_on` in which an experiment and the playback of a recorded motion differ"""

    name: str = "the experiment"
    """Name in messages"""
    ranges: Mapping[str, tuple[float, float]] | None = {}
    """Ranges of joints by `--range`, rad; None for their limits"""
    back: bool = True
    """True if the joints move back to their start at the end"""
    expected: tuple[str, ...] | None = None
    """Sentences that describe the motions before a run is started; None for joints and their ranges"""


def run_on_robot(
    experiment: Experiment[R], words: Sequence[str], options: ExperimentOptions = DEFAULTS
) -> ExperimentRun[R]:
    """Perform an experiment on the robot, the joints and the ranges of a command line. See perform_on."""
    from dxlrun_lab.guided.choice import parse_ranges

    chosen = RobotFileArguments.parse_words(words)
    ranges = parse_ranges(options.range)
    return perform_on(experiment, chosen, _plan_of(chosen, ranges, options), options, Course(ranges=ranges))


def perform_on(
    experiment: Experiment[R],
    chosen: RobotFileArguments,
    plan: Plan | None,
    options: ExperimentOptions,
    course: Course,
) -> ExperimentRun[R]:
    """Perform an experiment with confirmation, countdown and abort, and return its outcome.

    The run of `plan` is started for it; without a plan, the running robot is used.

    Progress is printed to stderr, and the caller shows the result. The confirmation for real joints precedes
    the start of a run, because a run enables torque.

    Raises:
        InputError: The arguments are invalid. Nothing has moved.
    """
    from dxlrun_lab.guided.choice import situation_of, whole_situation
    from dxlrun_lab.guided.experiment import ExperimentOutcome, perform_experiment

    with AbortMonitor() as aborting:
        if plan is not None and not _start_confirmed(plan, chosen.joints, options, course, aborting):
            nothing = ExperimentOutcome((), aborting() or NOTHING_MOVED)
            return _ended(
                ExperimentRun(None, plan.robot, None, nothing.why, (), interrupted=True), nothing, course
            )
        rig = _rig(chosen, plan, options, aborting)
        if rig is None:
            return ExperimentRun(
                None, plan.robot if plan else "", None, aborting() or "", (), interrupted=True
            )
        performed, result = None, None
        try:
            if course.ranges is None:
                situation = whole_situation(rig, chosen.joints)
            else:
                situation = situation_of(rig, chosen.joints, course.ranges)
                _announce(situation)
            sys.stderr.write("".join(f"{line}\n" for line in experiment.describe_motions(situation)))
            # A run that was started here has been confirmed already.
            if plan is not None or _confirmed(rig.plan, options, aborting):
                with aborting.by_any_key():
                    if _counted_down(situation, options, aborting):
                        performed = perform_experiment(
                            rig, experiment, situation, aborting, _show, back=course.back
                        )
        finally:
            try:
                ended = tuple(rig.close())
            except DxlrunError as error:
                ended = error.sentences
    interrupted = aborting.reason is not None or performed is None
    performed = performed or ExperimentOutcome((), aborting() or NOTHING_MOVED)
    if performed.recorded:
        try:
            with err().status("computing the result"):
                result = experiment.evaluate_recordings(situation, performed.recorded, performed.why)
        except KeyboardInterrupt:  # the computation can take long
            print_error(f"{rig.plan.robot}: the measurements are in {rig.log}")
            raise
        except DxlrunError as error:
            if not performed.why:
                raise
            ended = (*error.sentences, *ended)  # an incomplete recording may have no result
    problems = (*performed.not_restored, *ended)
    ran = ExperimentRun(result, rig.plan.robot, rig.log, performed.why, problems, interrupted)
    return _ended(ran, performed, course)


def _ended(ran: ExperimentRun[R], performed: ExperimentOutcome, course: Course) -> ExperimentRun[R]:
    """Print to stderr why an experiment ended early, and what was not restored; return the outcome."""
    if ran.why:
        kept = len(performed.recorded) if course.ranges is not None else 0
        left = f"; {counted(kept, 'segment', 'segments')} measured before" if kept else ""
        print_error(f"{ran.robot}: {course.name} ended early: {ran.why}{left}")
    for problem in ran.problems:
        print_warning(f"{ran.robot}: {problem}")
    return ran


def _plan_of(
    chosen: RobotFileArguments, ranges: Mapping[str, tuple[float, float]], options: ExperimentOptions
) -> Plan | None:
    """Compile the chosen robot file to a plan, or return None without a file. Raises InputError for mistakes
    in joints, ranges and options."""
    from dxlrun_lab.guided.choice import check_joints

    if chosen.file is not None:
        if options.robot is not None:
            raise InputError("--robot (a running robot) and a robot file exclude each other; omit one")
        plan = compiled(chosen.file, chosen.assignments, (), None).plan
        check_joints(chosen.joints, ranges, plan.loop.joints)
        return plan
    if options.virtual:
        raise InputError("--virtual needs a robot file; write ROBOT.yaml before the joints")
    return None


def _rig(
    chosen: RobotFileArguments, plan: Plan | None, options: ExperimentOptions, aborting: AbortMonitor
) -> Rig | None:
    """Return access to the run: on virtual time, started as a child process, or already running (no plan).
    Returns None if the user aborted while it started."""
    from dxlrun_lab.guided.own_run import OwnRun
    from dxlrun_lab.guided.rig import live_rig, require_whole

    if plan is None:
        from dxlrun import connect

        return live_rig(connect(options.robot, "experiment"))
    if options.virtual:
        from dxlrun.tooling.plans import RecordingPlan
        from dxlrun.tooling.runs import discard_log, new_log
        from dxlrun_lab.guided.virtual_rig import virtual_rig

        recording = RecordingPlan(plan.recording.directory)  # one complete file, because it is evaluated
        log = new_log(recording, plan.robot)
        try:
            return virtual_rig(replace(plan, recording=recording), log=log)
        except DxlrunError:
            discard_log(log)
            raise
    if not plan.gateway:
        raise InputError(
            f"{chosen.file} disables the gateway, but an experiment needs the gateway; "
            "write `processes: {gateway: {enabled: true}}`"
        )
    require_whole(plan.recording, str(chosen.file))
    run = OwnRun([str(chosen.file), *chosen.assignments])
    try:
        sys.stderr.write(f"{plan.robot}: starting\n")
        robot = run.listening(aborting)
        if robot is not None:
            return live_rig(robot, run)
    except BaseException:
        run.end_run()
        raise
    run.end_run()
    print_error(f"{plan.robot}: {aborting()}; nothing was moved")
    return None


# Before anything moves


def _announce(situation: Situation) -> None:
    lines = []
    for joint in situation.joints:
        lower, upper, at = (f"{math.degrees(value):.4g}" for value in (joint.lower, joint.upper, joint.start))
        lines.append(
            f"{joint.plan.label} moves within {lower} to {upper} deg ({joint.chosen}); it is at {at} deg"
        )
    sys.stderr.write("".join(f"{line}\n" for line in lines))


def _real(plan: Plan, options: ExperimentOptions) -> bool:
    return not options.virtual and any(bus.port != "sim" for bus in plan.buses)


def _start_confirmed(
    plan: Plan, names: Sequence[str], options: ExperimentOptions, course: Course, aborting: AbortMonitor
) -> bool:
    """Describe the motions and ask for confirmation before a run is started. Return True if confirmed. No
    question is asked if no real joint will move."""
    from dxlrun_lab.guided.choice import range_text

    if not _real(plan, options):
        return True
    joints = {joint.name: joint for joint in plan.loop.joints}
    lines = course.expected or [
        f"{joints[name].label} will move within {range_text(joints[name], (course.ranges or {}).get(name))}, "
        f"at up to {math.degrees(joints[name].highest_speed):.0f} deg/s"
        for name in names
    ]
    sys.stderr.write("".join(f"{line}\n" for line in lines))
    sys.stderr.write(f"{plan.robot} will start now and enable torque as in its file\n")
    return _confirmed(plan, options, aborting)


def _confirmed(plan: Plan, options: ExperimentOptions, aborting: AbortMonitor) -> bool:
    """Ask for confirmation before a real joint moves; return False if it is declined or aborted.

    Simulated servos and --yes need no confirmation.

    Raises:
        InputError: stdin is not a terminal and --yes was not given.
    """
    if options.yes or not _real(plan, options):
        return True
    if not sys.stdin.isatty():
        raise InputError(
            f"{plan.robot} has real servos, and their motion cannot be confirmed without a terminal "
            "(nothing was moved); add --yes"
        )
    sys.stderr.write("Keep clear of the robot, and have its power switch at hand. Continue? [y/N] ")
    sys.stderr.flush()
    while aborting() is None:
        if select.select([sys.stdin], [], [], _LOOK_S)[0]:
            return sys.stdin.readline().strip().lower() in ("y", "yes")
    return False


def _counted_down(situation: Situation, options: ExperimentOptions, aborting: AbortMonitor) -> bool:
    """Count down before a real joint moves. Return False if the user aborted."""
    if aborting.has_keys:
        sys.stderr.write("any key ends the experiment: the joints stop, and the run is restored\n")
    if not _real(situation.plan, options):
        return aborting() is None
    names = ", ".join(situation.names)
    numbers, each_s = COUNTDOWN_S
    for left in range(numbers, 0, -1):
        sys.stderr.write(f"{names} will move in {left} ...\n")
        sys.stderr.flush()
        until = time.monotonic() + each_s
        while time.monotonic() < until:
            if aborting() is not None:
                return False
            time.sleep(_LOOK_S)
    return True


def _show(segment: Segment, number: int) -> None:
    sys.stderr.write(f"{number:3}  {segment.title} ({segment.duration_s:.1f} s)\n")
    sys.stderr.flush()


# What ends it


class AbortMonitor:
    """Abort of an experiment by Ctrl-C, SIGTERM, SIGHUP, or any key if stdin is a terminal.

    It is polled ten times a second. A SIGHUP that is ignored (nohup) stays ignored.
    """

    def __init__(self) -> None:
        self.reason: str | None = None
        self.has_keys = self._keys = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> AbortMonitor:
        """Install handlers of the signals that abort, which only note the reason."""
        self.has_keys = sys.stdin.isatty()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._handle_signal)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous signal handlers."""
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # what signal() returned

    def _handle_signal(self, number: int, frame: FrameType | None) -> None:
        # No import here, because the signal may interrupt an import of the same module.
        name = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
        self.reason = self.reason or f"aborted by {name}"

    @contextmanager
    def by_any_key(self) -> Iterator[None]:
        """Let any key abort in this context. The terminal, if there is one, is restored afterwards."""
        if not self.has_keys:
            yield
            return
        import termios  # not at the top, because logs are also replayed on systems without it
        import tty

        descriptor = sys.stdin.fileno()
        before = termios.tcgetattr(descriptor)
        try:
            tty.setcbreak(descriptor)
            self._keys = True
            yield
        finally:
            self._keys = False
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)

    def __call__(self) -> str | None:
        """Return the reason why the user aborted the experiment, or None; polls the keys."""
        if self.reason is None and self._keys and select.select([sys.stdin], [], [], 0)[0]:
            # An empty read means that the terminal was closed, so no key could abort.
            self.reason = "aborted by a key" if os.read(sys.stdin.fileno(), 64) else "the terminal was closed"
        return self.reason
