"""The mailbox: what a good, a greedy, a dying and a hostile writer can do to the loop, which is nothing."""

import os
import random
import struct

import pytest

from dxlrun.run.channels import mailbox, ring
from dxlrun.run.channels.inbox import MOST_PER_CYCLE, Command
from dxlrun.run.channels.mailbox import LARGEST, PLACE, Answers, Mailbox, MailboxWriter, decode, encode

PLACES = 3


class Both:
    """Both ends of one mailbox, and of its answers."""

    def __init__(self):
        self.descriptor = mailbox.create(PLACES)
        answers = ring.create("answers", mailbox.ANSWER_SLOT, mailbox.ANSWER_SLOTS)
        self.writer = MailboxWriter(self.descriptor)
        self.reader = Mailbox(self.descriptor, ring.RingWriter(answers))
        self.answers = Answers(answers)

    def take_all(self):
        found = []
        while taken := self.reader.take():
            found += taken
        return found


@pytest.fixture
def both():
    return Both()


def command(number=1, data=b"", controller="head", lease_ns=0):
    return Command(number, controller, "position", data, "anna", lease_ns)


def test_a_command_arrives_as_it_was_sent(both):
    sent = Command(7, "linker_arm", "trajectory", bytes(range(200)), "änna", 200_000_000)
    assert both.writer.post(sent)
    assert both.reader.take() == [sent]
    assert both.reader.take() == ()


def test_operations_keep_their_order_and_a_cycle_takes_only_so_many(both):
    for number in range(20):
        both.writer.post(command(number))
    first = both.reader.take()
    assert [one.number for one in first] == list(range(MOST_PER_CYCLE))
    assert [one.number for one in both.take_all()] == list(range(MOST_PER_CYCLE, 20))


def test_of_long_operations_a_cycle_takes_one(both):
    for number in range(3):
        assert both.writer.post(command(number, bytes(LARGEST - 100)))
    both.writer.post(command(3))
    assert [[one.number for one in both.reader.take()] for _ in range(4)] == [[0], [1], [2], [3]]


def test_of_a_stream_the_newest_set_point_wins(both):
    for number in range(50):
        both.writer.set_point(1, command(number, lease_ns=5))
    both.writer.set_point(2, command(99, controller="arm", lease_ns=5))
    assert [one.number for one in both.reader.take()] == [49, 99]
    assert both.reader.take() == ()


def test_a_full_mailbox_refuses_and_loses_nothing(both):
    data = bytes(LARGEST // 2)
    sent = 0
    while both.writer.post(command(sent, data)):
        sent += 1
    assert sent >= 4
    assert [one.number for one in both.take_all()] == list(range(sent))
    assert both.writer.post(command(sent, data))


@pytest.mark.parametrize("size", [LARGEST + 1, 10_000_000])
def test_what_is_too_long_is_refused(both, size):
    assert not both.writer.post(command(1, bytes(size)))
    assert both.reader.take() == ()


def test_a_set_point_that_is_too_long_is_refused(both):
    assert not both.writer.set_point(0, command(1, bytes(PLACE)))
    assert both.reader.take() == ()


def test_records_of_all_lengths_go_round_the_ring_many_times(both):
    chance = random.Random(5)
    waiting, number, bytes_put = [], 0, 0
    while bytes_put < 8 * LARGEST:
        one = command(number, bytes(chance.choice((0, 1, 7, 8, 9, 1000, 60_000))))
        if both.writer.post(one):
            waiting.append(one)
            number, bytes_put = number + 1, bytes_put + len(one.data)
        if chance.random() < 0.4:
            taken = list(both.reader.take())
            assert taken == waiting[: len(taken)]
            del waiting[: len(taken)]
    assert both.take_all() == waiting
    assert both.reader.dropped == 0


def test_a_writer_that_died_in_a_set_point_is_not_waited_for(both):
    both.writer.set_point(0, command(1, lease_ns=5))
    both.reader.take()
    word = (64 + 4 * LARGEST) // 8
    memory = both.writer._memory.words
    memory[word] += 1  # begins, and dies
    both.writer.set_point(1, command(2, lease_ns=5))
    assert [one.number for one in both.reader.take()] == [2]
    assert list(both.reader.take()) == []


def test_a_writer_that_fills_it_with_rubbish_gets_no_exception_out_of_the_loop(both):
    """Any bytes in any place: no exception, a bounded number of commands, no endless loop."""
    chance = random.Random(3)
    for _ in range(300):
        both.writer.post(command(1, bytes(100)))
        tail = both.reader._memory.words[4] % (4 * LARGEST)
        os.pwrite(
            both.descriptor, chance.randbytes(chance.randrange(1, 40)), 64 + tail + chance.randrange(160)
        )
        if chance.random() < 0.3:
            os.pwrite(both.descriptor, struct.pack("<Q", chance.getrandbits(chance.choice((8, 20, 62)))), 24)
        for _ in range(3):
            assert len(both.reader.take()) <= MOST_PER_CYCLE + PLACES
    assert both.reader.dropped > 100


def test_counts_at_the_end_of_their_words_get_no_exception_out_of_the_loop(both):
    last = 2**64 - 8
    os.pwrite(both.descriptor, struct.pack("<QQ", last + 7, last), 24)
    os.pwrite(both.descriptor, struct.pack("<I", 0xFFFFFFFF), 64 + last % (4 * LARGEST))
    assert list(both.reader.take()) == []
    assert both.reader.dropped == 1


def test_answers_come_back_by_their_numbers_and_long_ones_are_cut(both):
    both.reader.answer(3, "")
    both.reader.answer(4, "the loop is paused already")
    both.reader.answer(5, "x" * 10_000)
    done, refused, cut = both.answers.new()
    assert (done, refused) == ((3, ""), (4, "the loop is paused already"))
    assert cut[0] == 5
    assert len(cut[1]) < mailbox.ANSWER_SLOT
    assert both.answers.new() == []


@pytest.mark.parametrize("payload", [b"", b"\x00" * 10, encode(command(1))[:-3]])
def test_what_is_no_command_is_told_from_one(payload):
    with pytest.raises(ValueError, match="command"):
        decode(payload)


def test_a_descriptor_of_something_else_is_refused():
    descriptor = os.memfd_create("other")
    os.ftruncate(descriptor, 4096)
    with pytest.raises(ValueError, match="not a mailbox"):
        MailboxWriter(descriptor)
