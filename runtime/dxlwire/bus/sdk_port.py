"""SDK port: exchanges packets by the packet handlers of `dynamixel-sdk`, the servos' maker, on a tool's port.

The packet handlers build instructions and parse status packets. They take any status of the right ID for the
reply, even a late reply to another request (dynamixel-sdk 4.1.0, `txRxPacket`). The port handler therefore
gives them only the status that answers the request, by the rule of `dxlwire.exchange.owed`. A tool can wait,
so each request is held back until no late reply can be taken for its own.
"""

from __future__ import annotations

from dynamixel_sdk import COMM_RX_CORRUPT, COMM_RX_TIMEOUT, COMM_SUCCESS, PortHandler
from dynamixel_sdk import Protocol1PacketHandler as Protocol1Packets
from dynamixel_sdk import Protocol2PacketHandler as Protocol2Packets

from dxlwire.bus.adjustable_port import AdjustablePort
from dxlwire.exceptions import PortError
from dxlwire.exchange.bus_engine import LEAST_QUIET_NS, PATIENT_DRAIN_LIMIT_NS, QUIET_BYTES
from dxlwire.exchange.owed import OwedReplies
from dxlwire.packets import PacketKind, PacketSink
from dxlwire.plan.line import BITS_PER_BYTE
from dxlwire.transaction import BROADCAST_ID, NO_REGISTER, Reply, Status, Transaction, TransactionOutcome
from dxlwire.wire import protocol2
from dxlwire.wire.dialect import dialect_of
from dxlwire.wire.receiver import Receiver

_RESULTS = {
    COMM_SUCCESS: TransactionOutcome.OK,
    COMM_RX_TIMEOUT: TransactionOutcome.TIMEOUT,
    COMM_RX_CORRUPT: TransactionOutcome.GARBLED,
}


class StuffedPackets(Protocol2Packets):  # type: ignore[misc]  # the package has no types
    """Packet handler of Protocol 2.0 with correct byte stuffing.

    That of dynamixel-sdk 4.1.0 sends `FF FF FD` in a parameter without stuffing, because `txPacket` drops the
    result of `addStuffing`. It also removes a byte too many after a first stuffing byte in a status.
    """

    def addStuffing(self, packet: list[int]) -> list[int]:
        """Add the stuffing to an instruction in place; its last two bytes are those of the CRC."""
        packet[5:] = self._body(protocol2.stuffed(bytes(packet[7:-2])), packet)
        return packet

    def removeStuffing(self, packet: list[int]) -> list[int]:
        """Return a packet without the stuffing."""
        return [*packet[:5], *self._body(protocol2.unstuffed(bytes(packet[7:-2])), packet)]

    def _body(self, body: bytes, packet: list[int]) -> list[int]:
        return [*(len(body) + 2).to_bytes(2, "little"), *body, *packet[-2:]]


