"""Commands, events and messages through a ring: whatever was taken comes out whole, or is counted as lost."""

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dxlrun.channels import mailbox, ring
from dxlrun.channels.commands import (
    LONGEST_COMMAND,
    CommandMessage,
    CommandRing,
    TakenCommand,
    command_capacity,
    encode_command,
)
from dxlrun.channels.cycle import MOST_CONTROLLERS
from dxlrun.channels.event_records import (
    LONGEST_EVENT,
    LONGEST_TEXT,
    Event,
    EventBody,
    EventCode,
    EventRing,
    Severity,
    event_capacity,
)
from dxlrun.channels.ring import Gap, Handover, Record, RecordKind, RingReader, RingWriter, record_size
from dxlrun.channels.tagged import decode
from dxlrun.channels.topic_messages import (
    LEAST_CAPACITY,
    LONGEST_MESSAGE,
    LONGEST_RECORD,
    MOST_CAPACITY,
    MessageRing,
    OpenedTopic,
    PublishedTopic,
    TopicRecord,
    message_capacity,
    usual_message,
)
from dxlrun.messages.definition import MessageType
from dxlwire.clock import VirtualClock


class Kept(Handover):
    """Keeps the payloads of records."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []
        super().__init__(lambda _, payload: self.payloads.append(bytes(payload)))


def payloads_of(reader: RingReader) -> list[object]:
    """Return what the records of a ring have; a gap stays one."""
    found = [*iter(reader.read_record, None)]
    assert all(one.kind == RecordKind.TAGGED for one in found if isinstance(one, Record))
    return [decode(one.payload) if isinstance(one, Record) else one for one in found]


# Commands


def record_of(command: TakenCommand) -> bytes:
    kept = Kept()
    CommandRing(kept).record_command(command)
    (record,) = kept.payloads
    return record


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
@given(COMMANDS, st.integers(0, 2**62))
def test_a_command_comes_out_as_it_went_in(taken, lease_ns):
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
    with pytest.raises(ValueError, match=">= 0"):  # the lease
        decode(encode_command(CommandMessage(1, "arm", "position", b"", "process 12", -1)))


def test_what_a_full_mailbox_holds_comes_whole_into_the_log_though_no_reader_looks_meanwhile():
    full = mailbox.capacity(MOST_CONTROLLERS)
    descriptor = ring.create("commands", command_capacity(20_000_000, 1, full), LONGEST_COMMAND + 64)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    box = mailbox.create(MOST_CONTROLLERS)
    client = mailbox.MailboxWriter(box)
    names = "c" * 64, "k" * 64
    number = 0
    while client.post_command(CommandMessage(number, *names, bytes(LONGEST_COMMAND // 2), "o" * 64)):
        number += 1
    for place in range(MOST_CONTROLLERS):
        assert client.set_point(place, CommandMessage(place, *names, bytes(1600), "o" * 64, 1))
    commands = CommandRing(writer)
    loop, taken = mailbox.Mailbox(box, Kept()), list[CommandMessage]()
    while part := loop.drain_commands():  # a cycle takes one of the long ones, and all set-points
        taken += part
    assert len(taken) == number + MOST_CONTROLLERS
    for one in taken:
        commands.record_command(
            TakenCommand(0, 0, -1, one.controller, one.kind, one.origin, one.data, one.lease_ns)
        )
    records = payloads_of(reader)
    assert [one.data for one in records if isinstance(one, TakenCommand)] == [one.data for one in taken]
    assert len(records) == len(taken)


# Events


def emitted(code: EventCode, severity: Severity, source: str, text: str) -> bytes:
    kept = Kept()
    EventRing(kept, VirtualClock(5)).emit_event(source, EventBody(code, severity, text))
    (record,) = kept.payloads
    assert len(record) <= LONGEST_EVENT
    return record


@settings(max_examples=100, deadline=None)
@example(EventCode.GATE, Severity.INFO, "ä" * 600)
@example(EventCode.GATE, Severity.INFO, "x" + "€" * 600)
@given(
    st.sampled_from(EventCode),
    st.sampled_from(Severity),
    st.text(st.characters(exclude_categories=["Cs"]), max_size=600),
)
def test_an_event_comes_out_as_it_went_in(code, severity, text):
    event = decode(emitted(code, severity, "head_yaw_joint", text))
    assert event == Event(5, code, severity, "head_yaw_joint", text)


def test_what_cannot_be_encoded_or_is_endless_is_still_recorded():
    text = "\udcff" + "€" * 100_000
    event = decode(emitted(EventCode.CONTROLLER_FAULT, Severity.ERROR, "\N{ROBOT FACE}" * 500, text))
    assert isinstance(event, Event)
    assert (event.source, event.text) == ("\N{ROBOT FACE}" * 64, "?" + "€" * (LONGEST_TEXT - 1))


def test_a_code_of_a_newer_version_stays_a_number():
    newer = decode(msgspec.msgpack.encode(Event(5, 999, 30, "a", "b")))
    assert (newer, newer.name) == (Event(5, 999, 30, "a", "b"), "code_999")
    assert Event(5, 40, 30, "a", "b").name == "gate"


@pytest.mark.parametrize("cut", [0, 3, 8])
def test_a_cut_event_is_refused(cut):
    with pytest.raises(ValueError, match="truncated"):
        decode(emitted(EventCode.GATE, Severity.WARNING, "a", "b")[:cut])


def test_the_ring_holds_ten_seconds_of_the_worst_storm_of_events():
    text = "the reply of servo 17 on bus legs was missed for the 3rd time, and is missed on"
    record = emitted(EventCode.READ_LOST, Severity.WARNING, "right_shoulder_swing_joint", text)
    assert event_capacity(1_000_000, 18) >= 10 * 1000 * 22 * record_size(len(record))


# Messages


TOPIC = PublishedTopic("/wave/state", MessageType("mine/msg/State", "float64 amount\n"), ("pan", "tilt"))


def opened() -> tuple[MessageRing, RingReader]:
    memory = ring.create("messages", LEAST_CAPACITY, LONGEST_RECORD)
    return MessageRing(RingWriter(memory)), RingReader(memory)


@settings(max_examples=50, deadline=None)
@given(st.integers(-(2**63), 2**63 - 1), st.binary(max_size=2000))
def test_a_message_comes_out_as_it_went_in_and_each_topic_has_a_number(t_ns, data):
    messages, reader = opened()
    assert [messages.announce(TOPIC) for _ in range(3)] == [0, 1, 2]
    messages.message(2, t_ns, data)
    announced = [OpenedTopic(number, 0, TOPIC) for number in range(3)]
    assert payloads_of(reader) == [*announced, TopicRecord(t_ns, 2, 1, data)]


def test_the_longest_message_fits_and_a_slow_reader_knows_what_it_missed():
    messages, reader = opened()
    messages.announce(TOPIC)
    sent = 3 * LEAST_CAPACITY // LONGEST_MESSAGE
    for index in range(sent):
        messages.message(0, index, bytes(LONGEST_MESSAGE))
    found = payloads_of(reader)
    lost = sum(one.lost for one in found if isinstance(one, Gap))
    times = [one.t_ns for one in found if isinstance(one, TopicRecord)]
    assert lost + len(times) == sent + 1
    assert times == list(range(sent - len(times), sent))
    assert len(times) >= LEAST_CAPACITY // LONGEST_MESSAGE - 2


def test_the_ring_of_messages_holds_ten_seconds_and_is_bounded():
    second = 1000 * record_size(usual_message(20))  # two rows of 20 joints at 1 kHz
    assert message_capacity(second) >= 10 * second
    assert message_capacity(0) == LEAST_CAPACITY
    assert message_capacity(1e12) == MOST_CAPACITY
    assert message_capacity(123_457) % 8 == 0
