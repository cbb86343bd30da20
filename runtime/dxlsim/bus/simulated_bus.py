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

`line.c` has these rules and the adapter between line and host. This module connects them with the servos,
executes what they leave to Python, and plans faults.

Not modelled on the line: reception of noise and of other servos' replies by servos (except for the end of the
previous reply in a group read), framing errors and breaks, garbage between rates that differ by less than
3 %, levels and reflections on the cable. Not modelled of the adapter: the frames of USB itself (125 us or 1
ms), delays by hubs and other devices, the transfer of the host's bytes to the line, and modem lines.
"""

from __future__ import annotations

import ctypes
import heapq
import itertools
import random
from collections import deque
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

from dxlsim.bus.ledger import Ledger
from dxlsim.device.device_quantities import DeviceQuantities
from dxlsim.device.simulated_device import SimulatedDevice, make_device
from dxlsim.motion.compiled_mechanics import function_address
from dxlsim.motion.mechanics import Mechanics
from dxlsim.servo.making import make_servo
from dxlsim.servo.node import Node, SimulatedNode
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import BusConfig, DeviceConfig, ServoConfig
from dxlsim.wire import servo_protocol1, servo_protocol2
from dxlsim.wire.compiled_line import NEVER_NS, TASK, Asked, Task, line_library, new_line, packet_of
from dxlsim.wire.servo_packets import InstructionPacket

SUPPLY_VOLTS = 12.0  # Supply voltage of a line without servos

_LONGEST_PIECE = 8  # Longest piece with the split `random`, bytes
_SPLITS = ("whole", "byte", "random")  # In the order of line.c

Alteration = Callable[[bytes], bytes]  # Changes the bytes of a packet

Action = Callable[[], None]


class PacketFault(NamedTuple):
    """Fault that is applied to the next packet of a servo, or of the host."""

    text: str
    alter: Alteration
    delay_ns: int = 0
    copies: int = 1
    is_noticed: bool = True  # False: it happens after the servos have received the packet


class DisturbedReply(NamedTuple):
    """Reply of a servo that a fault may disturb: its time on the wire, ns, and its bytes."""

    first_ns: int
    due_ns: int
    data: bytes


class SimulatedBus:
    """One simulated half-duplex line with its servos and devices; time comes from the caller and never
    goes back."""

    def __init__(
        self, config: BusConfig, ledger: Ledger, start_ns: int, mechanics: Mechanics | None = None
    ) -> None:
        self.name = config.name
        self.protocol = config.protocol
        self.ledger = ledger
        self.servos: tuple[SimulatedServo, ...] = ()
        self.devices: tuple[SimulatedDevice, ...] = ()
        self.nodes: tuple[SimulatedNode, ...] = ()
        """All units on the line: servos, then devices."""
        self.mechanics = mechanics or Mechanics(start_ns)
        """Mechanics that the servos move; several buses of one robot share them."""
        self._codec = servo_protocol2.CODEC if config.protocol == 2.0 else servo_protocol1.CODEC
        self._library = line_library()
        self.address, self._line = new_line(config.protocol, start_ns, self)
        self._chance = random.Random(config.adapter.seed)
        self._reply_faults: dict[int, deque[PacketFault]] = {}
        self._instruction_faults: deque[PacketFault] = deque()
        self._planned: list[tuple[int, int, Action]] = []
        """Actions with their times (ns), ordered by time; actions of the same time in the order of
        planning."""
        self._planned_after: list[tuple[int, int, Action]] = []
        """Actions with the number of instruction packets after which they run, ordered by that number."""
        self._order = itertools.count()
        self._raised: BaseException | None = None
        self._tasks = self._list_tasks()
        self._called = TASK(self._do)
        line = self._line
        line.call = ctypes.cast(self._called, ctypes.c_void_p)
        line.ledger, line.bus = ctypes.addressof(ledger.state), ledger.add_bus(self.name)
        line.baud_rate = config.baud_rate
        self.absent, line.echo = config.adapter.absent, config.adapter.echo
        line.timer_ns, line.split = config.adapter.latency_timer_ns, _SPLITS.index(config.adapter.split)
        line.step, line.mechanics = function_address("step_to"), self.mechanics.address
        self._library.line_start(self.address)
        for servo in config.servos:
            self.add_servo(servo)
        for device in config.devices:
            self.add_device(device)

    # The line

    def receive_bytes(self, data: bytes | bytearray | memoryview, at_ns: int) -> None:
        """Receive bytes that the host writes to its adapter at `at_ns`. They are sent after bytes
        written earlier."""
        self._library.line_receive(self.address, bytes(data), len(data), at_ns)
        self.raise_stored()

    @property
    def now_ns(self) -> int:
        """Current time of the bus, ns."""
        return int(self._line.now_ns)

    @property
    def host_free_ns(self) -> int:
        """Time (ns) at which the host's last byte has passed the wire."""
        return int(self._line.host_free_ns)

    @property
    def plugged(self) -> bool:
        """False while the adapter is unplugged."""
        return bool(self._line.plugged)

    @property
    def times_unplugged(self) -> int:
        """Number of times the adapter was unplugged."""
        return int(self._line.unplugged)

    @property
    def baud_rate(self) -> int:
        """Baud rate of the host's adapter, bit/s."""
        return int(self._line.baud_rate)

    @baud_rate.setter
    def baud_rate(self, baud_rate: int) -> None:
        self.withdraw_waiting()
        self._line.baud_rate = baud_rate

    def change_rate(self, baud_rate: int) -> None:
        """Change the baud rate of the host's adapter, bit/s, and note it in the ledger."""
        self.add_note(f"host baud rate set to {baud_rate} bit/s")
        self.baud_rate = baud_rate

    @property
    def absent(self) -> Literal["silent", "slot"]:
        """Effect of an absent servo in a group read, as in `AdapterConfig`."""
        return "slot" if self._line.slots else "silent"

    @absent.setter
    def absent(self, absent: Literal["silent", "slot"]) -> None:
        self._line.slots = absent == "slot"

    def duration_ns(self, size: int) -> int:
        """Return how long `size` bytes take on the wire, ns: 10 bits each (e-Manual, 8N1)."""
        return size * 10_000_000_000 // self.baud_rate

    def next_due_ns(self) -> int | None:
        """Return the time (ns) of the next event without input: bytes to deliver to the host, or a fault;
        None without any."""
        due_ns = self._library.line_next_due(self.address)
        return None if due_ns == NEVER_NS else due_ns

    def next_delivery_ns(self, gather_ns: int) -> int | None:
        """Return `next_due_ns`, or the end of the last reply that ends at most `gather_ns` later, to
        deliver several at once."""
        due_ns = self._library.line_next_delivery(self.address, gather_ns)
        return None if due_ns == NEVER_NS else due_ns

    def drain_bytes(self, now_ns: int, *, handed_ns: int = -1) -> bytes:
        """Return the bytes that the host receives by `now_ns`, each once, and write them to the ledger.

        Args:
            now_ns: Time of the bus.
            handed_ns: Real time of the delivery, for the lateness in the ledger; negative: not in real time.
        """
        size = self._library.line_drain(self.address, now_ns, handed_ns)
        self.raise_stored()
        if not size:
            return b""
        data = ctypes.create_string_buffer(size)
        self._library.line_take(self.address, data, size)
        return data.raw

    @property
    def lateness_ns(self) -> Sequence[int]:
        """Delays (ns) of the recent deliveries to the host, compared with their planned times, the newest
        one last; in real time only."""
        kept, delivered = self._line.lateness_ns, self._line.delivered
        first = delivered % len(kept)
        return [*kept[first:], *kept[:first]] if delivered > len(kept) else kept[:delivered]

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
        self._connect_nodes()
        return servo

    def add_device(self, config: DeviceConfig) -> SimulatedDevice:
        """Connect another device to the line and return it; it has the supply voltage of the first servo."""
        world = DeviceQuantities(self.servos[0].voltage if self.servos else SUPPLY_VOLTS)
        device = make_device(
            config, self.protocol, world, baud_rate=self.baud_rate, note=self.add_note, now_ns=self.now_ns
        )
        self.devices += (device,)
        self._connect_nodes()
        return device

    def _connect_nodes(self) -> None:
        self.nodes = (*self.servos, *self.devices)
        addresses = [ctypes.addressof(node.line) for node in self.nodes]
        self._addresses = (ctypes.c_void_p * len(addresses))(*addresses)
        self._line.nodes, self._line.node_count = ctypes.addressof(self._addresses), len(addresses)
        self._line.waits = any(device.waits for device in self.devices)

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
        self._library.line_pass_time(self.address, now_ns)
        self.raise_stored()
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
        self._line.planned_ns = self._planned[0][0]

    def after(self, packets: int, action: Action) -> None:
        """Call `action`, such as a fault, after that many more instruction packets; 0: now."""
        heapq.heappush(self._planned_after, (self._line.packets + packets, next(self._order), action))
        self._act_after_packets()

    def add_note(self, text: str) -> None:
        """Add a note to the ledger, at the present time of the bus."""
        self.ledger.add(self.now_ns, self.name, "note", note=text)

    def alter_next(
        self, servo_id: int, text: str, alter: Alteration, *, delay_ns: int = 0, copies: int = 1
    ) -> None:
        """Alter, delay or repeat a servo's next reply; `text` describes the fault in the ledger."""
        self.withdraw_waiting()
        self._reply_faults.setdefault(servo_id, deque()).append(PacketFault(text, alter, delay_ns, copies))
        if servo_id in range(len(self._line.disturbed)):
            self._line.disturbed[servo_id] = 1

    def alter_next_instruction(self, text: str, alter: Alteration) -> None:
        """Alter the next whole instruction as received by the servos; an `alter` that returns b"" loses
        it."""
        self._instruction_faults.append(PacketFault(text, alter))
        self._line.altered = 1

    def inject_noise(self, data: bytes, at_ns: int) -> None:
        """Send noise toward the host, beginning at `at_ns`."""
        self.withdraw_waiting()
        self.add_note(f"noise of {len(data)} bytes at {at_ns} ns")
        self.send_bytes(data, at_ns, "noise")

    def send_bytes(self, data: bytes, at_ns: int, note: str) -> None:
        """Send bytes toward the host, beginning at `at_ns`, with a note in the ledger. They are mixed with
        those that are on the wire at the same time: a collision."""
        self._library.line_send(self.address, data, len(data), at_ns, note.encode())

    def execute_bytes(self, data: bytes, end_ns: int) -> None:
        """Execute an instruction of another host, whose last byte passes the line at `end_ns`."""
        self._library.line_execute(self.address, data, len(data), end_ns)

    def withdraw_waiting(self) -> None:
        """Remove the replies of a group read that have not begun, because another event may come before
        them."""
        self._library.line_withdraw(self.address)

    def unplug(self) -> None:
        """Unplug the adapter: bytes in its buffer are lost, and the host's port disappears."""
        if self.plugged:
            self.add_note("adapter unplugged")
            self._line.plugged = 0
            self._line.unplugged += 1
            self._library.line_discard(self.address)
            self._library.line_discard_packet(self.address)

    def plug_in(self) -> None:
        """Plug the adapter in again; the host must then open its port again."""
        if not self.plugged:
            self.add_note("adapter plugged in")
            self._line.plugged = 1

    @property
    def latency_timer_ns(self) -> int:
        """Latency timer of the adapter, ns; 0: it delivers bytes at once."""
        return int(self._line.timer_ns)

    def set_latency_timer(self, timer_ns: int) -> None:
        """Set the adapter's latency timer, ns; 0: none."""
        self.add_note(f"adapter latency timer set to {timer_ns} ns")
        self._library.line_set_timer(self.address, timer_ns)

    def wedge(self, on: bool = True) -> None:
        """Make the adapter discard all bytes in both directions, although the host can write; False ends
        this."""
        self.add_note("adapter wedged" if on else "adapter works again")
        self._line.wedged = on
        self._library.line_discard(self.address)

    # Tasks of the line. C cannot propagate an exception: it is stored, later tasks fail, and `raise_stored`
    # raises it when the line has returned.

    def raise_stored(self) -> None:
        """Raise the exception of a task, if any."""
        if self._line.raised:
            raised, self._raised, self._line.raised = self._raised, None, 0
            raise raised or KeyboardInterrupt  # Python prints an exception that came before `_do` had begun

    def _do(self, task: int, first: int, second: int) -> int:
        try:
            return 0 if self._line.raised else int(self._tasks[task](first, second) or 0)
        except BaseException as error:
            self._raised, self._line.raised = error, 1
            return 0
        finally:
            self._line.done = 1

    def _list_tasks(self) -> list[Callable[[int, int], int | None]]:
        tasks: dict[Task, Callable[[int, int], int | None]] = {
            Task.STEP: lambda now_ns, _: self.mechanics.step_to(now_ns),
            Task.RECEIVES: lambda index, now_ns: self.nodes[index].receives(now_ns),
            Task.PRESENT: self._present,
            Task.EXECUTE: self._execute_for,
            Task.EXECUTE_ALL: lambda end_ns, _: self._execute_all(packet_of(self._line.packet), end_ns),
            Task.REFUSED: lambda index, error: self.nodes[index].refuse_instruction(
                packet_of(self._line.packet), error
            ),
            Task.STAYS_OUT: self._stay_out,
            Task.CHAIN: self._chain,
            Task.OVERHEAR: self._overhear,
            Task.NOTE: lambda address, size: self.add_note(ctypes.string_at(address, size).decode()),
            Task.ACT: self._act,
            Task.ACT_AFTER: lambda *_: self._act_after_packets(),
            Task.DISTURB: self._disturb,
            Task.ALTER: self._alter,
            Task.PIECE: lambda *_: self._chance.randint(1, _LONGEST_PIECE),
            Task.LEDGER: lambda *_: self.ledger.take_entries(),
            Task.RATE: lambda rate, _: self.change_rate(rate),
            Task.WRITTEN: lambda index, goals: self.servos[index].follow_written_goals(
                goals, self._line.end_ns
            ),
        }
        return [tasks[task] for task in Task]

    def _present(self, count: int, now_ns: int) -> None:
        for each in (Asked * count).from_address(self._line.asked):
            self.nodes[each.node].present(now_ns, each.address, each.length)

    def _execute_for(self, index: int, end_ns: int) -> int:
        """Execute an instruction for a node; the data of its reply go to the line."""
        line = self._line
        answer = self.nodes[index].execute_packet(packet_of(line.packet), end_ns)
        if answer is None:
            return -1
        error, data = answer
        line.answer[: len(data)] = data
        line.answer_size = len(data)
        return error

    def _execute_all(self, packet: InstructionPacket, end_ns: int) -> None:
        """Execute an instruction of a bus without servos."""

    def _stay_out(self, index: int, failed: int) -> None:
        packet, entries = packet_of(self._line.packet), self._line.entry_count
        self.nodes[index].decline_group_read(packet, entries, failed=bool(failed))

    def _chain(self, end_ns: int, _: int) -> None:
        listed = self._entries_ids()
        for device in self.devices:
            device.chain(listed, end_ns)

    def _entries_ids(self) -> list[int]:
        ids = ctypes.cast(self._line.entries, ctypes.POINTER(ctypes.c_int32))
        return ids[: 3 * self._line.entry_count : 3]

    def _overhear(self, servo_id: int, due_ns: int) -> None:
        for device in self.devices:
            device.overhear(servo_id, due_ns)

    def _act(self, *_: int) -> None:
        action = heapq.heappop(self._planned)[2]
        self._line.planned_ns = self._planned[0][0] if self._planned else NEVER_NS
        action()

    def _act_after_packets(self) -> None:
        planned = self._planned_after
        while planned and planned[0][0] <= self._line.packets:
            heapq.heappop(planned)[2]()
        self._line.planned_after = planned[0][0] if planned else NEVER_NS

    def _disturb(self, servo_id: int, _: int) -> int:
        """Send a servo's reply with the fault planned for it; return 1 if anything was sent."""
        made = self._line.reply
        reply = DisturbedReply(made.first_ns, made.due_ns, ctypes.string_at(made.data, made.size))
        fault = self._fault_of(servo_id, reply)
        if fault is None:
            fault = PacketFault("", bytes)
        elif fault.text:
            self.add_note(f"servo {servo_id}: {fault.text}")
        data = fault.alter(reply.data)
        copies = fault.copies if data or not fault.is_noticed else 0
        for copy in range(copies):
            at_ns = reply.first_ns + fault.delay_ns + copy * self.duration_ns(len(data))
            last = copy == copies - 1
            self._library.line_send_copy(self.address, data, len(data), at_ns, last, not fault.is_noticed)
        return int(copies > 0)

    def _fault_of(self, servo_id: int, reply: DisturbedReply) -> PacketFault | None:
        """Return the next fault of a servo's replies."""
        faults = self._reply_faults.get(servo_id)
        if not faults:
            return None
        fault = faults.popleft()
        self._line.disturbed[servo_id] = bool(faults)
        return fault

    def _alter(self, *_: int) -> None:
        fault = self._instruction_faults.popleft()
        self._line.altered = bool(self._instruction_faults)
        self.add_note(f"instruction altered by a fault: {fault.text}")
        packet = self._line.packet
        received = fault.alter(ctypes.string_at(packet.raw, packet.raw_size))
        self._library.line_execute_altered(self.address, received, len(received))
