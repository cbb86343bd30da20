"""Commands through a ring: whatever was taken comes out whole, or not at all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.channels import mailbox
from dxlrun.channels.commands import (
    LONGEST_COMMAND,
    CommandMessage,
    CommandRing,
    TakenCommand,
    command_capacity,
    encode_command,
)
from dxlrun.channels.cycle import MOST_CONTROLLERS
from dxlrun.channels.ring import Handover, Record, RecordKind, RingReader, RingWriter, create
from dxlrun.channels.tagged import decode

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


def record_of(command: TakenCommand) -> bytes:
    records: list[bytes] = []
    CommandRing(Handover(lambda _, payload: records.append(bytes(payload)))).record_command(command)
    (record,) = records
    return record


@settings(max_examples=80, deadline=None)
@given(COMMANDS, st.integers(0, 2**62))
def test_what_goes_in_comes_out(taken, lease_ns):
    assert decode(record_of(taken)) == taken
    command = CommandMessage(taken.planned, taken.controller, taken.kind, taken.data, taken.origin, lease_ns)
    assert decode(encode_command(command)) == command


COMMAND = TakenCommand(5, 1, -1, "left_arm", "trajectory", "process 12", np.arange(5.0).tobytes())


@pytest.mark.parametrize("length", [0, 10, 39, 60])
def test_bytes_that_are_no_command_are_refused(length):
    record = encode_command(CommandMessage(1, "left_arm", "trajectory", b"", "process 12"))
    for data in (record_of(COMMAND), record):
        for cut in (data[:length][: len(data) - 1], data + b"\0", data[:5] + b"\xff" + data[6:]):
            with pytest.raises(ValueError, match=r"."):
                decode(cut)


def test_a_lease_below_zero_is_refused():
    with pytest.raises(ValueError, match=">= 0"):
        decode(encode_command(CommandMessage(1, "arm", "position", b"", "process 12", -1)))


def test_what_a_full_mailbox_holds_comes_whole_into_the_log_though_no_reader_looks_meanwhile():
    full = mailbox.capacity(MOST_CONTROLLERS)
    descriptor = create("commands", command_capacity(20_000_000, 1, full), LONGEST_COMMAND + 64)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    box = mailbox.create(MOST_CONTROLLERS)
    client = mailbox.MailboxWriter(box)
    origin = "o" * 64
    number = 0
    while client.post_command(
        CommandMessage(number, "c" * 64, "k" * 64, bytes(LONGEST_COMMAND // 2), origin)
    ):
        number += 1
    for place in range(MOST_CONTROLLERS):
        assert client.set_point(place, CommandMessage(place, "c" * 64, "k" * 64, bytes(1600), origin, 1))
    ring = CommandRing(writer)
    loop, taken = mailbox.Mailbox(box, Handover(lambda kind, payload: None)), list[CommandMessage]()
    while part := loop.drain_commands():  # a cycle takes one of the long ones, and all set-points
        taken += part
    assert len(taken) == number + MOST_CONTROLLERS
    for one in taken:
        ring.record_command(
            TakenCommand(0, 0, -1, one.controller, one.kind, one.origin, one.data, one.lease_ns)
        )
    found = list(iter(reader.read_record, None))
    assert all(isinstance(one, Record) and one.kind == RecordKind.TAGGED for one in found)
    records = [decode(one.payload) for one in found if isinstance(one, Record)]
    assert [one.data for one in records if isinstance(one, TakenCommand)] == [one.data for one in taken]
