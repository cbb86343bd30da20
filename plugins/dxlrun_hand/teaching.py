"""`dxlrun teach`: the user moves limp joints of a running robot by hand, and the robot plays that motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from dxlrun import GoalState, InputError, JointUnit, Refused, RemoteRobot, ServoFault
from dxlrun.tooling.files import suggestion
from dxlrun.tooling.output import write_target
from dxlrun.tooling.plans import ControllerPlan
from dxlrun.tooling.verbs import cancel_goals
from dxlrun_analysis.playback.motion_file import player_of
from dxlrun_analysis.playback.recorded_motion import Floats
from dxlrun_hand.dialogue import Dialogue, ending_with, yes
from dxlrun_hand.taught_motion import TaughtJoints, TaughtMotion

LONGEST_AGE_NS = 1_000_000_000
"""Age of a joint's newest position above which its servo counts as lost, ns."""
HELP = "Enter: add this pose; r: record a motion; u: undo; limp NAME, hold NAME; s: save; q: quit"


class Teaching:
    """Dialogue that teaches one motion to a running robot, and restores torque and controllers afterwards."""

    def __init__(
        self, robot: RemoteRobot, dialogue: Dialogue, words: Sequence[str], way_speed: float
    ) -> None:
        """Select the joints to teach. Nothing changes on the robot.

        Args:
            robot: Connection to the running robot.
            dialogue: Dialogue with the user.
            words: Joints, groups and controllers that become limp; empty for all.
            way_speed: Speed between two poses, rad/s.

        Raises:
            InputError: A word is unknown, or a joint has no active controller that plays motions.
        """
        self._robot, self._dialogue = robot, dialogue
        info = cast("Mapping[str, Any]", robot.info())
        self._groups = _groups(info)
        wrong = [word for word in words if word not in self._groups]
        if wrong:
            names = [f"{robot.name} has no joint {word}; {suggestion(word, self._groups)}" for word in wrong]
            raise InputError("\n".join(names))
        asked = {joint for word in words or ("all",) for joint in self._groups[word]}
        self._plans = tuple(map(_plan, info["controllers"]))
        players = {joint: player_of(joint, self._plans) for joint in info["joints"] if joint in asked}
        if lacking := [joint for joint, player in players.items() if player is None]:
            if words:
                raise InputError(
                    f"no active controller of {robot.name} plays motions for {', '.join(lacking)}; activate "
                    "one with `dxlrun switch`, or name other joints"
                )
            asked.difference_update(lacking)
        if not asked:
            raise InputError(
                f"no active controller of {robot.name} plays motions; activate one with `dxlrun switch`"
            )
        moved = {joint for plan in self._plans if plan.name in players.values() for joint in plan.joints}
        joints = tuple(joint for joint in info["joints"] if joint in moved)
        ends = [info["limits"].get(joint, (-math.inf, math.inf)) for joint in joints]
        self._asked = [joint for joint in joints if joint in asked]
        self._taught = TaughtJoints(
            joints,
            tuple(JointUnit(info["units"][joint]) for joint in joints),
            np.array([lower for lower, _ in ends]),
            np.array([upper for _, upper in ends]),
            np.array([info["speeds"][joint] or math.inf for joint in joints]),
            way_speed,
        )
        self.limp: list[str] = []
        """Joints that the dialogue made limp and that are still without torque."""
        self.released: list[str] = []
        """Controllers that the dialogue deactivated and that are still inactive."""

    def teach(self) -> list[TaughtMotion]:
        """Run the teaching dialogue; return the poses and motions, or an empty list if the user quits."""
        self._dialogue.ask_question(
            f"These joints become limp: {', '.join(self._asked)}. Hold them, and press Enter "
        )
        self._let_go(self._asked)
        shown: list[TaughtMotion] = []
        while True:
            typed = self._dialogue.ask_while(f"{len(shown)} taught. {HELP}", self._positions)
            verb, *names = typed.split() or [""]
            if verb in ("limp", "hold"):
                self._switch(verb, names)
            elif verb == "u" and shown:
                shown.pop()
            elif verb == "":
                shown.append(TaughtMotion(np.zeros(1), self._now()[1][None, :]))
            elif verb == "r":
                shown.append(self._recorded())
            elif verb == "s" and shown:
                return shown
            elif verb == "q":
                return []
            else:
                self._dialogue.print_lines(
                    f"  {typed!r} is not a command"
                    if shown
                    else "  nothing was taught yet; add a pose with Enter"
                )

    def save(self, shown: Sequence[TaughtMotion], target: Path) -> None:
        """Join the poses and motions to one within the joints' limits, and write it to a new motion file.

        Raises:
            InputError: The file cannot be written.
        """
        taught = self._taught
        for joint in taught.beyond(shown):
            self._dialogue.print_lines(
                f"  {joint} was moved beyond its limits; the motion stops at the limits."
            )
        motion, longer = taught.slowed(taught.joined(shown, target))
        if longer > 1.0:
            self._dialogue.print_lines(
                f"  The motion was faster than the joints may move; it now takes {longer:.2g} times as long."
            )
        origin = f"Taught by hand on {self._robot.name}.\nWritten by `dxlrun teach`."
        text = taught.text_of(motion, self._plans, origin)
        write_target(target, text)
        self._dialogue.print_lines(f"{target}: {motion.duration_s:.1f} s of {len(taught.joints)} joints")

    def hold_joints(self) -> None:
        """Enable the torque of all limp joints where they are, and activate their controllers again.

        The user is asked to hold the joints, again after each refusal by the robot.
        """
        while self.limp:
            self._dialogue.ask_question(
                "The torque will be switched on at the present positions: hold the joints, and press Enter "
            )
            self._try(self._hold, list(self.limp))
        self._robot.switch(activate=self.released)
        self.released = []

    def play_motion(self, motion: Path) -> bool:
        """Play a motion file with a slow start from the current positions, and wait for its end.

        Returns True if all goals were reached. Ctrl-C cancels the motion.
        """
        done = self._robot.play(motion)
        numbers = [goal.number for goal in done.goals]
        try:
            states: Sequence[GoalState] = [self._robot.wait(number) for number in numbers]
        except KeyboardInterrupt:
            cancel_goals(self._robot, numbers)
            raise
        self._dialogue.print_lines(*(f"  {state.describe_outcome()}" for state in states))
        return all(state.reached for state in states)

    def left(self) -> str:
        """Return a sentence with limp joints and deactivated controllers that remain; empty without any."""
        parts = []
        if self.limp:
            parts.append(f"still limp: {', '.join(self.limp)} (`dxlrun torque on {' '.join(self.limp)}`)")
        if self.released:
            names = " ".join(self.released)
            parts.append(
                f"still deactivated: {', '.join(self.released)} (`dxlrun switch --activate {names}`)"
            )
        return "; ".join(parts)

    # Joints

    def _let_go(self, names: Sequence[str]) -> None:
        joints = [joint for name in names for joint in self._groups[name] if joint not in self.limp]
        if joints:
            self.limp += joints  # Before the request: the joints can be limp even if the answer is lost
            try:
                self._robot.torque(joints, False, release=True)
            finally:  # A refusal by an unresponsive servo still leaves controllers deactivated
                self.released = self._deactivated()

    def _deactivated(self) -> list[str]:
        """Return the controllers that were active at the start and are not any more."""
        controllers = cast("Mapping[str, Any]", self._robot.info())["controllers"]
        inactive = {one["name"] for one in controllers if not one["active"]}
        return [plan.name for plan in self._plans if plan.active and plan.name in inactive]

    def _hold(self, names: Sequence[str]) -> None:
        joints = [joint for name in names for joint in self._groups[name] if joint in self.limp]
        if joints:
            self._robot.torque(joints, True)
            self.limp = [joint for joint in self.limp if joint not in joints]

    def _switch(self, verb: str, names: Sequence[str]) -> None:
        wrong = [name for name in names if name not in self._groups]
        if wrong or not names:
            what = f"no joint or group {', '.join(wrong)}" if wrong else "no joint or group given"
            self._dialogue.print_lines(f"  {what}; choose from {', '.join(self._groups)}")
            return
        self._try(self._let_go if verb == "limp" else self._hold, names)

    def _try(self, switch: Callable[[Sequence[str]], None], names: Sequence[str]) -> None:
        """Call `switch` (torque on or off) with names; print the reason if the robot refuses, such as a joint
        beyond its limits."""
        try:
            switch(names)
        except Refused as error:
            self._dialogue.print_lines(*(f"  {line}" for line in error.sentences))

    # Positions

    def _now(self) -> tuple[float, Floats]:
        """Return the time of the robot's newest cycle, s, and the positions of the taught joints in it.

        Raises:
            ServoFault: A joint does not answer any more.
        """
        states = self._robot.states()
        rows = [states.joints.index(joint) for joint in self._taught.joints]
        ages = states.age_ns[rows].tolist()
        for joint, age_ns in zip(self._taught.joints, ages, strict=True):
            if not 0 <= age_ns <= LONGEST_AGE_NS:
                raise ServoFault(f"{joint} no longer answers; nothing was saved")
        return states.time_ns * 1e-9, states.position[rows]

    def _positions(self) -> str:
        written = (
            f"{unit.number(value, digits=1, trim=False)}{unit.suffix}"
            for value, unit in zip(self._now()[1].tolist(), self._taught.units, strict=True)
        )
        return "  " + "  ".join(written)

    def _recorded(self) -> TaughtMotion:
        """Record the joints' positions until Enter; return the motion without standstill, smoothed."""
        times: list[float] = []
        positions: list[Floats] = []

        def show_time() -> str:
            time, position = self._now()
            if not times or time > times[-1]:
                times.append(time)
                positions.append(position)
            return f"  {times[-1] - times[0]:.1f} s"

        show_time()
        self._dialogue.ask_while("Recording: show the motion, then press Enter", show_time)
        show_time()
        shown = TaughtMotion(np.array(times) - times[0], np.array(positions))
        shown = self._taught.smoothed(self._taught.trimmed(shown))
        self._dialogue.print_lines(f"  {shown.time_s[-1]:.1f} s, without the pauses at both ends")
        return shown


