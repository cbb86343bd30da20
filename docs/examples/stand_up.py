"""A state machine above the fall reflex of robots/stand_up.yaml: it walks, falls, gets up, and walks again.

    dxlrun robots/stand_up.yaml                  in one terminal
    python docs/examples/stand_up.py             in another one
    dxlrun send push play motion=forward        in a third one; or motion=backward

    walking --fall--> lying --side--> getting up --upright--> walking
                        | ^--------- still lying
                        '--three tries--> given up, limp

The reflex acts in the robot's loop, within 30 ms, whatever this program does. All that this one awaits are
goals: that of the walk ends when the reflex takes the joints away from it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from dxlrun import Refused, RemoteRobot, connect

PLAYERS = {"push", "walk", "curl", "get_up"}
TRIES = 3
LYING = math.radians(60)


class StandUp:
    """Lets one robot walk, and gets it up."""

    def __init__(self, robot: RemoteRobot) -> None:
        self.robot = robot
        self.tries = 0

    def states(self) -> Iterator[str]:
        """Yield each state when it begins, until the robot is to walk no more."""
        actions = {"walking": self.walk, "lying": self.lie, "getting up": self.get_up}
        state = "walking"
        self.let("walk", "push")
        while state in actions:
            yield state
            try:
                state = actions[state]()
            except Refused:  # the reflex was quicker than this program
                state = "lying"
        if state == "given up":
            self.robot.torque("all", False, release=True)
        yield state

    def walk(self) -> str:
        """Walk until something takes the joints: the reflex, or an operator."""
        self.tries = 0
        self.play("walk", "walk")
        return "lying" if self.source("fall")["fallen"] else "stopped"

    def lie(self) -> str:
        """Come to rest, curled up."""
        self.tries += 1
        if self.tries > TRIES:
            return "given up"
        self.let("curl", "push")
        self.play("curl", "curl")
        return "getting up"

    def get_up(self) -> str:
        """Play the motion for the side on which the robot lies."""
        imu = self.source("imu")
        x, y, z, w = (imu[f"orientation.{axis}"] for axis in "xyzw")
        pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
        if abs(pitch) > LYING:  # else it lies on its side, or leans somewhere
            self.let("get_up")
            self.play("get_up", "from_front" if pitch > 0 else "from_back")
        if self.source("fall")["fallen"]:
            return "lying"
        self.let("walk", "push")
        return "walking"

    def let(self, *players: str) -> None:
        """Let these players have the joints, in one cycle, and no others."""
        active = {one["name"] for one in self.robot.info()["controllers"] if one["active"]} & PLAYERS
        if active != {*players}:
            self.robot.switch(sorted({*players} - active), sorted(active - {*players}))

    def play(self, controller: str, motion: str) -> None:
        """Play a motion to its end, or until its controller loses the joints."""
        goal = self.robot.send(controller, "play", {"motion": motion}).goal
        if goal is not None:
            goal.wait()

    def source(self, name: str) -> dict[str, float]:
        """Return the states of a sensor or controller by their names."""
        states = self.robot.states()
        pairs = zip(states.source_states, states.source_state.tolist(), strict=True)
        return {full.partition("/")[2]: value for full, value in pairs if full.startswith(f"{name}/")}


if __name__ == "__main__":
    with connect("stand_up", client="stand up") as robot:
        for state in StandUp(robot).states():
            print(state, flush=True)
