"""battery_state_broadcaster: warn of a low battery, and end the run or switch controllers in time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, ClassVar

from pydantic import Field

from dxlrun import (
    Context,
    Controller,
    Duration,
    Interfaces,
    Mistake,
    ParametersModel,
    Voltage,
)
from dxlrun.tooling.topics import messages

PUBLISH_NS = 1_000_000_000
"""Time between two messages of the topic `battery_state`, ns."""


class BatteryParameters(ParametersModel):
    """Keys of a battery_state_broadcaster in the robot file."""

    voltages: Annotated[tuple[str, ...], Field(min_length=1, examples=["[left_hip/voltage]"])]
    """States with the voltage of the battery: `left_hip/voltage` of a servo, `power/voltage` of a device. The
    median of several states is used."""
    current: str | None = None
    """State of a device that measures the current of the battery, A."""
    cells: Annotated[int, Field(ge=1, le=100)] | None = None
    """Number of cells in series. If it is given, the following voltages are per cell."""
    warn: Annotated[Voltage, Field(gt=0)]
    """Voltage below which an event warns, V."""
    stop: Annotated[Voltage, Field(gt=0)]
    """Voltage below which the run ends, or the controllers of `activate` take over, V."""
    hysteresis: Annotated[Voltage, Field(ge=0)] = 0.1
    """Difference above `warn` that re-arms the warning, V."""
    filter: Duration = 2_000_000_000
    """Time constant of the low-pass filter on the voltage. It hides the voltage drop of a starting motor."""
    timeout: Annotated[Duration, Field(gt=0)] = 2_000_000_000
    """Age above which a voltage is ignored."""
    activate: tuple[str, ...] = ()
    """Controllers that take over at `stop`. Without any, the run ends by the policy `on_fault`."""
    frame: str = ""
    """Name of the frame in the messages."""

    def mistakes(self) -> Iterator[Mistake]:
        """Yield `stop` if it is not below `warn`, and names that are not states of an owner."""
        yield from super().mistakes()
        if self.stop >= self.warn:
            yield ("stop",), "stop is not below warn; lower stop, or raise warn"
        if self.current is not None and "/" not in self.current:
            yield ("current",), f"{self.current} is not a state; write OWNER/STATE, such as power/current"
        for index, name in enumerate(self.voltages):
            if "/" not in name:
                yield ("voltages", index), f"{name} is not a state; write OWNER/STATE, such as power/voltage"


class BatteryStateBroadcaster(Controller[BatteryParameters]):
    """Controller that monitors a battery, provides `voltage`, and publishes sensor_msgs/BatteryState at 1 Hz.

    `warn` and `stop` are compared with the filtered voltage. The filter starts with the first measurement.
    `stop` only triggers once until the battery has recovered. Without a fresh voltage nothing triggers, and
    an event reports that.
    """

    Parameters = BatteryParameters
    Topics: ClassVar = {"battery_state": messages.BatteryState}

    @classmethod
    def interfaces(cls, parameters: BatteryParameters, joints: tuple[str, ...]) -> Interfaces:
        """Read the voltages, their ages, and optionally the current."""
        ages = (f"{name.rpartition('/')[0]}/age" for name in parameters.voltages)
        current = () if parameters.current is None else (parameters.current,)
        return Interfaces(
            (),
            reads=(*parameters.voltages, *ages, *current),
            provides=("voltage",),
            takeovers=parameters.activate,
        )

    def on_configure(self, context: Context) -> None:
        """Allocate the message."""
        super().on_configure(context)
        parameters, cells = self.parameters, self.parameters.cells or 1
        self._warn, self._stop = parameters.warn * cells, parameters.stop * cells
        self._good = self._warn + parameters.hysteresis * cells
        self._message = messages.BatteryState(header=messages.Header(frame_id=parameters.frame))

    def on_activate(self, time_ns: int) -> None:
        """Reset the filter and all warnings, because the battery may have been replaced."""
        self._voltage = math.nan
        self._warned = self._stopped = self._silent = False
        self._heard_ns = self._publish_ns = time_ns

    def update(self, time_ns: int, period_ns: int) -> None:
        """Filter the median of the fresh voltages, compare it with the thresholds, and publish it."""
        parameters, count = self.parameters, len(self.parameters.voltages)
        values = self.context.reads.tolist()
        fresh = [
            voltage
            for voltage, age_s in zip(values[:count], values[count : 2 * count], strict=True)
            if math.isfinite(voltage) and age_s * 1e9 <= parameters.timeout
        ]
        self.context.provided[0] = math.nan
        if not fresh:
            self._look_for_silence(time_ns)
            return
        self._heard_ns, self._silent = time_ns, False
        fresh.sort()
        measured = (fresh[(len(fresh) - 1) // 2] + fresh[len(fresh) // 2]) / 2  # the median
        if math.isnan(self._voltage) or not parameters.filter:
            self._voltage = measured
        else:
            self._voltage -= math.expm1(-period_ns / parameters.filter) * (measured - self._voltage)
        self.context.provided[0] = self._voltage
        self._compare()
        if time_ns >= self._publish_ns:
            self._publish_ns = max(self._publish_ns + PUBLISH_NS, time_ns)
            self._message.voltage = self._voltage
            if parameters.current is not None:
                self._message.current = values[2 * count]
            self.context.publish("battery_state", self._message)

    def _compare(self) -> None:
        context, voltage = self.context, self._voltage
        if voltage < self._stop and not self._stopped:
            self._stopped = self._warned = True
            why = f"the battery has {self._shown(voltage)}, less than {self._shown(self._stop)}"
            if self.parameters.activate:
                context.take_over(self.parameters.activate, why)
            else:
                context.end_run(why)
        elif voltage < self._warn and not self._warned:
            self._warned = True
            context.say(f"the battery is low: {self._shown(voltage)}, less than {self._shown(self._warn)}")
        elif voltage > self._good and self._warned:
            self._warned = self._stopped = False
            context.say(f"the battery has {self._shown(voltage)} again")

    def _shown(self, voltage: float) -> str:
        cells = self.parameters.cells
        return f"{voltage:.2f} V" if cells is None else f"{voltage / cells:.2f} V a cell ({voltage:.2f} V)"

    def _look_for_silence(self, time_ns: int) -> None:
        timeout = self.parameters.timeout
        if not self._silent and time_ns - self._heard_ns > timeout:
            self._silent = True
            self.context.say(
                f"no voltage from {', '.join(self.parameters.voltages)} for {timeout * 1e-9:g} s: "
                "an empty battery is not detected"
            )
