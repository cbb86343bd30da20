"""Lights in a run: LEDs are written in idle time when their command changes."""

from __future__ import annotations

import msgspec

from dxlrun.tooling.features import BusContext, BusStage, Program, Urgency, plan_line
from dxlrun_lights.plan import Light


class Lights:
    """The lights of one bus."""

    def __init__(self, context: BusContext, places: dict[int, tuple[int, int]]) -> None:
        """`places`: ID and address of the LED of each light, by the column of its command."""
        self._context = context
        self._places = places
        self._written: dict[int, int] = {}

    def judge_replies(self, now_ns: int) -> None:
        """Do nothing: LEDs are not read."""

    def recover_line(self) -> None:
        """Write every LED again: a servo without power has forgotten it."""
        self._written.clear()

    def recover_servo(self, servo: int) -> None:
        """Do nothing."""

    def schedule_idle_work(self, time_ns: int) -> None:
        """Write the LEDs whose command changed."""
        for column, (servo_id, address) in self._places.items():
            lit = int(self._context.commands[column] >= 0.5)  # NaN, not commanded, is off
            if self._written.get(column, 0) != lit:
                self._written[column] = lit
                name = self._context.command_names[column]
                self._context.idle.add(self._write(servo_id, address, lit), Urgency.STEERED, name)

    def _write(self, servo_id: int, address: int, lit: int) -> Program[None]:
        yield plan_line(self._context.idle.plan).write(servo_id, address, bytes([lit]))


def attach_lights(context: BusContext) -> Lights | None:
    """Return the lights of a bus; None if it has none."""
    ids = {servo.joint: servo.servo_id for servo in context.idle.plan.servos}
    lights = msgspec.json.decode(context.plan, type=dict[str, Light])
    places = {
        context.command_names.index(f"lights/{name}"): (ids[light.servo], light.address)
        for name, light in lights.items()
        if light.servo in ids
    }
    return Lights(context, places) if places else None


STAGE = BusStage(attach_lights)
