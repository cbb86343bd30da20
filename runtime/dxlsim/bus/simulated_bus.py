"""A simulated bus: bytes in -> timed bytes out; one half-duplex line, its servos, faults and ledger.

The rules of the line:

- A byte takes 10 bits. An instruction acts when its last byte has passed; a reply starts after the servo's
  return delay, and the host receives it when its last byte has passed and the adapter hands it over.
- A servo does not receive while it sends. Where the host sends into a reply, its bytes arrive as 0, and the
  reply is lost from there on.
- Servos that send at once (a broadcast ping, two servos with one ID) give one reply of their bytes ANDed, as
  drivers that both pull a line low would [i].
- A pause inside an instruction ends it: more than 100 ms (Protocol 1.0), more than 1.5 ms (Protocol 2.0).
- Servos of a group read reply one after the other, each its return delay after the end of the reply before
  it; what they reply is their state when the instruction ended [i].
- A servo at another baud rate receives nothing.
"""

from __future__ import annotations

import heapq
import itertools
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import NamedTuple

from msgspec.structs import replace

from dxlsim.bus.adapter import SimulatedAdapter
from dxlsim.bus.ledger import Ledger
from dxlsim.bus.line import ECHO, GroupReply, SimulatedLine, Transmission, Turn
from dxlsim.device.measured import Measured
from dxlsim.device.simulated_device import SimulatedDevice, make_device
from dxlsim.motion.mechanics import Mechanics
from dxlsim.registers.access import ACCESS
from dxlsim.servo.making import make_servo
from dxlsim.servo.node import Node, SimulatedNode
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import BusConfig, DeviceConfig, ServoConfig
from dxlsim.wire import protocol1, protocol2
from dxlsim.wire.packets import GroupRead, InstructionPacket, InstructionReceiver, ServoReply

_STATUS_BYTES = 11
"""Bytes of a status packet of Protocol 2.0 without data: the slot of an absent servo is as long [i]."""

SUPPLY_VOLTS = 12.0  # Of a line without servos
RATE_TOLERANCE = 0.03  # Rates of host and servo may differ by less (e-Manual, Baud Rate (4))

Alteration = Callable[[bytes], bytes]  # What becomes of a packet's bytes

Action = Callable[[], None]


class PacketFault(NamedTuple):
    """What happens to the next packet of a servo, or of the host."""

    text: str
    alter: Alteration
    delay_ns: int = 0
    copies: int = 1


