"""Bus: one resumable transaction machine per serial line, and the one wait that pumps all of them.

A machine never waits: it writes an instruction, is fed the bytes that arrive, and is told the time. Whoever
pumps it decides when: read, write, or the gap before the next deadline.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from dxlrun.clock import Clock
from dxlrun.dynamixel.burst import Burst
from dxlrun.dynamixel.bus_plan import BusPlan
from dxlrun.dynamixel.dialect import dialect_of
from dxlrun.dynamixel.line import BITS_PER_BYTE
from dxlrun.dynamixel.port import Port, Ports
from dxlrun.dynamixel.receiver import Receiver
from dxlrun.dynamixel.reply_polling import ReplyPolling
from dxlrun.dynamixel.transaction import (
    BROADCAST_ID,
    Job,
    Outcome,
    Program,
    ProgramJob,
    Reply,
    Result,
    Status,
    Transaction,
)
from dxlrun.errors import PortError
from dxlrun.packets import PacketKind, PacketSink

NEVER = 1 << 62
QUIET_BYTES = 20
"""A line that was silent for so many byte times is silent (protocol.md: drain until it is)."""
LEAST_QUIET_NS = 200_000
DRAIN_LIMIT_NS = 5_000_000
"""A line that babbles longer than this is not waited for."""

LOST_LINE_STEP_NS = 200_000
"""How often the other lines are looked at while one is gone."""

_READY, _AWAITING, _RESTING, _DRAINING = range(4)


class Bus:
    """Executes transactions on one line; every byte that goes over it is reported to the packet sink.

    A reply counts only when ID and length are exact and when it comes no sooner than the wire allows. Of
    several replies to one instruction each counts by itself, whatever became of the others. After a timeout
    the line is drained until it is silent, and what comes then is stray.
    """

    __slots__ = (
        "_awaited",
        "_burst",
        "_byte_ns",
        "_deadline_ns",
        "_dialect",
        "_drain_end_ns",
        "_earliest_ns",
        "_free_ns",
        "_id_at",
        "_index",
        "_job",
        "_last_byte_ns",
        "_now_ns",
        "_open",
        "_opened",
        "_overhead",
        "_parameters",
        "_port",
        "_quiet_ns",
        "_receiver",
        "_refusal",
        "_refused",
        "_reply",
        "_reply_size",
        "_room",
        "_sent_ns",
        "_sink",
        "_state",
        "_views",
        "due_ns",
        "failure",
        "name",
        "noise_bytes",
    )

    def __init__(self, index: int, plan: BusPlan, port: Port, clock: Clock, packets: PacketSink) -> None:
        self.name = plan.name
        self.failure: PortError | None = None
        """Why the line is gone; a bus with a failure does nothing more."""
        self.noise_bytes = 0
        """Bytes that belonged to no intact packet, since the start."""
        self._index = index
        self._port = port
        self._now_ns = clock.now_ns
        self._sink = packets
        self._byte_ns = BITS_PER_BYTE * 1_000_000_000 // plan.baud_rate
        self._quiet_ns = max(QUIET_BYTES * self._byte_ns, LEAST_QUIET_NS) + plan.latency_ns
        self._dialect = dialect_of(plan.protocol)
        self._opened = self._dialect.opened
        self._refusal = self._dialect.refused
        self._overhead = self._dialect.OVERHEAD
        self._id_at = self._dialect.ID_AT
        self._receiver = Receiver(self._status, self._noise, self._dialect, self._gathered)
        self._parameters = memoryview(bytearray(self._dialect.LONGEST))
        self._views: dict[int, memoryview] = {}
        self._reply = Reply(Outcome.SENT, 0, b"", 0, 0, False)
        self._job: Job | None = None
        self._awaited: Transaction | None = None
        self._state = _READY
        self.due_ns = 0
        """When the replies of the newest transaction are due by the wire."""
        self._burst: Burst | None = None  # until anything came
        self._room = self._receiver.space
        self._sent_ns = self._earliest_ns = self._deadline_ns = self._free_ns = 0
        self._drain_end_ns = 0
        self._reply_size = 0
        self._open = 0  # a bit for each status that is still awaited
        self._refused = False
        self._last_byte_ns = -NEVER

    @property
    def busy(self) -> bool:
        """True while a job is under way."""
        return self._job is not None

    @property
    def room(self) -> int:
        """The most bytes that a burst of replies may have."""
        return self._receiver.room

    @property
    def complete(self) -> bool:
        """True when everything that the newest transaction awaits has come."""
        return self._state == _READY and self._reply.outcome is Outcome.OK

    def renew(self, port: Port) -> None:
        """Go on with a line that is back in the place of one that is gone; its job is forgotten."""
        self._port = port
        self.failure = None
        self._job = self._awaited = self._burst = None
        self._state = _READY
        self._receiver.flush()  # the half of a packet that the lost line brought is nobody's

    def load(self, job: Job) -> None:
        """Take a job; the next `step` begins it. What an aborted job left behind is forgotten."""
        self._awaited = self._burst = None
        self._state = _READY
        self.receive()  # what came since the last job belongs to nobody
        if self.failure is not None:
            return
        self._job = job
        self._reply.strays = 0

    def begin_behind(self) -> None:
        """Send the first instruction of the loaded job at once, though the line may not be free yet.

        It waits in the adapter behind what was sent before, and its times count from when the line is free.
        """
        if self._job is not None:
            try:
                self._begin(self._job)
            except PortError as error:
                self._fail(error)

    def drop(self) -> None:
        """Forget the loaded job; what still comes for it belongs to nobody."""
        self._job = self._awaited = self._burst = None
        self._state = _READY

    def send(self, packet: bytes | bytearray | memoryview) -> None:
        """Send a prepared packet that nobody answers, between two jobs; does not wait.

        The next transaction starts when the packet is off the wire. Raises PortError when the line is gone.
        """
        if self.failure is None:
            try:
                self._write(packet, BROADCAST_ID)
            except PortError as error:
                self._fail(error)
        if self.failure is not None:
            raise self.failure

    def receive(self) -> None:
        """Take what the line has; called when it has bytes."""
        if self.failure is None:
            try:
                self._take_bytes()
            except PortError as error:
                self._fail(error)

    def _take_bytes(self) -> None:
        receiver = self._receiver
        burst = self._burst
        if burst is not None and not receiver.pending:
            # nearly always all replies are there at once: no need to keep book of what came when
            count = self._port.read_into(self._room)
            if not count:
                return
            at_ns = self._last_byte_ns = self._now_ns()
            if (
                count == burst.size
                and self._state == _AWAITING
                and burst.whole()
                and self._in_time(burst, at_ns)
            ):
                self._burst = None
                self._take_all(burst, at_ns, [])
                return
            receiver.expect(burst)
            self._burst = None
            receiver.accept(count, at_ns)
        elif receiver.read_from(self._port, self._now_ns):
            self._last_byte_ns = self._now_ns()
        # as many bytes as an awaited reply has, and it is not whole: its header is a false one
        while self._state == _AWAITING and receiver.pending >= self._reply_size and not receiver.gathering:
            receiver.skip_header()

    def step(self, now_ns: int) -> int:
        """Do what is due; return when to come back at the latest, NEVER when there is nothing to do."""
        try:
            while self._job is not None:
                if self._state == _READY:
                    if now_ns < self._free_ns:
                        return self._free_ns
                    now_ns = self._begin(self._job)
                elif now_ns < self._deadline_ns:
                    return self._deadline_ns
                else:
                    self._end(now_ns)
        except PortError as error:
            self._fail(error)
        return NEVER

    def _end(self, now_ns: int) -> None:
        """Do what is due at a transaction's deadline."""
        # bytes may have come while this process was not running: look before giving up
        self.receive()
        if self._state == _AWAITING:
            self._give_up(now_ns)
        elif self._state == _DRAINING and self._quiet_at() > now_ns:
            self._deadline_ns = self._quiet_at()
        elif self._state in (_RESTING, _DRAINING):
            self._receiver.flush()
            self._state = _READY

    def _fail(self, error: PortError) -> None:
        self.failure = error
        self._job = None

    def _begin(self, job: Job) -> int:
        """Hand the reply to the job and start its next transaction; return the time after that."""
        reply = self._reply
        self._awaited = transaction = job.advance(None if self._awaited is None else reply)
        if transaction is None:
            self._job = None
            return 0
        if self._receiver.pending:
            self._receiver.flush()
        self._receiver.expect(None)
        burst = self._burst = job.burst
        reply.parameters = b""
        reply.error = reply.strays = 0
        reply.echoed = False
        packet = transaction.packet
        now_ns = self._write(packet, transaction.servo_id) if packet else self._now_ns()
        started_ns = reply.sent_ns = self._sent_ns if packet else now_ns
        if transaction.awaited:
            reply.outcome = Outcome.TIMEOUT
            self._state = _AWAITING
            self._earliest_ns = started_ns + (len(packet) + self._overhead) * self._byte_ns
            self._deadline_ns = started_ns + transaction.timeout_ns
            self._reply_size = transaction.widest
            self._open = (1 << len(transaction.awaited)) - 1
            self._refused = False
            if burst is not None:
                burst.bind(self._receiver.buffer)
        else:
            reply.outcome = Outcome.SENT
            self._state = _RESTING
            self._deadline_ns = started_ns + transaction.due_ns
        self.due_ns = started_ns + transaction.due_ns
        return now_ns

    def _write(self, packet: bytes | bytearray | memoryview, servo_id: int) -> int:
        """Send a packet; return the time after that."""
        now_ns = self._now_ns
        before = now_ns()
        self._port.write(packet)
        after = now_ns()
        self._sink.packet(self._index, PacketKind.INSTRUCTION, servo_id, before, after, packet)
        # a second packet waits in the adapter until the first is off the wire
        start = self._sent_ns = self._free_ns if self._free_ns > before else before
        self._free_ns = start + len(packet) * self._byte_ns
        return after

    def _give_up(self, now_ns: int) -> None:
        """End a transaction of which not every reply came in time."""
        self._receiver.flush()  # the reply may stand behind a false header
        if self._state != _AWAITING:
            return
        self._reply.outcome = Outcome.GARBLED if self._reply.strays else Outcome.TIMEOUT
        self._drain_end_ns = now_ns + DRAIN_LIMIT_NS
        self._deadline_ns = self._quiet_at()
        self._state = _DRAINING if self._deadline_ns > now_ns else _READY

    def _quiet_at(self) -> int:
        return min(self._last_byte_ns + self._quiet_ns, self._drain_end_ns)

    def _gathered(self, burst: Burst, ends: list[int], times: list[int]) -> bool:
        """Take all replies of a transaction that came in pieces; False: some came too soon to be of now."""
        spans = _spans(burst, ends, times)
        if self._state != _AWAITING or not self._in_time(burst, spans[0][1]):
            return False
        self._take_all(burst, spans[-1][1], spans)
        return True

    def _in_time(self, burst: Burst, first_ns: int) -> bool:
        """Say whether the first reply is of now: one of before, or an echo, comes sooner than the wire."""
        return first_ns >= self._earliest_ns + (burst.first_size - self._overhead) * self._byte_ns

    def _take_all(self, burst: Burst, last_ns: int, spans: list[tuple[int, int]]) -> None:
        """Take all replies of a transaction; `spans`: of each status packet, when they came in pieces."""
        job = self._job
        if job is None:
            return
        packet, index = self._sink.packet, self._index
        if spans:
            for (servo_id, data), (first, last) in zip(burst.packets, spans, strict=True):
                packet(index, PacketKind.STATUS, servo_id, first, last, data)
        else:
            for servo_id, data in burst.packets:
                packet(index, PacketKind.STATUS, servo_id, last_ns, last_ns, data)
        reply = self._reply
        reply.outcome, reply.last_ns = Outcome.OK, last_ns
        self._open = 0
        self._state = _READY
        moments = [last for _, last in spans]
        job.take(burst, moments if len(moments) == burst.count else last_ns)

    def _noise(self, data: memoryview, first_ns: int, last_ns: int) -> None:
        self._sink.packet(self._index, PacketKind.NOISE, BROADCAST_ID, first_ns, last_ns, data)
        # a status of a fast form that is cut off, or spoilt at a place: the parts before it are good
        unused = len(data) - (self._shared(data, last_ns) if self._shares(data) else 0)
        if unused:
            self.noise_bytes += unused
            self._reply.strays += 1

    def _shares(self, data: memoryview) -> bool:
        """Say whether a fast form is awaited, and this looks like its one status, whole or not."""
        awaited = self._awaited
        return (
            awaited is not None
            and awaited.fast
            and self._state == _AWAITING
            and len(data) > self._id_at
            and data[: self._id_at] == self._dialect.HEADER
            and data[self._id_at] == BROADCAST_ID
        )

    def _shared(self, data: memoryview, last_ns: int) -> int:
        """Take what is good of the one status of a fast form; return the number of its bytes."""
        awaited = self._awaited
        if (
            awaited is None
            or self._job is None
            or self._dialect.size_at(data, 0, len(data)) != awaited.widest
        ):
            return 0
        lengths = [one.length for one in awaited.awaited]
        try:
            parts = self._dialect.fast_answers(data, lengths)
        except ValueError:  # spoilt before its first part
            return 0
        used = self._dialect.fast_size(sum(lengths[: len(parts)]), len(parts)) if parts else 0
        if last_ns < self._sent_ns + (len(awaited.packet) + used) * self._byte_ns:
            return 0  # sooner than the wire allows: left over from before
        reply = self._reply
        for index, (one, part) in enumerate(zip(awaited.awaited, parts, strict=False)):
            if part.servo_id != one.servo_id:
                return 0 if index == 0 else used
            reply.error, reply.parameters, reply.last_ns = part.error, part.parameters, last_ns
            self._open &= ~(1 << index)
            self._job.status(index, reply)
        if not self._open:
            reply.outcome = Outcome.OK
            self._state = _READY
        return used

    def _status(self, packet: memoryview, first_ns: int, last_ns: int) -> None:
        self._sink.packet(self._index, PacketKind.STATUS, packet[self._id_at], first_ns, last_ns, packet)
        if self._shares(packet):
            if not self._shared(packet, last_ns):
                self._stray(packet)
            return
        status = self._opened(packet) if self._state == _AWAITING else None
        index = -1 if status is None else self._turn(status, last_ns)
        if status is None or index < 0 or self._job is None:
            self._stray(packet)
            return
        error, parameters = status.error, status.parameters
        length = len(parameters)
        view = self._views.get(length)
        if view is None:
            view = self._views[length] = self._parameters[:length]
        view[:] = parameters
        reply = self._reply
        reply.error = error
        reply.parameters = view
        reply.last_ns = last_ns
        self._open &= ~(1 << index)
        if error and self._refuses(status, index):
            self._refused = True
        else:
            self._job.status(index, reply)
        if not self._open:
            reply.outcome = Outcome.REFUSED if self._refused else Outcome.OK
            self._state = _READY

    def _turn(self, status: Status, last_ns: int) -> int:
        """Return which of the awaited statuses this is; -1 when it is none of them."""
        servo_id, error, parameters = status
        length = len(parameters)
        # an echo, or left over from before, comes sooner than the wire allows
        if self._awaited is None or last_ns < self._earliest_ns + length * self._byte_ns:
            return -1
        for index, one in enumerate(self._awaited.awaited):
            if one.servo_id == servo_id and self._open >> index & 1:
                return index if length == one.length or (error and self._refuses(status, index)) else -1
        return -1

    def _refuses(self, status: Status, index: int) -> bool:
        assert self._awaited is not None  # noqa: S101  a status has its turn
        length = self._awaited.awaited[index].length
        return self._refusal(status.error, len(status.parameters), length)

    def _stray(self, packet: memoryview) -> None:
        self._reply.strays += 1
        if self._awaited is not None and packet == self._awaited.packet:
            self._reply.echoed = True


