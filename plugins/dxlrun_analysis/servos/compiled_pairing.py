"""Compiled pairing: structs and functions of `pairing.c`, and the columns that they fill."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from ctypes import byref, c_int64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun.tooling.compiled_code import load_compiled, parse_structs
from dxlrun.tooling.logs import PacketColumns
from dxlrun_analysis.plan_excerpt import LoggedBus
from dxlrun_analysis.servos.logged_requests import IDS, DistinctRequests, Flags, Numbers
from dxlwire import PacketKind

SOURCE = Path(__file__).with_name("pairing.c")
_BYTES = 256  # Values of an error byte
_KINDS = max(PacketKind) + 1
_STRUCTS = parse_structs(SOURCE.read_text())
_ARGUMENTS = {"split": 5, "count_replies": 4, "pair_replies": 8}  # Number of arguments of each function


class ExchangeColumns(NamedTuple):
    """Columns of shape (exchanges,): those of `Exchanges` under the same names, `row` and `asked_id`."""

    bus: Numbers
    cycle: Numbers
    request: Numbers
    asked_ns: Numbers
    blocked_ns: Numbers
    sent_ns: Numbers
    last_ns: Numbers
    noise: Numbers
    answer: Numbers
    kind: Numbers
    extra_ns: Numbers
    row: Numbers  # Row of the instruction in the packets; -1 without one
    asked_id: Numbers  # ID in the instruction; -1: any servo may answer, or no instruction


class Replies(NamedTuple):
    """Replies of single servos as columns, shape (replies,), in order of time. A fast status packet has
    several replies."""

    exchange: Numbers  # Index in the exchanges
    servo: Numbers
    place: Numbers  # Place in the replies that the instruction requests; -1: not requested
    took_us: Numbers
    """From before the write() of the instruction to `last_ns`; 0 for a reply that does not answer."""
    own_ns: Numbers
    """From the end of the preceding status packet in the exchange (for the first, of the instruction) to
    `last_ns`, less the wire time of the status packet."""
    last_ns: Numbers  # After the read() of the status packet's last byte
    due_ns: Numbers
    """Planned time of the reply's last byte, from the end of the instruction, and wire time and return
    delay of this and the preceding replies."""
    kind: Numbers  # A `ReplyKind`
    answers: Flags  # True: requested, in time, and the first reply of the servo in the exchange
    strange: Flags  # True: a complete status packet of one servo that the exchange does not request


class DueReplies(NamedTuple):
    """Replies that instructions request, as columns of shape (due replies,); ordered by exchange, then by
    place in the chain."""

    exchange: Numbers  # Index in the exchanges
    servo: Numbers
    place: Numbers  # Place in the replies that the instruction requests
    reply: Numbers  # Index in the replies; -1: missing
    loss: Numbers  # A `Loss`
    broken: Flags
    """True if stray bytes came in place of the reply; always False if `loss` is not OWN."""
    missing: Numbers  # Rows without a reply, shape (missing replies,)


class TrafficCounts(NamedTuple):
    """Counters of the packets that were paired so far."""

    packets: Numbers  # Packets of each kind, shape (buses, kinds)
    bytes: Numbers  # Their bytes
    instructions: Numbers  # Instructions with each ID; this and the next arrays have shape (servos,)
    replies: Numbers
    protocol: Numbers  # 1 or 2, of the last reply; 0 without one
    longest_ns: Numbers  # Longest time from before the write() of an instruction to the requested reply
    errors: Numbers  # Replies with each error byte but 0, shape (servos, 256)

    @classmethod
    def for_buses(cls, buses: int) -> TrafficCounts:
        """Return counters of 0."""
        packets, size = np.zeros((2, buses, _KINDS), np.int64)
        instructions, replies, protocol, longest_ns = np.zeros((4, buses * IDS), np.int64)
        errors = np.zeros((buses * IDS, _BYTES), np.int64)
        return cls(packets, size, instructions, replies, protocol, longest_ns, errors)


class CompiledPairing:
    """Some packets with the buses on which they were sent, as structs of the compiled functions."""

    def __init__(
        self,
        packets: PacketColumns,
        rows: Numbers,
        buses: Sequence[LoggedBus],
        free_ns: Numbers,
        counts: TrafficCounts,
    ) -> None:
        """Prepare for the packets in `rows`, which are sorted by bus, then by time.

        Args:
            packets: The packets.
            rows: Their rows in the order in which they are to be paired.
            buses: Buses of the log.
            free_ns: Time at which the line of each bus has carried everything that was sent; it is updated.
            counts: Counters, which are increased.
        """
        self._count, self._instructions = len(rows), int((packets.kind[rows] == PacketKind.INSTRUCTION).sum())
        self._kept: list[object] = []  # Arrays of which the structs have the addresses
        names = ("cycle", "first_ns", "last_ns", "start", "length", "bus", "kind", "servo_id", "data")
        columns = {name: np.ascontiguousarray(getattr(packets, name)) for name in names}
        self._packets = self._structure(
            "Packets", {"rows": rows, **columns}, count=len(rows), bytes=len(packets.data)
        )
        settings = {
            "rates": np.array([bus.baud_rate for bus in buses], np.int64),
            "delays_ns": np.array([bus.return_delay_ns for bus in buses], np.int64),
        }
        self._buses = self._structure("Buses", {**settings, "free_ns": free_ns}, count=len(buses))
        self._size = self._instructions + len(buses)
        self._counts = self._structure("TrafficCounts", counts._asdict(), kinds=_KINDS)

    def _structure(self, name: str, columns: Mapping[str, NDArray[Any]], **numbers: int) -> ctypes.Structure:
        self._kept.append(columns)
        return _STRUCTS[name](**{key: one.ctypes.data for key, one in columns.items()}, **numbers)

    def split_packets(self) -> tuple[ExchangeColumns, Numbers]:
        """Return the exchanges, without what `pair_replies` sets, and the exchange of each packet.

        A request of several servos is -1 minus the index of an exchange with the same instruction.

        Raises:
            ValueError: A packet is on none of the buses, not inside the bytes of the packets, or of
                an unknown kind.
        """
        found = ExchangeColumns(*np.empty((len(ExchangeColumns._fields), self._size), np.int64))
        exchange = np.empty(self._count, np.int64)
        split = _library().pairing_split
        structure = self._structure("Exchanges", found._asdict(), count=self._size)
        structures = map(byref, (self._packets, self._buses, structure))
        if split(*structures, exchange.ctypes.data, byref(self._counts)):
            raise ValueError(
                "packets are not sorted by bus, end after their bytes, or are of an unknown kind"
            )
        return found, exchange

    def pair_replies(
        self, exchanges: ExchangeColumns, exchange: Numbers, requests: DistinctRequests
    ) -> tuple[Replies, DueReplies]:
        """Return the replies and the requested replies; set `last_ns`, `answer`, `kind` and `extra_ns`
        of the exchanges.

        Args:
            exchanges: The exchanges, with rows of `requests` as requests.
            exchange: Exchange of each packet.
            requests: The requests.
        """
        library, tables = _library(), requests._asdict()
        names = ("servos", "places", "ids", "begins", "blocks", "block_ends", "fast")
        table = self._structure(
            "Requests", {name: tables[name] for name in names}, widest=requests.blocks.shape[1]
        )
        packets, buses, kinds = byref(self._packets), byref(self._buses), byref(table)
        columns = byref(self._structure("Exchanges", exchanges._asdict(), count=self._size))
        count = library.pairing_count_replies(packets, kinds, columns, exchange.ctypes.data)
        replies = Replies(*np.empty((8, count), np.int64), *np.empty((2, count), np.bool_))
        count = int(requests.servos[exchanges.request].sum())
        of, servo, place, reply, loss, rows = np.empty((6, count), np.int64)
        due = DueReplies(of, servo, place, reply, loss, np.empty(count, np.bool_), rows)
        missing = library.pairing_pair_replies(
            *(packets, buses, kinds, columns, exchange.ctypes.data),
            byref(self._structure("Replies", replies._asdict())),
            byref(self._structure("DueReplies", due._asdict())),
            byref(self._counts),
        )
        return replies, due._replace(missing=due.missing[:missing].copy())


@cache
def _library() -> ctypes.CDLL:
    found = load_compiled(SOURCE, ctypes.CDLL)
    for name, count in _ARGUMENTS.items():
        function = getattr(found, f"pairing_{name}")
        function.argtypes, function.restype = (c_void_p,) * count, c_int64
    return found
