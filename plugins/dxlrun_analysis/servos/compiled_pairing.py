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
from dxlrun_analysis.servos.logged_requests import DistinctRequests, Flags, Numbers
from dxlwire import PacketKind

SOURCE = Path(__file__).with_name("pairing.c")
_STRUCTS = parse_structs(SOURCE.read_text())
_ARGUMENTS = {"split": 4, "count_replies": 4, "pair_replies": 7}  # Number of arguments of each function


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
    row: Numbers  # Row of the instruction in the packets; -1 without one
    asked_id: Numbers  # ID in the instruction; -1: any servo may answer, or no instruction


class Replies(NamedTuple):
    """Replies of single servos as columns, shape (replies,), in order of time. A fast status packet has
    several replies."""

    exchange: Numbers  # Index in the exchanges
    servo: Numbers
    place: Numbers  # Place in the replies that the instruction requests; -1: not requested
    error: Numbers  # The error byte
    protocol: Numbers
    wire_ns: Numbers  # Wire time of the status packet
    last_ns: Numbers  # After the read() of the status packet's last byte
    before_ns: Numbers
    """`last_ns` of the preceding status packet in the exchange; for the first, end of the instruction."""
    due_ns: Numbers
    """Planned time of the reply's last byte, from the end of the instruction, and wire time and return
    delay of this and the preceding replies."""
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


class CompiledPairing:
    """Some packets with the buses on which they were sent, as structs of the compiled functions."""

    def __init__(
        self, packets: PacketColumns, rows: Numbers, buses: Sequence[LoggedBus], free_ns: Numbers
    ) -> None:
        """Prepare for the packets in `rows`, which are sorted by bus, then by time.

        Args:
            packets: The packets.
            rows: Their rows in the order in which they are to be paired.
            buses: Buses of the log.
            free_ns: Time at which the line of each bus has carried everything that was sent; it is updated.
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

    def _structure(self, name: str, columns: Mapping[str, NDArray[Any]], **numbers: int) -> ctypes.Structure:
        self._kept.append(columns)
        return _STRUCTS[name](**{key: one.ctypes.data for key, one in columns.items()}, **numbers)

    def split_packets(self) -> tuple[ExchangeColumns, Numbers]:
        """Return the exchanges, without `last_ns` and `answer`, and the exchange of each packet.

        A request of several servos is -1 minus the index of an exchange with the same instruction.

        Raises:
            ValueError: A packet is on none of the buses, or not inside the bytes of the packets.
        """
        found = ExchangeColumns(*np.empty((len(ExchangeColumns._fields), self._size), np.int64))
        exchange = np.empty(self._count, np.int64)
        split = _library().pairing_split
        structure = self._structure("Exchanges", found._asdict(), count=self._size)
        if split(byref(self._packets), byref(self._buses), byref(structure), exchange.ctypes.data):
            raise ValueError("packets are not sorted by bus, or end after their bytes")
        return found, exchange

    def pair_replies(
        self, exchanges: ExchangeColumns, exchange: Numbers, requests: DistinctRequests
    ) -> tuple[Replies, DueReplies]:
        """Return the replies and the requested replies; set `last_ns` and `answer` of the exchanges.

        Args:
            exchanges: The exchanges, with rows of `requests` as requests.
            exchange: Exchange of each packet.
            requests: The requests.
        """
        library, tables = _library(), requests._asdict()
        names = ("servos", "places", "ids", "begins", "blocks", "block_ends")
        table = self._structure(
            "Requests", {name: tables[name] for name in names}, widest=requests.blocks.shape[1]
        )
        packets, buses, kinds = byref(self._packets), byref(self._buses), byref(table)
        columns = byref(self._structure("Exchanges", exchanges._asdict(), count=self._size))
        count = library.pairing_count_replies(packets, kinds, columns, exchange.ctypes.data)
        replies = Replies(*np.empty((9, count), np.int64), *np.empty((2, count), np.bool_))
        count = int(requests.servos[exchanges.request].sum())
        of, servo, place, reply, loss, rows = np.empty((6, count), np.int64)
        due = DueReplies(of, servo, place, reply, loss, np.empty(count, np.bool_), rows)
        missing = library.pairing_pair_replies(
            *(packets, buses, kinds, columns, exchange.ctypes.data),
            byref(self._structure("Replies", replies._asdict())),
            byref(self._structure("DueReplies", due._asdict())),
        )
        return replies, due._replace(missing=due.missing[:missing].copy())


@cache
def _library() -> ctypes.CDLL:
    found = load_compiled(SOURCE, ctypes.CDLL)
    for name, count in _ARGUMENTS.items():
        function = getattr(found, f"pairing_{name}")
        function.argtypes, function.restype = (c_void_p,) * count, c_int64
    return found
