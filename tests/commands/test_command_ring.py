"""Commands through a ring: whatever was taken comes out whole, or not at all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.run.channels import mailbox
from dxlrun.run.channels.commands import COMMAND_SLOT, CommandPieces, CommandRing, TakenCommand, command_slots
from dxlrun.run.channels.cycle import MOST_CONTROLLERS
from dxlrun.run.channels.inbox import Command
from dxlrun.run.channels.ring import Handover, Payload, RingReader, RingWriter, create

NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
COMMANDS = st.builds(
    TakenCommand,
    t_ns=st.integers(-(2**63), 2**63 - 1),
    cycle=st.integers(0, 2**62),
    planned=st.integers(-1, 2**40),
    controller=NAMES,
    kind=NAMES,
    origin=NAMES,
    data=st.lists(st.floats(width=64), max_size=300).map(lambda values: np.array(values, "<f8").tobytes()),
)


@settings(max_examples=80, deadline=None)
@given(st.lists(COMMANDS, max_size=5))
def test_what_goes_in_comes_out(commands: list[TakenCommand]) -> None:
    pieces = CommandPieces()
    out: list[TakenCommand | None] = []
    ring = CommandRing(Handover(lambda payload: out.append(pieces.add(payload))))
    for command in commands:
        ring.take(command)
    assert [command for command in out if command is not None] == commands


class Slots:
    """An Appender with the slots of the real ring."""

    slot_size = COMMAND_SLOT

    def __init__(self) -> None:
        self.records: list[bytes] = []

    @property
    def head(self) -> int:
        return len(self.records)

    def append(self, payload: Payload) -> int:
        assert len(payload) <= COMMAND_SLOT
        self.records.append(bytes(payload))
        return self.head - 1


def long_command(number: int) -> TakenCommand:
    return TakenCommand(5, number, -1, "left_arm", "trajectory", "somebody", np.arange(500.0).tobytes())


def test_a_command_with_a_lost_piece_is_refused_and_the_next_one_is_whole() -> None:
    slots = Slots()
    ring, records = CommandRing(slots), slots.records
    ring.take(long_command(1))
    first = len(records)
    ring.take(long_command(2))
    assert first > 2
    for lost in range(first):
        pieces = CommandPieces()
        whole: list[TakenCommand] = []
        refused = 0
        for record in records[:lost] + records[lost + 1 :]:
            try:
                command = pieces.add(record)
            except ValueError:
                refused += 1
            else:
                whole += [command] if command else []
        assert whole == [long_command(2)]
        # without its end, a command is replaced by the next one: nothing says so but the count of its cycle
        assert refused == first - 1 - lost


@pytest.mark.parametrize("length", [0, 10, 47])
def test_bytes_that_are_no_command_are_refused(length: int) -> None:
    slots = Slots()
    CommandRing(slots).take(long_command(1))
    with pytest.raises(ValueError, match="a command"):
        CommandPieces().add(slots.records[0][:length])


def test_long_names_are_cut_and_the_origin_keeps_its_line() -> None:
    out: list[TakenCommand | None] = []
    pieces = CommandPieces()
    ring = CommandRing(Handover(lambda payload: out.append(pieces.add(payload))))
    ring.take(TakenCommand(0, 0, 3, "c" * 100, "k" * 100, "o" * 100 + "motion.yaml:7:5", b""))
    (command,) = out
    assert command is not None
    assert command.origin.endswith("motion.yaml:7:5")
    assert (len(command.controller), len(command.kind), len(command.origin)) == (64, 64, 64)


def test_it_fits_a_ring_of_its_size() -> None:
    descriptor = create("commands", COMMAND_SLOT, command_slots(20_000_000, 3))
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    CommandRing(writer).take(long_command(9))
    pieces = CommandPieces()
    found = None
    while (record := reader.read()) is not None:
        assert isinstance(record, bytes)
        found = pieces.add(record)
    assert found == long_command(9)


def test_what_a_full_mailbox_holds_comes_whole_into_the_log_though_nobody_reads_meanwhile() -> None:
    descriptor = create("commands", COMMAND_SLOT, command_slots(20_000_000, 1))
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    box = mailbox.create(MOST_CONTROLLERS)
    client = mailbox.MailboxWriter(box)
    origin = "o" * 64
    number = 0
    while client.post(Command(number, "c" * 64, "k" * 64, bytes(mailbox.LARGEST // 2), origin)):
        number += 1
    for place in range(MOST_CONTROLLERS):
        assert client.set_point(place, Command(place, "c" * 64, "k" * 64, bytes(1600), origin, 1))
    ring = CommandRing(writer)
    loop, taken = mailbox.Mailbox(box, Slots()), list[Command]()
    while part := loop.take():  # a cycle takes one of the long ones, and all set-points
        taken += part
    assert len(taken) == number + MOST_CONTROLLERS
    for one in taken:
        ring.take(TakenCommand(0, 0, -1, one.controller, one.kind, one.origin, one.data, one.lease_ns))
    pieces, found = CommandPieces(), 0
    while (record := reader.read()) is not None:
        assert isinstance(record, bytes)
        found += pieces.add(record) is not None
    assert found == len(taken)
