"""Lights in a run: write the LEDs of servos, in idle time of the bus, when their commands change."""

from __future__ import annotations

import msgspec

from dxlrun.tooling.features import BusContext, BusStage, Program, Urgency, plan_line
from dxlrun_lights.plan import LightPlan, decode_lights

RETRY_NS = 1_000_000_000  # a servo that does not reply costs a timeout, so it is not written in every cycle


class Led(msgspec.Struct):
    """The LED of a light on a bus, with its last acknowledged state."""

    light: LightPlan
    servo: int  # Index in the servos of the bus
    column: int  # Its command in `BusContext.commands`
    shown: int | None = None  # last acknowledged value; None: not known
    writing: bool = False
    due_ns: int = 0  # controllers' time of the next permitted write


class Lights:
    """The lights of the servos on one bus, called by the process that drives the bus."""

    def __init__(self, context: BusContext, leds: list[Led]) -> None:
        self._context = context
        self._leds = leds

    def judge_replies(self, now_ns: int) -> None:
        """Do nothing: LEDs are not read."""

    def recover_line(self) -> None:
        """Write every LED again: a servo without power has lost its state."""
        for led in self._leds:
            led.shown = None

    def recover_servo(self, servo: int) -> None:
        """Write the LED of a servo again at once: the servo has lost its state."""
        for led in self._leds:
            if led.servo == servo:
                led.shown, led.due_ns = None, 0

    def schedule_idle_work(self, time_ns: int) -> None:
        """Schedule writes of LEDs that differ from their commands, or whose state is unknown."""
        for led in self._leds:
            lit = int(self._context.commands[led.column] >= 0.5)  # NaN, not commanded, is off
            if led.shown != lit and not led.writing and led.due_ns <= time_ns:
                led.writing, led.due_ns = True, time_ns + RETRY_NS
                name = self._context.command_names[led.column]
                self._context.idle.add(self._write_led(led, lit), Urgency.STEERED, name, led.servo)

    def _write_led(self, led: Led, lit: int) -> Program[None]:
        line, light = plan_line(self._context.idle.plan), led.light
        reply = yield line.write_range(light.servo_id, light.address, bytes([lit]))
        led.writing = False
        if reply.answered:  # a lost write is repeated when it is due
            led.shown, led.due_ns = lit, 0


def attach_lights(context: BusContext) -> Lights | None:
    """Return the lights of a bus; None if it has none."""
    bus = context.idle.plan
    servos = {servo.servo_id: index for index, servo in enumerate(bus.servos)}
    leds = [
        Led(light, servos[light.servo_id], context.command_names.index(f"lights/{name}"))
        for name, light in decode_lights(context.plan).items()
        if light.bus == bus.name
    ]
    return Lights(context, leds) if leds else None


STAGE = BusStage(attach_lights)
