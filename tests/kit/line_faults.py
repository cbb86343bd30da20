"""Faults of single packets on a simulated bus, another host on its line, and a hand at a shaft."""

from collections.abc import Callable, Mapping

from dxlsim.bus.simulated_bus import DisturbedReply, PacketFault, SimulatedBus
from dxlsim.faults.kinds import flipped
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.wire.compiled_line import Task, packet_of
from dxlsim.wire.servo_packets import InstructionPacket

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
    count, stalled_until_ns = 0, 0

    def next_fault(reply: DisturbedReply) -> PacketFault | None:
        nonlocal count, stalled_until_ns
        fault = faults.get(count)
        if fault is not None and fault.text == STALLED:
            stalled_until_ns = max(stalled_until_ns, reply.first_ns + fault.delay_ns)
        if reply.first_ns < stalled_until_ns:
            fault = PacketFault(STALLED, bytes, stalled_until_ns - reply.first_ns)
            stalled_until_ns += reply.due_ns - reply.first_ns
        count += 1
        return fault

    change_replies(bus, lambda replying, reply: next_fault(reply) if replying == servo_id else None)
    return lambda: count


def change_replies(bus: SimulatedBus, choose: Callable[[int, DisturbedReply], PacketFault | None]) -> None:
    """Ask for a fault of each reply from now on, unless one is planned; `choose` gets ID and reply."""
    fault_of = bus._fault_of

    def chosen(servo_id: int, reply: DisturbedReply) -> PacketFault | None:
        planned = fault_of(servo_id, reply)
        bus._line.disturbed[servo_id] = 1
        return choose(servo_id, reply) if planned is None else planned

    bus._fault_of = chosen  # type: ignore[method-assign]
    for servo in bus.servos:
        bus._line.disturbed[servo.servo_id] = 1


def watch_instructions(bus: SimulatedBus, watch: Callable[[InstructionPacket, int], None]) -> None:
    """Call `watch` with each instruction from now on, and the time of its end, before servos execute it."""
    alter = bus._tasks[Task.ALTER]

    def watched(*given: int) -> None:
        packet, end_ns = packet_of(bus._line.packet), bus._line.end_ns
        watch(packet, end_ns)
        if bus._instruction_faults or alter != bus._alter:
            alter(*given)
        else:
            bus._library.line_execute_altered(bus.address, packet.raw, len(packet.raw))
        bus._line.altered = 1

    bus._tasks[Task.ALTER] = watched
    bus._line.altered = 1


def other_host(bus: SimulatedBus, packet: bytes, at_ns: int, *, received: bool = True) -> None:
    """Let another host on the line send an instruction packet at a time: the servos execute it, and this
    host receives the instruction and their replies.

    `received=False`: it sends by the adapter of this host, which gives back the replies only.
    """

    def send() -> None:
        bus.withdraw_waiting()
        bus.add_note(f"{OTHER_HOST} {packet.hex(' ')}")
        end_ns = bus.now_ns + bus.duration_ns(len(packet))
        if received:
            bus.send_bytes(packet, bus.now_ns, "another host")
        bus.execute_bytes(packet, end_ns)

    bus.at(at_ns, send)


def turn_by_hand(servo: SimulatedServo, angle: float) -> None:
    """Turn the shaft to an angle, rad; a servo with torque goes back to its goal."""
    servo.note(f"servo {servo.servo_id}: turned by hand to {angle} rad")
    servo.shaft.mechanics.move_shaft(servo.shaft.index, angle)
    servo.shaft._forget()
    servo.shaft.plan(servo.shaft.items.aims)


def lose_replies(bus: SimulatedBus, servo_id: int, begin_ns: int, end_ns: int) -> None:
    """Lose every reply of a servo that would begin in a time; the servo still executes its instructions."""

    def lost(replying: int, reply: DisturbedReply) -> PacketFault | None:
        is_lost = replying == servo_id and begin_ns <= reply.first_ns < end_ns
        return PacketFault("its reply cut to 0 bytes", lambda _: b"") if is_lost else None

    change_replies(bus, lost)
