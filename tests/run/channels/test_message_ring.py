"""Messages through a ring: as they went in, and counted where a reader was too slow."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.channels import ring
from dxlrun.channels.ring import Gap, Record, RecordKind, RingReader, RingWriter
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

TOPIC = PublishedTopic("/wave/state", MessageType("mine/msg/State", "float64 amount\n"), ("pan", "tilt"))


def made(capacity: int = LEAST_CAPACITY) -> tuple[MessageRing, RingReader]:
    memory = ring.create("messages", capacity, LONGEST_RECORD)
    return MessageRing(RingWriter(memory)), RingReader(memory)


@settings(max_examples=50, deadline=None)
@given(st.integers(-(2**63), 2**63 - 1), st.binary(max_size=2000))
def test_a_message_comes_out_as_it_went_in(t_ns, data):
    messages, reader = made()
    number = messages.announce(TOPIC)
    messages.message(number, t_ns, data)
    announced, message = reader.read_record(), reader.read_record()
    assert isinstance(announced, Record)
    assert isinstance(message, Record)
    assert announced.kind == message.kind == RecordKind.TAGGED
    assert decode(announced.payload) == OpenedTopic(number, 0, TOPIC)
    assert decode(message.payload) == TopicRecord(t_ns, number, 1, data)


def test_each_topic_gets_a_number_of_its_own():
    messages, _ = made()
    assert [messages.announce(TOPIC) for _ in range(3)] == [0, 1, 2]


def test_the_longest_message_fits_and_a_slow_reader_knows_what_it_missed():
    messages, reader = made()
    messages.announce(TOPIC)
    sent = 3 * LEAST_CAPACITY // LONGEST_MESSAGE
    for index in range(sent):
        messages.message(0, index, bytes(LONGEST_MESSAGE))
    lost, found = 0, []
    while (record := reader.read_record()) is not None:
        if isinstance(record, Gap):
            lost += record.lost
        else:
            message = decode(record.payload)
            assert isinstance(message, TopicRecord | OpenedTopic)
            found += [message.t_ns] if isinstance(message, TopicRecord) else []
    assert lost + len(found) == sent + 1
    assert found == list(range(sent - len(found), sent))
    assert len(found) >= LEAST_CAPACITY // LONGEST_MESSAGE - 2


def test_the_ring_holds_ten_seconds_and_is_bounded():
    second = 1000 * ring.record_size(usual_message(20))  # two rows of 20 joints at 1 kHz
    assert message_capacity(second) >= 10 * second
    assert message_capacity(0) == LEAST_CAPACITY
    assert message_capacity(1e12) == MOST_CAPACITY
    assert message_capacity(123_457) % 8 == 0
