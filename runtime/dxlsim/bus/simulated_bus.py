"""Simulated bus: bytes in -> timed bytes out, on one half-duplex line with servos, faults and a ledger.

The rules of the line:

- A byte takes 10 bits. An instruction takes effect when its last byte has passed. A reply starts after the
  servo's return delay, and the host receives it when its last byte has passed and the adapter delivers it.
- A servo does not receive while it sends. If the host sends during a reply, the servo sees its bytes as 0,
  and the rest of the reply is lost.
- Servos that send at once (a broadcast ping, two servos with one ID) produce one reply, the AND of their
  bytes, as drivers that both pull a line low would [i].
- A pause inside an instruction ends it: more than 100 ms (Protocol 1.0), more than 1.5 ms (Protocol 2.0).
- Servos of a group read reply one after the other, each its return delay after the end of the previous reply.
  They report their state at the end of the instruction [i].
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
from dxlsim.bus.simulated_line import ECHO, GroupReply, LineTransmission, SimulatedLine, Turn
from dxlsim.device.device_quantities import DeviceQuantities
from dxlsim.device.simulated_device import SimulatedDevice, make_device
from dxlsim.motion.mechanics import Mechanics
from dxlsim.registers.access import ACCESS
from dxlsim.servo.making import make_servo
from dxlsim.servo.node import Node, SimulatedNode
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import BusConfig, DeviceConfig, ServoConfig
from dxlsim.wire import servo_protocol1, servo_protocol2
from dxlsim.wire.servo_packets import GroupRead, InstructionPacket, InstructionReceiver, ServoReply

_STATUS_BYTES = 11
"""Size of a status packet of Protocol 2.0 without data, bytes: the slot of an absent servo has this length
[i]."""

SUPPLY_VOLTS = 12.0  # Supply voltage of a line without servos
# Largest relative difference between the rates of host and servo (e-Manual, Baud Rate (4))
RATE_TOLERANCE = 0.03

Alteration = Callable[[bytes], bytes]  # Changes the bytes of a packet

Action = Callable[[], None]


class PacketFault(NamedTuple):
    """Fault that is applied to the next packet of a servo, or of the host."""

    text: str
    alter: Alteration
    delay_ns: int = 0
    copies: int = 1


class SimulatedBus:
    """One simulated half-duplex line with its servos and devices; time comes from the caller and never
    goes back."""

    def __init__(
        self, config: BusConfig, ledger: Ledger, start_ns: int, mechanics: Mechanics | None = None
    ) -> None:
        self.name = config.name
        self.protocol = config.protocol
        self.absent = config.adapter.absent
        self.echo = config.adapter.echo
        self.ledger = ledger
        self.plugged = True  # False: the adapter is unplugged
        self.times_unplugged = 0
        self.servos: tuple[SimulatedServo, ...] = ()
        self.devices: tuple[SimulatedDevice, ...] = ()
        self.nodes: tuple[SimulatedNode, ...] = ()
        """All units on the line: servos, then devices."""
        self.mechanics = mechanics or Mechanics(start_ns)
        """Mechanics that the servos move; several buses of one robot share them."""
        self.now_ns = start_ns  # Current time of the bus
        self.host_free_ns = start_ns
        """Time (ns) at which the host's last byte has passed the wire."""
        self.lateness_ns: deque[int] = deque(maxlen=1000)
        """Delays (ns) of the recent deliveries to the host, compared with their planned times; in real
        time only."""
        self._codec = servo_protocol2.CODEC if config.protocol == 2.0 else servo_protocol1.CODEC
        self._receiver = InstructionReceiver(self._codec)
        self._line = SimulatedLine(config.baud_rate, self.add_note)
        self._adapter = SimulatedAdapter(config.adapter, start_ns)
        self._wedged = False
        self._group: GroupReply | None = None  # The group read in progress
        self._nodes_by_id: dict[int, tuple[SimulatedNode, ...]] = {}
        self._reply_faults: dict[int, deque[PacketFault]] = {}
        self._instruction_faults: deque[PacketFault] = deque()
        self._planned: list[tuple[int, int, Action]] = []
        """Actions with their times (ns), ordered by time; actions of the same time in the order of
        planning."""
        self._planned_after: list[tuple[int, int, Action]] = []
        """Actions with the number of instruction packets after which they run, ordered by that number."""
        self._packets = 0
        self._order = itertools.count()
        for servo in config.servos:
            self.add_servo(servo)
        for device in config.devices:
            self.add_device(device)

    # The line

    def receive_bytes(self, data: bytes | bytearray | memoryview, at_ns: int) -> None:
        """Receive bytes that the host writes to its adapter at `at_ns`. They are sent after bytes
        written earlier."""
        sent = bytes(data)
        self._pass_time(at_ns)
        self.ledger.add(at_ns, self.name, "in", sent)
        if self._wedged or not self.plugged:
            self.add_note(f"{len(sent)} bytes from the host are lost")
            return
        start_ns = max(at_ns, self.host_free_ns)
        if self._receiver.pending and start_ns - self.host_free_ns > self._codec.longest_pause_ns:
            self.add_note(f"incomplete instruction of {self._receiver.pending} bytes discarded")
            self._receiver.discard_packet()
        self.host_free_ns = start_ns + self._line.duration_ns(len(sent))
        self._transmit(sent, start_ns)
        if self.echo:
            self._line.echo(LineTransmission(start_ns, self.host_free_ns, sent, ECHO))

    @property
    def baud_rate(self) -> int:
        """Baud rate of the host's adapter, bit/s."""
        return self._line.baud_rate

    @baud_rate.setter
    def baud_rate(self, baud_rate: int) -> None:
        self._withdraw_waiting()
        self._line.baud_rate = baud_rate
        self._nodes_by_id.clear()

    def change_rate(self, baud_rate: int) -> None:
        """Change the baud rate of the host's adapter, bit/s, and note it in the ledger."""
        self.add_note(f"host baud rate set to {baud_rate} bit/s")
        self.baud_rate = baud_rate

    def next_due_ns(self) -> int | None:
        """Return the time (ns) of the next event without input: bytes to deliver to the host, or a fault;
        None without any."""
        passing = self._line.passing
        due_ns = None if self._wedged else self._adapter.next_ns(passing)
        if passing and (due_ns is None or passing[0].due_ns < due_ns):
            due_ns = passing[0].due_ns  # A group read may continue after its end
        if self._planned and (due_ns is None or self._planned[0][0] < due_ns):
            return self._planned[0][0]
        return due_ns

    def next_delivery_ns(self, gather_ns: int) -> int | None:
        """Return `next_due_ns`, or the end of the last reply that ends at most `gather_ns` later, to
        deliver several at once."""
        due_ns = self.next_due_ns()
        passing = self._line.passing
        if due_ns is None or not passing or due_ns != passing[0].due_ns or not self._adapter.immediate:
            return due_ns
        last_ns = due_ns + gather_ns
        if self._planned:
            last_ns = max(due_ns, min(last_ns, self._planned[0][0] - 1))
        return passing[bisect_right(passing, last_ns, key=_due) - 1].due_ns

    def drain_bytes(self, now_ns: int, *, handed_ns: int | None = None) -> bytes:
        """Return the bytes that the host receives by `now_ns`, each once, and write them to the ledger.

        Args:
            now_ns: Time of the bus.
            handed_ns: Real time of the delivery, for the lateness in the ledger.
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

    # Interface for tests and faults

    def servo(self, servo_id: int) -> SimulatedServo:
        """Return the first servo on the line with this ID. Raises LookupError without one."""
        return self._first(self.servos, servo_id, "servo")

    def add_servo(self, config: ServoConfig) -> SimulatedServo:
        """Connect another servo to the line and return it."""
        servo = make_servo(
            config, self.baud_rate, self.now_ns, self.add_note, self.protocol, mechanics=self.mechanics
        )
        self.servos += (servo,)
        self.nodes = (*self.servos, *self.devices)
        servo.registers.watch_items(ACCESS.identity, self._nodes_by_id.clear)
        return servo

    def add_device(self, config: DeviceConfig) -> SimulatedDevice:
        """Connect another device to the line and return it; it has the supply voltage of the first servo."""
        world = DeviceQuantities(self.servos[0].voltage if self.servos else SUPPLY_VOLTS)
        device = make_device(
            config, self.protocol, world, baud_rate=self.baud_rate, note=self.add_note, now_ns=self.now_ns
        )
        self.devices += (device,)
        self.nodes = (*self.servos, *self.devices)
        self._nodes_by_id.clear()
        device.registers.watch_items(ACCESS.identity, self._nodes_by_id.clear)
        return device

    def device(self, servo_id: int) -> SimulatedDevice:
        """Return the first device on the line with this ID. Raises LookupError without one."""
        return self._first(self.devices, servo_id, "device")

    def _first(self, nodes: Sequence[Node], servo_id: int, called: str) -> Node:
        for node in nodes:
            if node.servo_id == servo_id:
                return node
        raise LookupError(f"bus {self.name} has no {called} with ID {servo_id}")

    def advance_to(self, now_ns: int) -> None:
        """Advance the line and every servo and device to a time, ns, so that a test can inspect them."""
        self._pass_time(now_ns)
        for node in self.nodes:
            node.advance_to(now_ns)

    def excuse(self, duration_ns: int) -> None:
        """Do not count a stall of this process, of `duration_ns`, toward the timeout of the servos' Bus
        Watchdogs."""
        for servo in self.servos:
            servo.excuse(duration_ns)

    def at(self, t_ns: int, action: Action) -> None:
        """Call `action`, such as a fault, when the time of the bus reaches `t_ns`."""
        heapq.heappush(self._planned, (t_ns, next(self._order), action))

    def after(self, packets: int, action: Action) -> None:
        """Call `action`, such as a fault, after that many more instruction packets; 0: now."""
        heapq.heappush(self._planned_after, (self._packets + packets, next(self._order), action))
        self._act_after_packets()

    def add_note(self, text: str) -> None:
        """Add a note to the ledger, at the present time of the bus."""
        self.ledger.add(self.now_ns, self.name, "note", note=text)

    def alter_next(
        self, servo_id: int, text: str, alter: Alteration, *, delay_ns: int = 0, copies: int = 1
    ) -> None:
        """Alter, delay or repeat a servo's next reply; `text` describes the fault in the ledger."""
        self._withdraw_waiting()
        self._reply_faults.setdefault(servo_id, deque()).append(PacketFault(text, alter, delay_ns, copies))

    def alter_next_instruction(self, text: str, alter: Alteration) -> None:
        """Alter the next whole instruction as received by the servos; an `alter` that returns b"" loses
        it."""
        self._instruction_faults.append(PacketFault(text, alter))

    def inject_noise(self, data: bytes, at_ns: int) -> None:
        """Send noise toward the host, beginning at `at_ns`."""
        self._withdraw_waiting()
        self.add_note(f"noise of {len(data)} bytes at {at_ns} ns")
        self._line.send(LineTransmission(at_ns, at_ns + self._line.duration_ns(len(data)), data, "noise"))

    def unplug(self) -> None:
        """Unplug the adapter: bytes in its buffer are lost, and the host's port disappears."""
        if self.plugged:
            self.add_note("adapter unplugged")
            self.plugged = False
            self.times_unplugged += 1
            self._adapter.discard_bytes()
            self._receiver.discard_packet()

    def plug_in(self) -> None:
        """Plug the adapter in again; the host must then open its port again."""
        if not self.plugged:
            self.add_note("adapter plugged in")
            self.plugged = True

    @property
    def latency_timer_ns(self) -> int:
        """Latency timer of the adapter, ns; 0: it delivers bytes at once."""
        return self._adapter.timer_ns

    def set_latency_timer(self, timer_ns: int) -> None:
        """Set the adapter's latency timer, ns; 0: none."""
        self.add_note(f"adapter latency timer set to {timer_ns} ns")
        self._adapter.set_timer(timer_ns, self.now_ns)

    def wedge(self, on: bool = True) -> None:
        """Make the adapter discard all bytes in both directions, although the host can write; False ends
        this."""
        self.add_note("adapter wedged" if on else "adapter works again")
        self._wedged = on
        self._adapter.discard_bytes()

    # Inside: time

    def _pass_time(self, now_ns: int) -> None:
        """Process all events up to `now_ns`: ends of transmissions and planned actions, in the order of
        their times."""
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

    def _arrive(self, each: LineTransmission) -> None:
        """Pass a transmission that has ended on the wire to the adapter, and send the next reply of a
        group read that waited for its end."""
        self.now_ns = max(self.now_ns, each.due_ns)
        if not self.plugged or self._wedged:
            self.add_note(f"{len(each.data)} bytes to the host are lost: {each.data.hex(' ')}")
        elif not self._adapter.accept_transmission(each):
            self.add_note(f"{len(each.data)} bytes to the host are lost: the host does not read")
        if not each.note and not each.broken and each.data.startswith(self._codec.header):
            for device in self.devices:
                device.overhear(each.data[len(self._codec.header)], each.due_ns)
        group = each.group
        if group is None or group is not self._group or group.sent > each.turn + 1:
            return  # No reply waits for its end
        if not each.broken:
            self._send_turns(group, each.due_ns)
        elif group.has_slots:
            self._send_turns(group, max(each.due_ns, each.turn_end_ns))
        else:
            self.add_note("broken reply: the servos after it in the chain do not reply")
            self._group = None

    def _withdraw_waiting(self) -> None:
        """Remove the replies of a group read that have not begun, because another event may come before
        them."""
        if self._group is not None:
            self._line.withdraw(self._group)

    # Inside: instructions

    def _transmit(self, sent: bytes | bytearray, start_ns: int) -> None:
        """Send the host's bytes, from `start_ns`, to the servos, which execute each complete instruction."""
        position = 0
        while position < len(sent):
            self._withdraw_waiting()
            if self._line.passing:
                sent = bytearray(sent)
                self._line.talk_over(sent, position, start_ns)
            packet = self._receiver.feed_bytes(sent, position)
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
        self.add_note(f"instruction altered by a fault: {fault.text}")
        received = fault.alter(packet.raw)
        position = 0
        while (other := self._receiver.feed_bytes(received, position)) is not None:
            position = other.end
            self._execute(other, end_ns)
        if not position:  # Even an unparsable instruction counts as a packet
            self._count_packet()

    def _execute(self, packet: InstructionPacket, end_ns: int) -> None:
        self._group = None  # Servos that wait for their turn stop at another instruction
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
                reply = node.execute_packet(packet, end_ns)
                if reply is not None:
                    node.counts.reply(reply.error)
                    first_ns = end_ns + reply.delay_ns
                    data = self._status(reply)
                    due_ns = first_ns + self._line.duration_ns(len(data))
                    self._send_reply(reply.servo_id, LineTransmission(first_ns, due_ns, data))
        self._count_packet()

    def _nodes_of(self, servo_id: int) -> tuple[SimulatedNode, ...]:
        """Return the servos and devices that receive an ID at the host's baud rate; cached until an ID or
        a rate changes."""
        found = self._nodes_by_id.get(servo_id)
        if found is None:
            rate, tolerance = self.baud_rate, RATE_TOLERANCE * self.baud_rate
            addressed = [each for each in self.nodes if each.listens_to(servo_id)]
            found = tuple(each for each in addressed if abs(each.baud_rate - rate) < tolerance)
            self._nodes_by_id[servo_id] = found
        return found

    def _turns(self, read: GroupRead, slots: bool, end_ns: int) -> Sequence[Turn]:
        """Return the turns of a group read with each servo's replies, which show the states at `end_ns`."""
        self.mechanics.step_to(end_ns)
        turns: list[Turn] = []
        shared = servo_protocol2.FastStatusPacket(read.lengths) if read.fast else None
        for entry in read.entries:
            replies = []
            for node in self._nodes_of(entry.servo_id):
                if node.servo_id != entry.servo_id:
                    continue  # Addressed by its secondary ID, to which a servo never replies
                node.counts.received += 1
                reply = node.reply_to_group_read(read, entry, end_ns)
                if reply is not None:
                    node.counts.reply(reply.error)
                    replies.append((reply, shared.part(reply) if shared else self._status(reply)))
            turns.append(Turn(entry.servo_id, tuple(replies), _STATUS_BYTES + entry.length))
            if not replies and not slots:
                break  # The servos after it wait in vain
        return turns

    def _send_turns(self, group: GroupReply, free_ns: int) -> None:
        """Send the next replies of a group read, starting when the line is free at `free_ns`.

        If nothing else is on the line, a reply is sent before the previous one has ended. Any event
        between them removes it again."""
        alone, sent_any = not self._line.passing, False
        while group.sent < len(group.turns):
            turn = group.turns[group.sent]
            plain = alone and len(turn.replies) == 1 and not self._reply_faults.get(turn.servo_id)
            if sent_any and not plain:
                return  # Decided when the previous reply has passed
            slot_ns = self._line.duration_ns(turn.slot_bytes) if group.has_slots else 0
            end_ns = due_ns = free_ns + slot_ns
            sent = False
            for reply, data in turn.replies:  # Two servos with one ID send at once
                first_ns = free_ns + reply.delay_ns
                end_ns, due_ns = first_ns + slot_ns, first_ns + self._line.duration_ns(len(data))
                each = LineTransmission(first_ns, due_ns, data, "", group, group.sent, end_ns)
                sent = self._send_reply(reply.servo_id, each) or sent
            group.sent += 1
            if sent and not plain:
                return
            if not sent and not group.has_slots:
                self.add_note(f"servo {turn.servo_id} does not reply, nor do those after it in the chain")
                break
            sent_any = sent_any or sent
            free_ns = due_ns if sent else end_ns
        if not sent_any:
            self._group = None

    def _send_reply(self, servo_id: int, reply: LineTransmission) -> bool:
        """Send a servo's reply with the faults planned for it; return True if anything was sent."""
        faults = self._reply_faults.get(servo_id)
        if not faults:
            self._line.send(reply)
            return True
        fault = faults.popleft()
        self.add_note(f"servo {servo_id}: {fault.text}")
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