class SdkPort(PortHandler):  # type: ignore[misc]  # the package has no types
    """Port handler on an open port, at one protocol and rate: records every byte, drains late replies, and
    gives the packet handlers only the status that answers their instruction.
    """

    def __init__(self, port: AdjustablePort, protocol: float, baud_rate: int, sink: PacketSink) -> None:
        super().__init__(port.name)
        self.baudrate = baud_rate
        self.ids: set[int] = set()
        """IDs in the intact status packets that were received, expected or not."""
        self.noise = 0  # bytes received outside of intact packets
        self._port, self._sink, self._now_ns = port, sink, port.clock.now_ns
        self._dialect = dialect_of(protocol)
        self._packets = Protocol1Packets() if protocol == 1.0 else StuffedPackets()
        self._receiver = Receiver(self._take_packet, self._take_noise, self._dialect)
        self._owed = OwedReplies(self._now_ns)
        self._byte_ns = BITS_PER_BYTE * 1_000_000_000 // baud_rate
        self._quiet_ns = max(QUIET_BYTES * self._byte_ns, LEAST_QUIET_NS)
        self._request: Transaction | None = None  # the one whose reply is awaited
        self._answer = b""  # bytes of that reply which the packet handler has not read yet
        self._written = b""
        self._sent_ns = self._deadline_ns = self._last_byte_ns = 0
        self._strays, self._echoed = 0, False

    def clear_records(self) -> None:
        """Forget the IDs that answered, and the noise."""
        self.ids.clear()
        self.noise = 0

    def exchange(self, request: Transaction) -> Reply:
        """Send a request with at most one awaited reply, and return the reply; listen if it has no packet.

        Raises:
            PortError: The line is gone.
        """
        self._strays, self._echoed = 0, False
        self._note_owed()  # Ctrl-C may have ended the exchange before
        self._receive(0)
        if request.awaited:
            self._hold_back(request)
        self._receiver.flush()
        self._sent_ns = self._now_ns()
        reply = Reply(TransactionOutcome.SENT, 0, b"", 0, 0, False)
        if request.packet:
            self._send(request, reply)
        if not request.awaited:
            while self._now_ns() < self._sent_ns + request.due_ns:
                self._receive(self._sent_ns + request.due_ns)
            self._receiver.flush()
        reply.strays, reply.echoed = self._strays, self._echoed
        reply.last_ns, reply.sent_ns = self._last_byte_ns, self._sent_ns
        if reply.outcome is TransactionOutcome.TIMEOUT and self._strays:
            reply.outcome = TransactionOutcome.GARBLED
        return reply

    def _send(self, request: Transaction, reply: Reply) -> None:
        """Send an instruction by the packet handler, and fill in the reply to it."""
        plain = [*request.packet]
        if self._dialect is protocol2:
            plain = self._packets.removeStuffing(plain)
        self._request, self._answer, self.is_using = request, b"", False
        status, result, error = self._packets.txRxPacket(self, plain)
        self._note_owed()
        if not request.awaited:
            return
        if result not in _RESULTS:
            raise PortError(f"{self.port_name}: {self._packets.getTxRxResult(result)}")
        reply.outcome = _RESULTS[result]
        reply.asked_ns = self._owed.asked_ns(request, self._sent_ns)
        (awaited,) = request.awaited
        if result == COMM_SUCCESS:
            overhead = self._dialect.OVERHEAD - self._dialect.CHECKSUM
            reply.error, reply.parameters = error, bytes(status[overhead : -self._dialect.CHECKSUM])
            if error and self._dialect.refused(error, len(reply.parameters), awaited.length):
                reply.outcome = TransactionOutcome.REFUSED

    def _note_owed(self) -> None:
        """Give up the awaited reply, which may still arrive."""
        if self._request is not None and self._request.awaited:
            self._owed.add(self._request, 0, self._sent_ns)
        self._request = None

    def _hold_back(self, request: Transaction) -> None:
        """Wait until the line is quiet, and no late reply can be taken for the reply to a request."""
        begin_ns = now_ns = self._now_ns()
        while now_ns < begin_ns + request.patience_ns:
            quiet_ns = min(self._last_byte_ns + self._quiet_ns, begin_ns + PATIENT_DRAIN_LIMIT_NS)
            until_ns = max(quiet_ns, self._owed.free_ns(request))
            if until_ns <= now_ns:
                break
            self._receive(min(until_ns, begin_ns + request.patience_ns))
            now_ns = self._now_ns()

    def _receive(self, until_ns: int) -> None:
        """Wait for bytes until a time, and take those that have arrived."""
        if data := self._port.receive_bytes(until_ns):
            self._last_byte_ns = self._now_ns()
            self._receiver.feed_bytes(data, self._last_byte_ns)

    # Methods that the packet handlers call

    def clearPort(self) -> None:
        """Do nothing: `exchange` has taken and recorded what arrived before the instruction."""

    def writePort(self, packet: list[int]) -> int:
        """Write an instruction to the port, and record it."""
        self._written = bytes(packet)
        self._sent_ns = self._now_ns()
        self._port.send_bytes(self._written)
        servo_id = packet[self._dialect.ID_AT]
        self._sink.packet(0, PacketKind.INSTRUCTION, servo_id, self._sent_ns, self._now_ns(), self._written)
        if self._request is not None and all(one.address == NO_REGISTER for one in self._request.awaited):
            self._owed.note_change(self._request, self._sent_ns)
        return len(packet)

    def setPacketTimeout(self, packet_length: int) -> None:
        """Start the timeout of the request; that of the SDK assumes 34 ms of latency for every adapter."""
        self._deadline_ns = self._now_ns() + (self._request.timeout_ns if self._request else 0)

    def isPacketTimeout(self) -> bool:
        """Return True if the request has timed out, by the clock that the wall clock does not move."""
        return not self._answer and self._now_ns() >= self._deadline_ns

    def readPort(self, length: int) -> bytes:
        """Return the next bytes of the status that answers the request; wait for it until the timeout."""
        while not self._answer:
            # Bytes may have arrived while this process had no processor, so read once more at the deadline.
            overdue = self.isPacketTimeout()
            self._receive(self._deadline_ns)
            if overdue:
                self._receiver.flush()  # a false header may hide the reply
                break
        data, self._answer = self._answer[:length], self._answer[length:]
        return data

    # Received packets

    def _take_packet(self, packet: memoryview, first_ns: int, last_ns: int) -> None:
        kind, servo_id = PacketKind.STATUS, packet[self._dialect.ID_AT]
        status = self._dialect.opened(packet)
        if status is not None and self._answers(status, last_ns):
            self._answer, self._request = bytes(packet), None
        elif packet == self._written:
            kind, self._echoed = PacketKind.ECHO, True
        elif status is not None and self._owed.charge_reply(servo_id, len(status.parameters), status.error):
            kind = PacketKind.LATE
        elif status is None or self._dialect.instructs(packet):
            kind = PacketKind.OTHER_HOST
        else:
            self._strays += 1
        if kind in (PacketKind.STATUS, PacketKind.LATE):
            self.ids.add(servo_id)
        self._sink.packet(0, kind, servo_id, first_ns, last_ns, packet)

    def _take_noise(self, data: memoryview, first_ns: int, last_ns: int) -> None:
        self._strays += 1
        self.noise += len(data)
        self._sink.packet(0, PacketKind.NOISE, BROADCAST_ID, first_ns, last_ns, data)

    def _answers(self, status: Status, last_ns: int) -> bool:
        """Return True if a status answers the awaited request, and no other one."""
        request, size = self._request, len(status.parameters)
        awaited = next(iter(request.awaited), None) if request is not None else None
        if request is None or awaited is None or status.servo_id != awaited.servo_id:
            return False
        # An echo or a leftover of the request before comes sooner than the wire allows.
        on_wire = len(self._written) + self._dialect.OVERHEAD + size
        refused = status.error != 0 and self._dialect.refused(status.error, size, awaited.length)
        if last_ns < self._sent_ns + on_wire * self._byte_ns or not (refused or size == awaited.length):
            return False
        if self._owed.confuses(request, awaited, refusal=refused, any_age=request.any_age):
            return False
        self._owed.note_answer(request, awaited, self._sent_ns)
        return True