def _spans(burst: Burst, ends: list[int], times: list[int]) -> list[tuple[int, int]]:
    """Return of each status packet when the read() of its first and of its last byte was."""
    found: list[tuple[int, int]] = []
    start = first = last = 0
    for _, data in burst.packets:
        while ends[first] <= start:
            first += 1
        start += len(data)
        while ends[last] < start:
            last += 1
        found.append((times[first], times[last]))
    return found


def _look(
    buses: Sequence[Bus], ports: Ports, clock: Clock, polling: ReplyPolling, deadline_ns: int
) -> Sequence[int]:
    """Sleep until shortly before replies are due and look for them again and again; return who has bytes."""
    now_ns = clock.now_ns()
    dues = [bus.due_ns for bus in buses if bus.busy]
    # those that should be there since long wait for theirs
    due_ns = min((due for due in dues if due > now_ns), default=max(dues, default=0))
    until_ns = polling.await_until(due_ns, now_ns, deadline_ns)
    if not until_ns:
        return ()
    since_ns, looks = clock.now_ns(), 0
    ready: Sequence[int] = ()
    while not ready and now_ns < until_ns:
        ready = ports.wait(0)
        now_ns = clock.now_ns()
        looks += 1
    polling.spent(now_ns - since_ns, looks)
    return ready


