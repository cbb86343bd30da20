"""Sampling: an open sensor that writes its samples into its slot, on real or virtual time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dxlrun.channels.slot import Floats, SlotState, SlotWriter
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.control.source_process import describe_error
from dxlrun.errors import PlugInError
from dxlrun.features.sensors.driver import Sensor, SensorContext
from dxlrun.features.sensors.plan import SensorPlan
from dxlsim.motion.link_motion import Body

REOPEN_NS = 1_000_000_000
"""Pause before a failed sensor is opened again."""


class SampledSensor:
    """One sensor and the writer of its slot. Only `open_first` lets the sensor's exceptions propagate."""

    def __init__(
        self,
        plan: SensorPlan,
        sensor: Sensor[Any],
        writer: SlotWriter,
        now_ns: Callable[[], int],
        body: Body | None,
    ) -> None:
        self.plan = plan
        self.driver = sensor
        self._writer = writer
        self._now_ns = now_ns
        self._values: Floats = np.full(len(plan.states), np.nan)
        self._context = SensorContext(plan.name, plan.period_ns, now_ns, self._say, body)
        self._open = self._ahead = False
        self.reopen_ns = 0
        """Time at which it is opened again; meaningful only while it is not `open`."""

    @property
    def waits(self) -> bool:
        """True if the sensor waits for the next sample of its device."""
        return self.driver.waits

    @property
    def open(self) -> bool:
        """True while its device is open."""
        return self._open

    def open_first(self) -> None:
        """Open the device at the start of a run; raise whatever the sensor raises."""
        try:
            self.driver.open(self._context)
        except BaseException:
            self.close()
            raise
        self._open = True
        self._writer.say(SlotState.OPEN, "")

    def sample(self) -> bool:
        """Take one sample, or reopen the device if that is due; return True if there was a sample."""
        if not self._open and not self._reopen():
            return False
        # A value that the driver does not set must be invalid, not old.
        self._values.fill(np.nan)
        try:
            t_ns = self.driver.read(self._values)
            if t_ns is None:
                return False
            now_ns = self._now_ns()
            ahead_ns = int(t_ns) - now_ns
            if ahead_ns > self.plan.period_ns and not self._ahead:
                self._ahead = True
                self._say(f"its times are {ahead_ns / 1e6:.0f} ms in the future: times of arrival are used")
            # A time in the future would make the sample younger than it is.
            self._writer.write(min(int(t_ns), now_ns), self._values)
        except Exception as error:  # every error of a driver becomes an event
            self.fail(error)
            return False
        return True

    def close(self) -> None:
        """Close the device and report any exception."""
        self._open = False
        try:
            self.driver.close()
        except Exception as error:  # as above
            self._writer.say(SlotState.FAILED, f"cannot be closed: {describe_error(error)}")

    def _reopen(self) -> bool:
        if self._now_ns() < self.reopen_ns:
            return False
        try:
            self.driver.open(self._context)
        except Exception as error:  # as above
            self.fail(error)
            return False
        self._open = True
        self._writer.say(SlotState.OPEN, "is open again")
        return True

    def fail(self, error: Exception) -> None:
        """Close the device after an exception, and schedule its reopening."""
        self.close()
        self.reopen_ns = self._now_ns() + REOPEN_NS
        self._writer.say(SlotState.FAILED, describe_error(error))

    def _say(self, text: str) -> None:
        self._writer.say(SlotState.OPEN if self._open else SlotState.STARTING, text)


def build_sensor(plugins: PlugIns, plan: SensorPlan) -> Sensor[Any]:
    """Return a new sensor of the plan's type.

    Raises:
        PlugInError: The type is not available, or its class refuses the parameters.
    """
    offer = plugins.drivers_of("sensors").get(plan.type)
    if offer is None:
        raise plugins.unknown_type(f"sensor {plan.name}", plan.type)
    try:
        sensor: Sensor[Any] = offer.driver(offer.driver.Parameters.model_validate_json(plan.parameters))
    except (Exception, SystemExit) as error:  # foreign code: one sentence instead of its traceback
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise PlugInError(f"sensor {plan.name} cannot be built: {what}") from error
    return sensor