class SimulatedBus:
    """One line; time comes from the caller and never goes back."""

    def __init__(
        self, config: BusConfig, ledger: Ledger, start_ns: int, mechanics: Mechanics | None = None
    ) -> None:
        self.name = config.name
        self.protocol = config.protocol
        self.absent = config.adapter.absent
        self.echo = config.adapter.echo
        self.ledger = ledger
        self.plugged = True  # False: nothing is between the host and the line
        self.times_unplugged = 0
        self.servos: tuple[SimulatedServo, ...] = ()
        self.devices: tuple[SimulatedDevice, ...] = ()
        self.nodes: tuple[SimulatedNode, ...] = ()
        """All that is on the line: servos, then devices."""
        self.mechanics = mechanics or Mechanics(start_ns)
        """What the servos move; several buses of one robot share it."""
        self.now_ns = start_ns  # The time that the bus has reached
        self.host_free_ns = start_ns
        """When the last byte that the host handed over has passed the wire."""
        self.lateness_ns: deque[int] = deque(maxlen=1000)
        """How long after its time the host received the last bytes of each hand-over, in real time."""
        self._codec = protocol2.CODEC if config.protocol == 2.0 else protocol1.CODEC
        self._receiver = InstructionReceiver(self._codec)
        self._line = SimulatedLine(config.baud_rate, self.note)
        self._adapter = SimulatedAdapter(config.adapter, start_ns)
        self._wedged = False
        self._group: GroupReply | None = None  # The group read whose replies are under way
        self._nodes_by_id: dict[int, tuple[SimulatedNode, ...]] = {}
        self._reply_faults: dict[int, deque[PacketFault]] = {}
        self._instruction_faults: deque[PacketFault] = deque()
        self._planned: list[tuple[int, int, Action]] = []
        """Actions by their time, those of one moment in the order in which they were planned."""
        self._planned_after: list[tuple[int, int, Action]] = []
        """Actions by the number of packets that pass before them."""
        self._packets = 0
        self._order = itertools.count()
        for servo in config.servos:
            self.add_servo(servo)
        for device in config.devices:
            self.add_device(device)

    # The line

    def receive(self, data: bytes | bytearray | memoryview, at_ns: int) -> None:
        """Take bytes that the host hands to its adapter at `at_ns`; they follow those still on the wire."""
        sent = bytes(data)
        self._pass_time(at_ns)
        self.ledger.add(at_ns, self.name, "in", sent)
        if self._wedged or not self.plugged:
            self.note(f"{len(sent)} bytes of the host do not reach the line")
            return
        start_ns = max(at_ns, self.host_free_ns)
        if self._receiver.pending and start_ns - self.host_free_ns > self._codec.longest_pause_ns:
            self.note(f"an instruction of {self._receiver.pending} bytes was broken off")
            self._receiver.forget()
        self.host_free_ns = start_ns + self._line.duration_ns(len(sent))
        self._transmit(sent, start_ns)
        if self.echo:
            self._line.echo(Transmission(start_ns, self.host_free_ns, sent, ECHO))

    @property
    def baud_rate(self) -> int:
        """The host's rate, bit/s."""
        return self._line.baud_rate

    @baud_rate.setter
    def baud_rate(self, baud_rate: int) -> None:
        self._withdraw_waiting()
        self._line.baud_rate = baud_rate
        self._nodes_by_id.clear()

    def change_rate(self, baud_rate: int) -> None:
        """Let the host send and receive at another rate from now on, bit/s."""
        self.note(f"the host's rate is {baud_rate} bit/s")
        self.baud_rate = baud_rate

    def next_due_ns(self) -> int | None:
        """Return when something happens by itself: bytes can be taken, a fault comes; None: nothing will."""
        passing = self._line.passing
        due_ns = None if self._wedged else self._adapter.next_ns(passing)
        if passing and (due_ns is None or passing[0].due_ns < due_ns):
            due_ns = passing[0].due_ns  # a group read may go on at its end
        if self._planned and (due_ns is None or self._planned[0][0] < due_ns):
            return self._planned[0][0]
        return due_ns

    def next_delivery_ns(self, gather_ns: int) -> int | None:
        """Return `next_due_ns`, or when the last reply has passed that follows it within a time."""
        due_ns = self.next_due_ns()
        passing = self._line.passing
        if due_ns is None or not passing or due_ns != passing[0].due_ns or not self._adapter.immediate:
            return due_ns
        last_ns = due_ns + gather_ns
        if self._planned:
            last_ns = max(due_ns, min(last_ns, self._planned[0][0] - 1))
        return passing[bisect_right(passing, last_ns, key=_due) - 1].due_ns

    def take(self, now_ns: int, *, handed_ns: int | None = None) -> bytes:
        """Return the bytes that have reached the host by `now_ns`, each once.

        `handed_ns`: when the host really receives them; how late that is belongs into the ledger.
        """
        self._pass_time(now_ns)
        if self._wedged:
            return b""
        taken, late_ns = [], 0
        for planned_ns, data, ended in self._adapter.hand_over(now_ns, self._line.passing):
            if handed_ns is not None:
                late_ns = handed_ns - planned_ns
            for each in ended:
                self.ledger.add(each.due_ns, self.name, "out", each.data, each.note, late_ns=late_ns)
            taken.append(data)
        if taken and handed_ns is not None:
            self.lateness_ns.append(late_ns)
        return b"".join(taken)

    # What tests see and do

    def servo(self, servo_id: int) -> SimulatedServo:
        """Return the first servo that has this ID now; raises LookupError when none has."""
        return self._first(self.servos, servo_id, "servo")

    def add_servo(self, config: ServoConfig) -> SimulatedServo:
        """Connect one more servo to the line, now."""
        servo = make_servo(
            config, self.baud_rate, self.now_ns, self.note, self.protocol, mechanics=self.mechanics
        )
        self.servos += (servo,)
        self.nodes = (*self.servos, *self.devices)
        servo.registers.watch(ACCESS.identity, self._nodes_by_id.clear)
        return servo

    def add_device(self, config: DeviceConfig) -> SimulatedDevice:
        """Connect one more device to the line, now; its supply is that of the first servo."""
        world = Measured(self.servos[0].voltage if self.servos else SUPPLY_VOLTS)
        device = make_device(
            config, self.protocol, world, baud_rate=self.baud_rate, note=self.note, now_ns=self.now_ns
        )
        self.devices += (device,)
        self.nodes = (*self.servos, *self.devices)
        self._nodes_by_id.clear()
        device.registers.watch(ACCESS.identity, self._nodes_by_id.clear)
        return device

    def device(self, servo_id: int) -> SimulatedDevice:
        """Return the first device that has this ID now; raises LookupError when none has."""
        return self._first(self.devices, servo_id, "device")

    def _first(self, nodes: Sequence[Node], servo_id: int, called: str) -> Node:
        for node in nodes:
            if node.servo_id == servo_id:
                return node
        raise LookupError(f"bus {self.name} has no {called} with ID {servo_id}")

    def advance(self, now_ns: int) -> None:
        """Bring every servo to a time, so that a test can look at it."""
        self._pass_time(now_ns)
        for node in self.nodes:
            node.advance(now_ns)

    def excuse(self, duration_ns: int) -> None:
        """Leave out of the servos' Bus Watchdogs for how long this process did not run, ns."""
        for servo in self.servos:
            servo.excuse(duration_ns)

    def at(self, t_ns: int, action: Action) -> None:
        """Plan a fault: `action` is called when the bus' time reaches `t_ns`."""
        heapq.heappush(self._planned, (t_ns, next(self._order), action))

    def after(self, packets: int, action: Action) -> None:
        """Plan a fault: `action` is called when so many more instruction packets have passed; 0: now."""
        heapq.heappush(self._planned_after, (self._packets + packets, next(self._order), action))
        self._act_after_packets()

    def note(self, text: str) -> None:
        """Enter a note into the ledger, at the bus' time."""
        self.ledger.add(self.now_ns, self.name, "note", note=text)

    def alter_next(
        self, servo_id: int, text: str, alter: Alteration, *, delay_ns: int = 0, copies: int = 1
    ) -> None:
        """Alter a servo's next reply, let it start later or come several times; the ledger gets `text`."""
        self._withdraw_waiting()
        self._reply_faults.setdefault(servo_id, deque()).append(PacketFault(text, alter, delay_ns, copies))

    def alter_next_instruction(self, text: str, alter: Alteration) -> None:
        """Alter what the servos receive of the next whole instruction; b"" loses it."""
        self._instruction_faults.append(PacketFault(text, alter))

    def inject_noise(self, data: bytes, at_ns: int) -> None:
        """Put bytes on the line that no servo sent, toward the host, beginning at `at_ns`."""
        self._withdraw_waiting()
        self.note(f"noise of {len(data)} bytes at {at_ns} ns")
        self._line.send(Transmission(at_ns, at_ns + self._line.duration_ns(len(data)), data, "noise"))

    def unplug(self) -> None:
        """Pull the adapter: what it holds is lost, and the host sees its port go."""
        if self.plugged:
            self.note("adapter unplugged")
            self.plugged = False
            self.times_unplugged += 1
            self._adapter.forget()
            self._receiver.forget()

    def plug_in(self) -> None:
        """Plug the adapter in again: a host has to open its port anew."""
        if not self.plugged:
            self.note("adapter plugged in")
            self.plugged = True

    @property
    def latency_timer_ns(self) -> int:
        """Latency timer of the adapter; 0: it hands bytes over at once."""
        return self._adapter.timer_ns

    def set_latency_timer(self, timer_ns: int) -> None:
        """Give the adapter another latency timer, ns; 0: none."""
        self.note(f"adapter's latency timer {timer_ns} ns")
        self._adapter.set_timer(timer_ns, self.now_ns)

    def wedge(self, on: bool = True) -> None:
        """Let the adapter take the host's bytes and pass none on, in either direction; False: no longer."""
        self.note("adapter wedged" if on else "adapter works again")
        self._wedged = on
        self._adapter.forget()

    # Inside: time

    def _pass_time(self, now_ns: int) -> None:
        """Let everything happen that happens by itself until `now_ns`, in order."""
        passing, planned = self._line.passing, self._planned
        while True:
            due_ns = passing[0].due_ns if passing else now_ns + 1
            if planned and planned[0][0] < due_ns and planned[0][0] <= now_ns:
                self.now_ns = max(self.now_ns, planned[0][0])
                heapq.heappop(planned)[2]()
            elif due_ns <= now_ns:
                self._arrive(passing.pop(0))
            else:
                break
        self.now_ns = max(self.now_ns, now_ns)

    def _arrive(self, each: Transmission) -> None:
        """Let the adapter have what has passed the wire, and the group read go on that waited for its end."""
        self.now_ns = max(self.now_ns, each.due_ns)
        if not self.plugged or self._wedged:
            self.note(f"{len(each.data)} bytes to the host are lost: {each.data.hex(' ')}")
        elif not self._adapter.accept(each):
            self.note(f"{len(each.data)} bytes to the host are lost: it does not read")
        if not each.note and not each.broken and each.data.startswith(self._codec.header):
            for device in self.devices:
                device.overhear(each.data[len(self._codec.header)], each.due_ns)
        group = each.group
        if group is None or group is not self._group or group.sent > each.turn + 1:
            return  # no reply waits for its end
        if not each.broken:
            self._send_turns(group, each.due_ns)
        elif group.has_slots:
            self._send_turns(group, max(each.due_ns, each.turn_end_ns))
        else:
            self.note("a broken reply: the servos after it wait for it in vain")
            self._group = None

    def _withdraw_waiting(self) -> None:
        """Take back the replies of a group read that have not begun: something may happen before them."""
        if self._group is not None:
            self._line.withdraw(self._group)

    # Inside: instructions

    def _transmit(self, sent: bytes | bytearray, start_ns: int) -> None:
        """Bring the host's bytes to the servos, which execute each whole instruction in them."""
        position = 0
        while position < len(sent):
            self._withdraw_waiting()
            if self._line.passing:
                sent = bytearray(sent)
                self._line.talk_over(sent, position, start_ns)
            packet = self._receiver.feed(sent, position)
            if packet is None:
                return
            position = packet.end
            end_ns = start_ns + self._line.duration_ns(position)
            if self._instruction_faults:
                self._execute_altered(packet, end_ns)
            else:
                self._execute(packet, end_ns)

    def _execute_altered(self, packet: InstructionPacket, end_ns: int) -> None:
        fault = self._instruction_faults.popleft()
        self.note(f"the servos receive another instruction: {fault.text}")
        received = fault.alter(packet.raw)
        position = 0
        while (other := self._receiver.feed(received, position)) is not None:
            position = other.end
            self._execute(other, end_ns)
        if not position:  # it was one all the same
            self._count_packet()

    def _execute(self, packet: InstructionPacket, end_ns: int) -> None:
        self._group = None  # servos that wait for their turn receive another instruction
        read = self._codec.group_read(packet)
        if read is not None:
            slots = read.has_slots and self.absent == "slot"
            self._group = GroupReply(self._turns(read, slots, end_ns), slots)
            for device in self.devices:
                device.chain(read, end_ns)
            self._send_turns(self._group, end_ns)
        else:
            for node in self._nodes_of(packet.servo_id):
                node.counts.received += packet.intact
                reply = node.execute(packet, end_ns)
                if reply is not None:
                    node.counts.reply(reply.error)
                    first_ns = end_ns + reply.delay_ns
                    data = self._status(reply)
                    due_ns = first_ns + self._line.duration_ns(len(data))
                    self._send_reply(reply.servo_id, Transmission(first_ns, due_ns, data))
        self._count_packet()

    def _nodes_of(self, servo_id: int) -> tuple[SimulatedNode, ...]:
        """Return what receives an ID, at the host's rate; kept until one changes ID or rate."""
        found = self._nodes_by_id.get(servo_id)
        if found is None:
            rate, tolerance = self.baud_rate, RATE_TOLERANCE * self.baud_rate
            addressed = [each for each in self.nodes if each.listens_to(servo_id)]
            found = tuple(each for each in addressed if abs(each.baud_rate - rate) < tolerance)
            self._nodes_by_id[servo_id] = found
        return found

    def _turns(self, read: GroupRead, slots: bool, end_ns: int) -> Sequence[Turn]:
        """Return what each servo of a group read replies to it, in its state at a time."""
        self.mechanics.advance(end_ns)
        turns: list[Turn] = []
        shared = protocol2.FastStatusPacket(read.lengths) if read.fast else None
        for entry in read.entries:
            replies = []
            for node in self._nodes_of(entry.servo_id):
                if node.servo_id != entry.servo_id:
                    continue  # only by its secondary ID, to which it never replies
                node.counts.received += 1
                reply = node.reply_to_group_read(read, entry, end_ns)
                if reply is not None:
                    node.counts.reply(reply.error)
                    replies.append((reply, shared.part(reply) if shared else self._status(reply)))
            turns.append(Turn(entry.servo_id, tuple(replies), _STATUS_BYTES + entry.length))
            if not replies and not slots:
                break  # those after it wait for it in vain
        return turns

    def _send_turns(self, group: GroupReply, free_ns: int) -> None:
        """Send the next replies of a group read, from when the line is free.

        A reply is sent ahead of the end of the one before it when nothing else is on the line: whatever may
        yet come between them withdraws it again.
        """
        alone, sent_any = not self._line.passing, False
        while group.sent < len(group.turns):
            turn = group.turns[group.sent]
            plain = alone and len(turn.replies) == 1 and not self._reply_faults.get(turn.servo_id)
            if sent_any and not plain:
                return  # it is decided when the reply before it has passed
            slot_ns = self._line.duration_ns(turn.slot_bytes) if group.has_slots else 0
            end_ns = due_ns = free_ns + slot_ns
            sent = False
            for reply, data in turn.replies:  # two servos with one ID send at once
                first_ns = free_ns + reply.delay_ns
                end_ns, due_ns = first_ns + slot_ns, first_ns + self._line.duration_ns(len(data))
                each = Transmission(first_ns, due_ns, data, "", group, group.sent, end_ns)
                sent = self._send_reply(reply.servo_id, each) or sent
            group.sent += 1
            if sent and not plain:
                return
            if not sent and not group.has_slots:
                self.note(f"servo {turn.servo_id} does not reply: those after it wait for it in vain")
                break
            sent_any = sent_any or sent
            free_ns = due_ns if sent else end_ns
        if not sent_any:
            self._group = None

    def _send_reply(self, servo_id: int, reply: Transmission) -> bool:
        """Send a servo's reply, faults and all; return whether anything was sent."""
        faults = self._reply_faults.get(servo_id)
        if not faults:
            self._line.send(reply)
            return True
        fault = faults.popleft()
        self.note(f"servo {servo_id}: {fault.text}")
        data = fault.alter(reply.data)
        duration_ns = self._line.duration_ns(len(data))
        first_ns = reply.first_ns + fault.delay_ns
        copies = fault.copies if data else 0
        for copy in range(copies):
            group = reply.group if copy == copies - 1 else None
            altered = replace(
                reply,
                first_ns=first_ns,
                due_ns=first_ns + duration_ns,
                data=data,
                group=group,
                broken=data != reply.data,
            )
            self._line.send(altered)
            first_ns += duration_ns
        return copies > 0

    def _status(self, reply: ServoReply) -> bytes:
        return self._codec.status_packet(reply.servo_id, reply.error, reply.parameters)

    def _count_packet(self) -> None:
        self._packets += 1
        self._act_after_packets()

    def _act_after_packets(self) -> None:
        while self._planned_after and self._planned_after[0][0] <= self._packets:
            heapq.heappop(self._planned_after)[2]()


_due = attrgetter("due_ns")