def taught(
    robot: RemoteRobot, dialogue: Dialogue, words: Sequence[str], target: Path, way_speed: float
) -> int:
    """Teach a motion in a dialogue, save it as the motion file `target`, and play it after confirmation.

    Args:
        robot: Connection to the running robot.
        dialogue: Dialogue with the user.
        words: Joints, groups and controllers that become limp; empty for all.
        target: New motion file.
        way_speed: Speed between two poses, rad/s.

    Returns:
        Exit code: 0, or 1 if nothing was saved or the played motion missed a goal.
    """
    task = Teaching(robot, dialogue, words, way_speed)
    with ending_with(task.left):
        shown = task.teach()
        if shown:
            task.save(shown, target)
        task.hold_joints()
        if not shown:
            dialogue.print_lines("Nothing was saved.")
            return 1
        if not yes(dialogue, f"Play the motion on {robot.name}? It starts slowly."):
            return 0
        return 0 if task.play_motion(target) else 1


def _groups(info: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Return the joints that each name of a joint, group or controller, or `all`, stands for. `info` is that
    of `RemoteRobot.info`. Controllers without commands are omitted."""
    controllers = {one["name"]: tuple(one["joints"]) for one in info["controllers"] if one["command"]}
    groups = {name: tuple(joints) for name, joints in info["groups"].items()}
    return {"all": tuple(info["joints"]), **controllers, **groups, **{one: (one,) for one in info["joints"]}}


def _plan(one: Mapping[str, Any]) -> ControllerPlan:
    """Return a ControllerPlan from a controller's entry in `RemoteRobot.info`, with what a motion needs."""
    joints, command = tuple(one["joints"]), tuple(one["command"])
    return ControllerPlan(
        one["name"], one["type"], "", "{}", joints, command, (), active=one["active"], every=1
    )
