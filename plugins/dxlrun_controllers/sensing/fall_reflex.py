"""fall_reflex: lets controllers take over, in one cycle, when the robot tips over."""

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
"""The lowest and the highest angle, rad."""


class FallParameters(ParametersModel):
    """Keys of a fall_reflex in the robot file."""

    imu: str
    """Name of the controller, sensor or device that has the orientation."""
    activate: Annotated[tuple[str, ...], Field(min_length=1)]
    """Controllers that take over; those that command the same leave."""
    roll: Bounds = (-math.pi / 4, math.pi / 4)
    """Lowest and highest angle; beyond it the robot tips over."""
    pitch: Bounds = (-math.pi / 4, math.pi / 4)
    """rad; of the link, positive forward. Beyond these the robot falls."""
    time: Duration = 60_000_000
    """ns; for so long before it counts"""
    rearm: Duration = 1_000_000_000
    """ns; so long within the bounds, and the next fall counts again"""
    timeout: Annotated[Duration, Field(gt=0)] = 200_000_000
    """ns; an older orientation says nothing"""
    on_silence: Literal["report", "activate"] = "report"
    """What becomes of an orientation that stays out so long: an event, or the controllers take over too."""

    def mistakes(self) -> Iterator[Mistake]:
        """Yield the angles that are not around 0."""
        yield from super().mistakes()
        for name, (lower, upper) in (("roll", self.roll), ("pitch", self.pitch)):
            if not lower < 0 < upper:
                what = f"{name} is from an angle below 0 to one above"
                yield (name,), f"{what}; write for example [-45 deg, 45 deg]"


class FallReflex(Controller[FallParameters]):
    """Watches roll and pitch; claims nothing. Provides `fallen`: 1 from a fall on, until upright again.

    Takes over once for each fall: while the robot lies, other controllers may be activated to get it up.
    Only a fresh orientation counts: an old one, or a quaternion of zeros, does not trigger it.
    """

    Parameters = FallParameters

    @classmethod
    def interfaces(cls, parameters: FallParameters, joints: tuple[str, ...]) -> Interfaces:
        """Read the orientation."""
        return Interfaces(
            (),
            reads=tuple(f"{parameters.imu}/{name}" for name in (*ORIENTATION, "age")),
            provides=("fallen",),
            takeovers=parameters.activate,
        )

    def on_activate(self, time_ns: int) -> None:
        """Begin upright: a robot that lies falls anew."""
        self._fallen = self._silent = False
        self._since_ns = -1
        self._heard_ns = time_ns

    def update(self, time_ns: int, period_ns: int) -> None:
        """Compare the orientation with the bounds."""
        x, y, z, w, age_s = self.context.reads.tolist()
        parameters = self.parameters
        square = x * x + y * y + z * z + w * w  # a unit of its own may send zeros, or no unit quaternion
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
        if within != self._fallen:  # as it was
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
        silence = f"no orientation of {parameters.imu} for {parameters.timeout * 1e-9:g} s"
        if parameters.on_silence == "activate" and not self._fallen:
            self.context.take_over(parameters.activate, silence)
        else:
            self.context.say(f"{silence}: a fall would not be seen")
