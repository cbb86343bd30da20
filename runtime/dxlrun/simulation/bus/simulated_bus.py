"""A simulated bus: bytes in -> timed bytes out; one half-duplex line, its servos, faults and ledger.

The rules of the line:

- A byte takes 10 bits. An instruction acts when its last byte has passed; a reply starts after the servo's
  return delay, and the host gets it when its last byte has passed and the adapter hands it over.
- Who talks does not listen. Where the host talks into a reply, its bytes arrive as 0, and the reply is lost
  from there on.
- Servos that talk at once (a broadcast ping, two servos with one ID) give one reply of their bytes ANDed, as
  drivers that both pull a line low would [i].
- A pause inside an instruction ends it: more than 100 ms (Protocol 1.0), more than 1.5 ms (Protocol 2.0).
- Servos that are read in turn answer one after the other, each its return delay after it heard the one before
  it; what they answer is their state when the instruction ended [i].
- A servo at another baud rate hears nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from dxlrun.simulation.bus.adapter import Adapter
from dxlrun.simulation.bus.agenda import Agenda
from dxlrun.simulation.bus.delivery import Delivery
from dxlrun.simulation.bus.flow import Flow
from dxlrun.simulation.bus.ledger import OTHER_HOST, Ledger
from dxlrun.simulation.bus.listeners import Listeners, ServoCounts
from dxlrun.simulation.bus.said import Readings
from dxlrun.simulation.bus.wire import STATUS_BYTES, Alteration, Chain, Change, Chunk, Wire, flipped
from dxlrun.simulation.configuration import BusConfig, ServoConfig
from dxlrun.simulation.motion.mechanics import Mechanics
from dxlrun.simulation.servo.simulated_servo import SimulatedServo
from dxlrun.simulation.wire import protocol1, protocol2
from dxlrun.simulation.wire.packets import Codec, InstructionPacket, ReadInTurn, Reply


class SimulatedBus:
    """One line; time comes from the caller and never goes back."""

    def __init__(
        self, config: BusConfig, ledger: Ledger, start_ns: int, mechanics: Mechanics | None = None
    ) -> None:
        self.name = config.name
        self.protocol = config.protocol
        self.absent = config.absent
        self.echo = config.adapter.echo
        self.ledger = ledger
        self.plugged = True
        """False: nothing is between the host and the line."""
        self.times_unplugged = 0
        self.servos: tuple[SimulatedServo, ...] = ()
        self.mechanics = mechanics or Mechanics(start_ns)
        """What the servos move; several buses of one robot share it."""
        self._now_ns = start_ns
        self._host_free_ns = start_ns
        self._codec: Codec = protocol2 if config.protocol == 2.0 else protocol1
        self._receiver = self._codec.receiver()
        self._wire = Wire(config.baud_rate, self.note)
        self._adapter = Adapter(config.adapter, start_ns)
        self._delivery = Delivery(self._adapter, ledger, config.name)
        self.lateness_ns = self._delivery.lateness_ns
        """How long after its time the host got what it got last, in real time."""
        self._wedged = False
        self._chain: Chain | None = None
        self._flow: Flow | None = None
        """Answers that nobody disturbs: nothing else is on the line, or planned before they end."""
        self._changes: dict[int, deque[Change]] = {}
        self._instruction_changes: deque[Change] = deque()
        self._agenda = Agenda()
        self._counts: dict[SimulatedServo, ServoCounts] = {}
        self._listeners = Listeners(config.baud_rate)
        self._readings = Readings(self._codec, self._wire.duration_ns, self._listeners, self._counts)
        for servo in config.servos:
            self.add_servo(servo)

    # The line

    def receive(self, data: bytes | bytearray | memoryview, at_ns: int) -> None:
        """Take bytes that the host hands to its adapter at `at_ns`; they follow those still on the wire."""
        heard = bytes(data)
        self._pass_time(at_ns)
        self.ledger.add(at_ns, self.name, "in", heard)
        if self._wedged or not self.plugged:
            self.note(f"{len(heard)} bytes of the host do not reach the line")
            return
        start_ns = max(at_ns, self._host_free_ns)
        if self._receiver.pending and start_ns - self._host_free_ns > self._codec.LONGEST_PAUSE_NS:
            self.note(f"an instruction of {self._receiver.pending} bytes was broken off")
            self._receiver.forget()
        self._host_free_ns = start_ns + self._wire.duration_ns(len(heard))
        self._hear(heard, start_ns)
        if self.echo:
            self._wire.echo(Chunk(start_ns, self._host_free_ns, heard, "echo"))

    @property
    def baud_rate(self) -> int:
        """The host's rate, bit/s."""
        return self._wire.baud_rate

    @baud_rate.setter
    def baud_rate(self, baud_rate: int) -> None:
        self._break_up()
        self._wire.baud_rate = baud_rate
        self._listeners.change_rate(baud_rate)

    def change_rate(self, baud_rate: int) -> None:
        """Let the host talk and listen at another rate from now on, bit/s."""
        self.note(f"the host's rate is {baud_rate} bit/s")
        self.baud_rate = baud_rate

    def next_due_ns(self) -> int | None:
        """Return when something happens by itself: bytes can be taken, a fault comes; None: nothing will."""
        if self._flow is not None:
            return self._flow.next_ns()  # what is planned comes later
        passing = self._wire.passing
        due_ns = None if self._wedged else self._adapter.next_ns(passing)
        if passing and (due_ns is None or passing[0].due_ns < due_ns):
            due_ns = passing[0].due_ns  # perhaps somebody waits for it, to answer next
        planned_ns = self._agenda.next_ns
        return planned_ns if planned_ns is not None and (due_ns is None or planned_ns < due_ns) else due_ns

    def next_delivery_ns(self, gather_ns: int) -> int | None:
        """Return `next_due_ns`, or when the last answer has passed that follows it within a time."""
        return self.next_due_ns() if self._flow is None else self._flow.gathered_ns(gather_ns)

    def take(self, now_ns: int, *, handed_ns: int | None = None) -> bytes:
        """Return the bytes that have reached the host by `now_ns`, each once.

        `handed_ns`: when the host really gets them; how late that is belongs into the ledger.
        """
        self._pass_time(now_ns)
        if (flow := self._flow) is not None:
            data = self._delivery.take_flow(flow, handed_ns)
            if flow.over:
                self._flow = None
            return data
        passing = self._wire.passing
        if self._wedged or not (passing or self._adapter.holds):
            return b""
        return self._delivery.take(now_ns, passing, handed_ns)

    # What tests see and do

    @property
    def host_free_ns(self) -> int:
        """When the last byte that the host handed over has passed the wire."""
        return self._host_free_ns

    @property
    def now_ns(self) -> int:
        """The time that the bus has reached."""
        return self._now_ns

    def servo(self, servo_id: int) -> SimulatedServo:
        """Return the first servo that has this ID now; raises LookupError when none has."""
        for servo in self.servos:
            if servo.servo_id == servo_id:
                return servo
        raise LookupError(f"bus {self.name} has no servo with ID {servo_id}")

    def add_servo(self, config: ServoConfig) -> SimulatedServo:
        """Hang one more servo on the line, now."""
        servo = SimulatedServo(
            config, self.baud_rate, self._now_ns, self.note, self.protocol, mechanics=self.mechanics
        )
        self.servos += (servo,)
        self._counts[servo] = ServoCounts()
        self._listeners.add(servo)
        return servo

    def counts(self, servo: SimulatedServo) -> ServoCounts:
        """Return what a servo of this bus did so far; raises KeyError for one of another bus."""
        self._readings.count()
        return self._counts[servo]

    def advance(self, now_ns: int) -> None:
        """Bring every servo to a time, so that a test can look at it."""
        self._pass_time(now_ns)
        for servo in self.servos:
            servo.advance(now_ns)

    def at(self, t_ns: int, action: Callable[[], None]) -> None:
        """Plan a fault: `action` is called when the bus' time reaches `t_ns`."""
        self._break_up()
        self._agenda.at(t_ns, action)

    def after(self, packets: int, action: Callable[[], None]) -> None:
        """Plan a fault: `action` is called when the servos have obeyed so many more instruction packets."""
        self._agenda.after(packets, action)

    def note(self, text: str) -> None:
        """Enter a note into the ledger, at the bus' time."""
        self.ledger.add(self._now_ns, self.name, "note", note=text)

    def alter_next(
        self, servo_id: int, text: str, change: Alteration, *, delay_ns: int = 0, copies: int = 1
    ) -> None:
        """Change a servo's next reply, let it start later or come several times; the ledger gets `text`."""
        self._break_up()
        self._changes.setdefault(servo_id, deque()).append(Change(text, change, delay_ns, copies))

    def alter_next_instruction(self, text: str, change: Alteration) -> None:
        """Change what the servos hear of the next whole instruction; b"" loses it."""
        self._instruction_changes.append(Change(text, change))

    def corrupt_next(self, servo_id: int, index: int = -1, flip: int = 0x01) -> None:
        """Flip bits of one byte of a servo's next reply."""
        text = f"byte {index} of its reply corrupted by {flip:#04x}"
        self.alter_next(servo_id, text, lambda reply: flipped(reply, index, flip))

    def truncate_next(self, servo_id: int, keep: int) -> None:
        """Let only the first `keep` bytes of a servo's next reply through; 0 loses it."""
        self.alter_next(servo_id, f"its reply cut to {keep} bytes", lambda reply: reply[:keep])

    def delay_next(self, servo_id: int, delay_ns: int) -> None:
        """Let a servo's next reply start later."""
        self.alter_next(servo_id, f"its reply delayed by {delay_ns} ns", bytes, delay_ns=delay_ns)

    def other_host(self, packet: bytes, at_ns: int, *, heard: bool = True) -> None:
        """Let another host on the line send an instruction packet at a time: the servos execute it, and this
        host gets the instruction and their replies.

        `heard=False`: it sends by the adapter of this host, which gives back the replies only.
        """

        def send() -> None:
            self.note(f"{OTHER_HOST} {packet.hex(' ')}")
            start_ns, end_ns = self._now_ns, self._now_ns + self._wire.duration_ns(len(packet))
            if heard:
                self._wire.send(Chunk(start_ns, end_ns, packet, "another host"))
            instruction = self._codec.receiver().feed(packet, 0)
            if instruction is not None:
                self._execute(instruction, end_ns)

        self.at(at_ns, send)

    def inject_noise(self, data: bytes, at_ns: int) -> None:
        """Put bytes on the line that no servo sent, toward the host, beginning at `at_ns`."""
        self._break_up()
        self.note(f"noise of {len(data)} bytes at {at_ns} ns")
        self._wire.send(Chunk(at_ns, at_ns + self._wire.duration_ns(len(data)), data, "noise"))

    def unplug(self) -> None:
        """Pull the adapter: what it holds is lost, and the host sees its port go."""
        if self.plugged:
            self._break_up()
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

    def wedge(self, on: bool = True) -> None:
        """Let the adapter take the host's bytes and pass none on, in either direction; or mend it."""
        self._break_up()
        self.note("adapter wedged" if on else "adapter mended")
        self._wedged = on
        self._adapter.forget()

    # Inside: time

    def _pass_time(self, now_ns: int) -> None:
        """Let everything happen that happens by itself until `now_ns`, in order."""
        passing, agenda = self._wire.passing, self._agenda
        if self._flow is not None:
            self._flow.pass_until(now_ns)
        while passing or agenda.next_ns is not None:
            t_ns = agenda.next_ns
            if passing and passing[0].due_ns <= now_ns and (t_ns is None or t_ns >= passing[0].due_ns):
                self._arrive(passing.pop(0))
            elif t_ns is not None and t_ns <= now_ns:
                self._break_up()
                self._now_ns = max(self._now_ns, t_ns)
                agenda.pop()()
            else:
                break
        self._now_ns = max(self._now_ns, now_ns)

    def _break_up(self) -> None:
        """Let answers that nobody disturbed so far pass chunk by chunk."""
        if self._flow is None:
            return
        arrived, passing = self._flow.break_up()
        self._flow = None
        self._adapter.arrived.extend(arrived)
        self._wire.passing.extend(passing)
        self._chain = passing[0].chain if passing else None

    def _hand(self, chunk: Chunk) -> None:
        """Let the adapter have what has passed the wire."""
        if not self.plugged or self._wedged:
            self.note(f"{len(chunk.data)} bytes to the host are lost: {chunk.data.hex(' ')}")
        elif not self._adapter.accept(chunk):
            self.note(f"{len(chunk.data)} bytes to the host are lost: it does not read")

    def _arrive(self, chunk: Chunk) -> None:
        """Let the adapter have what has passed the wire, and who waits for its end answer."""
        self._now_ns = max(self._now_ns, chunk.due_ns)
        self._hand(chunk)
        chain = chunk.chain
        if chain is None or chain is not self._chain:
            return
        if not chunk.broken:
            self._continue(chain, chunk.due_ns)
        elif chain.has_slots:
            self._continue(chain, max(chunk.due_ns, chain.slot_end_ns))
        else:
            self.note("a broken answer: those after it wait for it in vain")
            self._chain = None

    # Inside: instructions
    def _hear(self, heard: bytes | bytearray, start_ns: int) -> None:
        position = 0
        while position < len(heard):
            self._break_up()
            if self._wire.passing:
                heard = bytearray(heard)
                self._wire.talk_over(heard, position, start_ns)
            packet = self._receiver.feed(heard, position)
            if packet is None:
                return
            position = packet.end
            end_ns = start_ns + self._wire.duration_ns(position)
            obey = self._mishear if self._instruction_changes else self._execute
            obey(packet, end_ns)

    def _mishear(self, packet: InstructionPacket, end_ns: int) -> None:
        """Let the servos hear something else than the host said."""
        fault = self._instruction_changes.popleft()
        self.note(f"the servos hear another instruction: {fault.text}")
        heard = fault.change(packet.raw)
        position = 0
        while (other := self._receiver.feed(heard, position)) is not None:
            position = other.end
            self._execute(other, end_ns)
        if not position:  # it was one all the same
            self._agenda.packet_passed()

    def _execute(self, packet: InstructionPacket, end_ns: int) -> None:
        self._chain = None  # who waited for its turn hears another instruction
        reading = self._codec.read_in_turn(packet)
        if reading is not None:
            self._read_in_turn(reading, end_ns)
        else:
            self._readings.count()
            for servo in self._listeners.of(packet.servo_id):
                counts = self._counts[servo]
                counts.heard += packet.intact
                reply = servo.execute(packet, end_ns)
                if reply is not None:
                    counts.answer(reply.error)
                    self._answer(reply, self._status(reply), end_ns)
        self._agenda.packet_passed()

    def _read_in_turn(self, reading: ReadInTurn, end_ns: int) -> None:
        """Let the listed servos answer, each when it has heard the one before it."""
        slots = reading.has_slots and self.absent == "slot"
        told = self._readings.said(reading, slots, end_ns)
        if told.flow is not None and self._undisturbed(reading, end_ns + told.flow.lasts_ns):
            self._flow = told.flow.begin(end_ns)
        else:
            shared = self._codec.fast_status(reading.lengths) if reading.fast else None
            self._chain = Chain(reading, deque(told.answers), shared, slots)
            self._continue(self._chain, end_ns)

    def _undisturbed(self, reading: ReadInTurn, end_ns: int) -> bool:
        """Return whether nothing but the answers passes the line, and nothing is to happen, until a time."""
        planned_ns, changes = self._agenda.next_ns, self._changes
        if self._wire.passing or self._adapter.holds or (planned_ns is not None and planned_ns <= end_ns):
            return False
        changed = changes and any(changes.get(entry.servo_id) for entry in reading.entries)
        return self._adapter.immediate and not self.echo and not changed

    def _continue(self, chain: Chain, free_ns: int) -> None:
        """Let the next one answer; nobody does any more when there is none."""
        while chain.waiting:
            entry, replies = chain.waiting.popleft()
            slot_ns = self._wire.duration_ns(STATUS_BYTES + entry.length)
            chain.slot_end_ns = free_ns + slot_ns
            sent = False
            for reply in replies:  # two servos with one ID talk at once
                data = self._status(reply) if chain.fast is None else chain.fast.part(reply)
                chain.slot_end_ns = free_ns + reply.delay_ns + slot_ns
                sent = self._answer(reply, data, free_ns, chain) or sent
            if sent:
                return  # its end is heard
            free_ns = chain.slot_end_ns
            if not chain.has_slots:
                self.note(f"servo {entry.servo_id} does not answer: those after it wait for it in vain")
                break
        self._chain = None

    def _status(self, reply: Reply) -> bytes:
        return self._codec.status_packet(reply.servo_id, reply.error, reply.parameters)

    def _answer(self, reply: Reply, data: bytes, free_ns: int, chain: Chain | None = None) -> bool:
        """Send a servo's bytes, faults and all, some time after the line is free; False: nothing was sent."""
        first_ns = free_ns + reply.delay_ns
        changes = self._changes.get(reply.servo_id)
        if not changes:
            self._wire.send(Chunk(first_ns, first_ns + self._wire.duration_ns(len(data)), data, "", chain))
            return True
        fault = changes.popleft()
        self.note(f"servo {reply.servo_id}: {fault.text}")
        said = fault.change(data)
        first_ns += fault.delay_ns
        for copy in range(fault.copies if said else 0):
            end_ns = first_ns + self._wire.duration_ns(len(said))
            heard_by = chain if copy == fault.copies - 1 else None
            self._wire.send(Chunk(first_ns, end_ns, said, "", heard_by, broken=said != data))
            first_ns = end_ns
        return bool(said) and fault.copies > 0