def pump(
    buses: Sequence[Bus], ports: Ports, clock: Clock, beat: Callable[[], None], until_ns: int = NEVER
) -> None:
    """Execute the jobs of all buses side by side: one wait over all ports, until every job is finished.

    Ends at `until_ns` in any case, and a job that is not finished then goes on in the next call. `beat` is
    called at least once a transaction. Raises nothing: a line that is gone has its `failure`, and the others
    go on.
    """
    clock_ns, polling = clock.now_ns, ports.polling
    now_ns = clock_ns()
    deadlines = [bus.step(now_ns) for bus in buses]
    while (deadline := min(deadlines)) != NEVER and now_ns < until_ns:
        beat()
        deadline = min(deadline, until_ns)
        ready = _look(buses, ports, clock, polling, deadline) if polling else ()
        ready = ready or ports.wait(deadline)
        heard = not ready
        for index in ready:
            bus = buses[index]
            if bus.failure is None:
                heard = True
                bus.receive()
                now_ns = clock_ns()
                if polling and bus.complete:
                    polling.came(bus.due_ns, now_ns)
                deadlines[index] = bus.step(now_ns)
        if not heard:
            # a line that is gone is ready for ever: look at the others now and then instead of waiting
            clock.wait_until(min(deadline, clock_ns() + LOST_LINE_STEP_NS))
            for bus in buses:
                bus.receive()
        now_ns = clock_ns()
        if now_ns >= deadline or not heard:
            deadlines = [bus.step(now_ns) for bus in buses]
    beat()


def run(
    programs: Sequence[Program[Result]],
    buses: Sequence[Bus],
    ports: Ports,
    clock: Clock,
    beat: Callable[[], None] = lambda: None,
) -> list[Result | None]:
    """Run one program a bus to its end, blocking, side by side; for set-up and tools, never in the loop.

    Returns what each program returned; None where the line is gone, and the bus' `failure` says why.
    """
    jobs = [ProgramJob(program) for program in programs]
    for bus, job in zip(buses, jobs, strict=True):
        bus.load(job)
    pump(buses, ports, clock, beat)
    return [job.result for job in jobs]
