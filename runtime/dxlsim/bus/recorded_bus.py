"""Recorded bus: replays to a host the answers that the host of a recording received, with their delays.

- A recorded instruction gets its recorded answer: bytes, errors, noise and silence. Each repetition gets the
  next recorded answer. After the end of the recording the last answer is repeated.
- A ping, or a read that is not in the recording, is answered if all its bytes are known from other reads. The
  answer has the newest known values, no error, and a return delay at the factory setting.
- Other instructions are not answered. If an answer was due, the ledger gets a note.
- Instructions at another baud rate than the recorded one are ignored.
"""

from __future__ import annotations

from collections.abc import Iterator

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.recording import BusRecording, RecordedPackets, RecordedReply
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.motion.mechanics import Mechanics
from dxlsim.simulation_plan import BusConfig
from dxlsim.wire.compiled_line import InstructionReceiver, group_read, line_library, read_place, status_packet
from dxlsim.wire.servo_packets import BROADCAST, Instruction, InstructionPacket, ReadEntry

_MODEL, _FIRMWARE = (0, 1), (6,)
"""Addresses of the data in a ping answer of Protocol 2.0 (e-Manual, X series, Control Table). Other models
have the firmware elsewhere, so their unrecorded pings are not answered."""
_Sent = tuple[int, int, bytes]  # Begin and end on the wire, ns, and bytes
_ANSWER_NS = 500_000  # Delay of a constructed answer: Return Delay Time at its factory setting (e-Manual)


class RecordedBus(SimulatedBus):
    """Simulated bus that replays a recording to the host, without servos.

    Raises:
        InputError: The recording has no instruction.
    """

    def __init__(
        self,
        config: BusConfig,
        ledger: Ledger,
        start_ns: int,
        packets: RecordedPackets,
        mechanics: Mechanics | None = None,
    ) -> None:
        super().__init__(config, ledger, start_ns, mechanics)
        self._recorded_rate = config.baud_rate
        self._recording = BusRecording(packets, config.baud_rate)
        self._reads = tuple(self._recorded_reads())
        self._line.recorded = 1

    def _execute_all(self, packet: InstructionPacket, end_ns: int) -> None:
        if line_library().line_rates_match(self._recorded_rate, self.baud_rate):
            heard = self._recording.replay_answer(packet.raw)
            if heard is None:
                heard = self._known(packet)
            if heard is None and (packet.servo_id != BROADCAST or group_read(self.protocol, packet)):
                self.add_note(f"instruction not in the recording: {packet.raw.hex(' ')}")
            for first_ns, due_ns, data in self._transmissions(heard or (), end_ns):
                self._library.line_send_reply(
                    self.address, packet.servo_id, data, len(data), first_ns, due_ns
                )

    def _transmissions(self, heard: tuple[RecordedReply, ...], end_ns: int) -> Iterator[_Sent]:
        """Yield recorded bytes as transmissions after an instruction that ended at `end_ns`; bytes that
        overlap in time are joined."""
        waiting: _Sent | None = None
        for delay_ns, data in heard:
            wire_ns = self.duration_ns(len(data))
            # If a host sent into a reply, bytes of that reply arrived before the end of the host's own bytes.
            due_ns = max(end_ns + delay_ns, self.now_ns)
            if waiting is not None and due_ns <= waiting[1]:
                waiting = waiting[0], waiting[1], waiting[2] + data
                continue
            first_ns = due_ns - wire_ns
            if waiting is not None:
                yield waiting
                first_ns = max(first_ns, waiting[1])  # An adapter held the previous bytes back
            waiting = first_ns, due_ns, data
        if waiting is not None:
            yield waiting

    # Answers from other reads

    def _recorded_reads(self) -> Iterator[tuple[bytes, tuple[ReadEntry, ...]]]:
        for instruction in self._recording.instructions:
            packet = InstructionReceiver(self.protocol).feed_bytes(instruction)
            if packet is None or not packet.intact:
                continue
            group = group_read(self.protocol, packet)
            if group is not None and not group.fast:
                yield instruction, group.entries
            elif (entry := self._read_target(packet)) is not None:
                yield instruction, (entry,)

    def _read_target(self, packet: InstructionPacket) -> ReadEntry | None:
        """Return ID, address and length that a read of one servo asks for, or None for another
        instruction."""
        if packet.instruction != Instruction.READ or packet.servo_id == BROADCAST:
            return None
        place = read_place(self.protocol, packet.parameters)
        return None if place is None else ReadEntry(packet.servo_id, *place)

    def _known(self, packet: InstructionPacket) -> tuple[RecordedReply, ...] | None:
        """Return the answer to a ping or a read, composed of other recorded reads, or None if a byte is
        unknown."""
        if not packet.intact or packet.servo_id == BROADCAST:
            return None
        entry = self._read_target(packet)
        if entry is not None:
            addresses = tuple(range(entry.address, entry.address + entry.length))
        elif packet.instruction == Instruction.PING and not packet.parameters:
            addresses = (*_MODEL, *_FIRMWARE) if self.protocol == 2.0 else ()
        else:
            return None
        known = self._registers(packet.servo_id)
        if not known or not all(address in known for address in addresses):
            return None
        content = bytes(known[address] for address in addresses)
        data = status_packet(self.protocol, packet.servo_id, 0, content)
        return (RecordedReply(_ANSWER_NS + self.duration_ns(len(data)), data),)

    def _registers(self, servo_id: int) -> dict[int, int]:
        """Return the bytes of a servo's control table that recorded reads show, by address."""
        known: dict[int, int] = {}
        for instruction, entries in self._reads:
            asked = {entry.servo_id: entry for entry in entries}
            if servo_id not in asked:
                continue
            for _, data in self._recording.newest(instruction):
                status = InstructionReceiver(self.protocol).feed_bytes(data)
                if status is None or not status.intact or status.servo_id != servo_id:
                    continue
                # A status packet has its error in place of the instruction code (Protocol 1.0), or after that
                # code.
                content = status.parameters[1:] if self.protocol == 2.0 else status.parameters
                entry = asked[servo_id]
                if len(content) == entry.length:
                    known.update(
                        zip(range(entry.address, entry.address + entry.length), content, strict=True)
                    )
        return known
