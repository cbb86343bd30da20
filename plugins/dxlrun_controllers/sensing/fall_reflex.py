"""fall_reflex: switch to other controllers, within one cycle, when the robot tips over."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from dxlrun import (
    Angle,
    Controller,
    Duration,
    Interfaces,
    Mistake,
    ParametersModel,
)
from dxlrun_controllers.sensing.imu_sensor_broadcaster import ORIENTATION

Bounds = Annotated[tuple[Angle, ...], Field(min_length=2, max_length=2)]
"""Lowest and highest angle, rad."""


class FallParameters(ParametersModel):
    """Keys of a fall_reflex in the robot file."""

    imu: str = Field(examples=["imu"])
    """Name of the controller, sensor or device that provides the orientation."""
    activate: Annotated[tuple[str, ...], Field(min_length=1, examples=["[get_up]"])]
    """Controllers that take over. Controllers with the same claims are deactivated."""
    roll: Bounds = (-math.pi / 4, math.pi / 4)
    """Lowest and highest roll of the link, rad. Beyond these the robot falls."""
    pitch: Bounds = (-math.pi / 4, math.pi / 4)
    """Lowest and highest pitch of the link, rad, positive forward. Beyond these the robot falls."""
    time: Duration = 60_000_000
    """Time beyond the bounds after which a fall is detected."""
    rearm: Duration = 1_000_000_000
    """Time within the bounds after which the next fall can be detected."""
    timeout: Annotated[Duration, Field(gt=0)] = 200_000_000
    """Age above which an orientation is ignored."""
    on_silence: Literal["report", "activate"] = "report"
    """Reaction to a missing orientation after `timeout`: an event, or the controllers take over as well."""

    def mistakes(self) -> Iterator[Mistake]:
        """Yield bounds of roll or pitch that do not include 0."""
        yield from super().mistakes()
        for name, (lower, upper) in (("roll", self.roll), ("pitch", self.pitch)):
            if not lower < 0 < upper:
                what = f"the range of {name} does not enclose 0"
                yield (name,), f"{what}; write for example [-45 deg, 45 deg]"


class FallReflex(Controller[FallParameters]):
    """Controller that detects falls by roll and pitch, and switches to other controllers.

    It claims nothing, and provides `fallen`: 1 from a fall until the robot is upright again. It switches
    controllers once per fall, so other controllers can be activated to get the robot up. An old orientation
    or a quaternion of zeros does not trigger it.
    """

    Parameters = FallParameters

    @classmethod
    def interfaces(cls, parameters: FallParameters, joints: tuple[str, ...]) -> Interfaces:
        """Read the orientation of `imu` and its age, and provide `fallen`."""
        return Interfaces(
            (),
            reads=tuple(f"{parameters.imu}/{name}" for name in (*ORIENTATION, "age")),
            provides=("fallen",),
            takeovers=parameters.activate,
        )

    def on_activate(self, time_ns: int) -> None:
        """Assume that the robot is upright; if it is lying, the reflex triggers again."""
        self._fallen = self._silent = False
        self._since_ns = -1
        self._heard_ns = time_ns

    def update(self, time_ns: int, period_ns: int) -> None:
        """Detect a fall, or that the robot is upright again, from the orientation of this cycle."""
        x, y, z, w, age_s = self.context.reads.tolist()
        parameters = self.parameters
        square = x * x + y * y + z * z + w * w  # a device may send zeros, or a quaternion of another length
        if 0.0 < square < math.inf and age_s * 1e9 <= parameters.timeout:
            self._heard_ns, self._silent = time_ns, False
            roll = math.atan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
            pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x) / square)))
            self._judge(roll, pitch, time_ns)
        else:
            self._since_ns = -1
            if not self._silent and time_ns - self._heard_ns >= parameters.timeout:
                self._silent = True
                self._report_silence()
        self.context.provided[0] = self._fallen

    def _judge(self, roll: float, pitch: float, time_ns: int) -> None:
        parameters = self.parameters
        within = (
            parameters.roll[0] <= roll <= parameters.roll[1]
            and parameters.pitch[0] <= pitch <= parameters.pitch[1]
        )
        if within != self._fallen:  # no change
            self._since_ns = -1
            return
        if self._since_ns < 0:
            self._since_ns = time_ns
        if time_ns - self._since_ns < (parameters.rearm if within else parameters.time):
            return
        self._fallen, self._since_ns = not within, -1
        posture = f"roll {round(math.degrees(roll))} deg, pitch {round(math.degrees(pitch))} deg"
        if within:
            self.context.say(f"upright again ({posture}): the next fall counts")
        else:
            self.context.take_over(parameters.activate, f"falls with {posture}")

    def _report_silence(self) -> None:
        parameters = self.parameters
        silence = f"no orientation from {parameters.imu} for {parameters.timeout * 1e-9:g} s"
        if parameters.on_silence == "activate" and not self._fallen:
            self.context.take_over(parameters.activate, silence)
        else:
            self.context.say(f"{silence}: falls are not detected")
