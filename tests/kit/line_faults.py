"""Faults of single packets on a simulated bus, another host on its line, and a hand at a shaft."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

from dxlsim.bus.simulated_bus import PacketFault, SimulatedBus
from dxlsim.bus.simulated_line import LineTransmission, flipped
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.wire.servo_packets import InstructionReceiver

STALLED = "the adapter stalls"
OTHER_HOST = "another host sends"  # How the note of an instruction of another host begins


def corrupt_next(bus: SimulatedBus, servo_id: int, index: int = -1, flip: int = 0x01) -> None:
    """Flip bits of one byte of a servo's next reply."""
    text = f"byte {index} of its reply corrupted by {flip:#04x}"
    bus.alter_next(servo_id, text, lambda reply: flipped(reply, index, flip))


def truncate_next(bus: SimulatedBus, servo_id: int, keep: int) -> None:
    """Let only the first `keep` bytes of a servo's next reply through; 0 loses it."""
    bus.alter_next(servo_id, f"its reply cut to {keep} bytes", lambda reply: reply[:keep])


def delay_next(bus: SimulatedBus, servo_id: int, delay_ns: int) -> None:
    """Let a servo's next reply start later."""
    bus.alter_next(servo_id, f"its reply delayed by {delay_ns} ns", bytes, delay_ns=delay_ns)


def disturb_replies(bus: SimulatedBus, servo_id: int, faults: Mapping[int, PacketFault]) -> Callable[[], int]:
    """Apply faults to a servo's replies by their number from now on; return a function that counts replies.

    A fault whose text is STALLED delays the replies after it, too: they keep their order.
    """
    send, count, stalled_until_ns = bus._send_reply, 0, 0

    def send_disturbed(replying: int, reply: LineTransmission) -> bool:
        nonlocal count, stalled_until_ns
        if replying == servo_id:
            fault = faults.get(count)
            if fault is not None and fault.text == STALLED:
                stalled_until_ns = max(stalled_until_ns, reply.first_ns + fault.delay_ns)
            if reply.first_ns < stalled_until_ns:
                fault = PacketFault(STALLED, bytes, stalled_until_ns - reply.first_ns)
                stalled_until_ns += reply.due_ns - reply.first_ns
            if fault is not None:
                bus._reply_faults.setdefault(servo_id, deque()).append(fault)
            count += 1
        return send(replying, reply)

    bus._send_reply = send_disturbed  # type: ignore[method-assign]
    return lambda: count


def other_host(bus: SimulatedBus, packet: bytes, at_ns: int, *, received: bool = True) -> None:
    """Let another host on the line send an instruction packet at a time: the servos execute it, and this
    host receives the instruction and their replies.

    `received=False`: it sends by the adapter of this host, which gives back the replies only.
    """

    def send() -> None:
        bus._withdraw_waiting()
        bus.add_note(f"{OTHER_HOST} {packet.hex(' ')}")
        start_ns, end_ns = bus.now_ns, bus.now_ns + bus._line.duration_ns(len(packet))
        if received:
            bus._line.send(LineTransmission(start_ns, end_ns, packet, "another host"))
        instruction = InstructionReceiver(bus._codec).feed_bytes(packet, 0)
        if instruction is not None:
            bus._execute(instruction, end_ns)

    bus.at(at_ns, send)


def turn_by_hand(servo: SimulatedServo, angle: float) -> None:
    """Turn the shaft to an angle, rad; a servo with torque goes back to its goal."""
    servo.note(f"servo {servo.servo_id}: turned by hand to {angle} rad")
    servo.shaft.mechanics.move_shaft(servo.shaft.index, angle)
    servo.shaft._forget()
    servo.shaft.plan(servo.shaft.items.aims)


def lose_replies(bus: SimulatedBus, servo_id: int, begin_ns: int, end_ns: int) -> None:
    """Lose every reply of a servo that would begin in a time; the servo still executes its instructions."""
    send = bus._send_reply

    def send_or_lose(replying: int, reply: LineTransmission) -> bool:
        if replying == servo_id and begin_ns <= reply.first_ns < end_ns:
            truncate_next(bus, servo_id, 0)
        return send(replying, reply)

    bus._send_reply = send_or_lose  # type: ignore[method-assign]
