"""The mailbox: what a good, a greedy, a dying and a hostile writer can do to the loop, which is nothing."""

import os
import random
import struct

import pytest

from dxlrun.channels import mailbox, ring
from dxlrun.channels.answers import Acceptance, Code, Completion, Refusal
from dxlrun.channels.commands import LONGEST_COMMAND, MOST_PER_CYCLE, CommandMessage, encode_command
from dxlrun.channels.mailbox import LONGEST_SET_POINT, Answers, Mailbox, MailboxWriter
from dxlrun.channels.ring import record_size

PLACES = 3


class Both:
    """Both ends of one mailbox, and of its answers."""

    def __init__(self):
        self.descriptor = mailbox.create(PLACES)
        answers = ring.create("answers", mailbox.ANSWERS_CAPACITY, mailbox.LONGEST_ANSWER)
        self.writer = MailboxWriter(self.descriptor)
        self.reader = Mailbox(self.descriptor, ring.RingWriter(answers))
        self.answers = Answers(answers)

    def take_all(self):
        found = []
        while taken := self.reader.drain_commands():
            found += taken
        return found


@pytest.fixture
def both():
    return Both()


def command(number=1, data=b"", controller="head", lease_ns=0):
    return CommandMessage(number, controller, "position", data, "anna", lease_ns)


def test_operations_keep_their_order_and_a_cycle_takes_only_so_many(both):
    for number in range(20):
        both.writer.post_command(command(number))
    first = both.reader.drain_commands()
    assert [one.number for one in first] == list(range(MOST_PER_CYCLE))
    assert [one.number for one in both.take_all()] == list(range(MOST_PER_CYCLE, 20))


def test_of_a_stream_the_newest_set_point_wins(both):
    for number in range(50):
        both.writer.set_point(1, command(number, lease_ns=5))
    both.writer.set_point(2, command(99, controller="arm", lease_ns=5))
    assert [one.number for one in both.reader.drain_commands()] == [49, 99]
    assert both.reader.drain_commands() == ()


@pytest.mark.parametrize("beyond", [0, 1, record_size(0)])
def test_mailbox_can_be_filled_to_its_last_byte_and_no_further(both, beyond):
    def encoded_in(size, number):
        """Return a command that takes so many bytes, without the header of its record."""
        return command(number, bytes(2 * size - len(encode_command(command(number, bytes(size))))))

    sizes = [LONGEST_COMMAND] * 3
    room = mailbox.capacity(0) - sum(map(record_size, sizes))
    sizes.append(room - record_size(0) + beyond)
    posted = [both.writer.post_command(encoded_in(size, number)) for number, size in enumerate(sizes)]
    assert posted == [True, True, True, beyond == 0]
    assert [one.number for one in both.take_all()] == [0, 1, 2, 3][: sum(posted)]


def test_what_is_too_long_is_refused(both):
    for size in (LONGEST_COMMAND + 1, 10_000_000):
        assert not both.writer.post_command(command(1, bytes(size)))
    assert not both.writer.set_point(0, command(1, bytes(LONGEST_SET_POINT)))
    assert both.reader.drain_commands() == ()


OPERATIONS = 64
PLACE_0 = OPERATIONS + 64 + 4 * LONGEST_COMMAND + record_size(LONGEST_COMMAND)
HEAD = 24
INTENT = 32


def test_a_writer_that_died_in_a_set_point_is_not_waited_for(both):
    both.writer.set_point(0, command(1, lease_ns=5))
    both.reader.drain_commands()
    size = record_size(len(encode_command(command(2))))
    os.pwrite(both.descriptor, struct.pack("<Q", 2 * size), PLACE_0 + INTENT)  # begins the next, and dies
    os.pwrite(both.descriptor, b"half", PLACE_0 + 64 + size)
    both.writer.set_point(1, command(2, lease_ns=5))
    assert [one.number for one in both.reader.drain_commands()] == [2]
    assert list(both.reader.drain_commands()) == []


def test_what_is_damaged_is_dropped_and_the_next_one_taken(both):
    both.writer.set_point(0, command(1, lease_ns=5))
    for number in (2, 3):
        both.writer.post_command(command(number))
    os.pwrite(both.descriptor, b"damage", PLACE_0 + 64 + 30)
    os.pwrite(both.descriptor, b"damage", OPERATIONS + 64 + 30)
    assert [one.number for one in both.take_all()] == [3]
    for _ in range(3):
        assert list(both.reader.drain_commands()) == []
    both.writer.set_point(0, command(4, lease_ns=5))
    both.writer.post_command(command(5))
    assert [one.number for one in both.take_all()] == [5, 4]


def test_a_set_point_is_whole_before_it_is_shown(both, monkeypatch):
    seen = []

    def looked(words, index, value):
        seen.append((words[index], os.pread(both.descriptor, 8, PLACE_0 + HEAD)))
        words[index] = value

    monkeypatch.setattr(mailbox, "store", looked)
    both.writer.set_point(0, command(1, lease_ns=5))
    ((shown, head),) = seen
    assert (shown, head) == (0, os.pread(both.descriptor, 8, PLACE_0 + HEAD))
    assert head != bytes(8)
    os.pwrite(both.descriptor, bytes(8), PLACE_0 + HEAD)

    def loaded(words, index):  # the place comes to be seen with the count
        os.pwrite(both.descriptor, head, PLACE_0 + HEAD)
        return words[index]

    monkeypatch.setattr(mailbox, "load", loaded)
    assert [one.number for one in both.reader.drain_commands()] == [1]


def test_a_writer_that_fills_it_with_rubbish_gets_no_exception_out_of_the_loop():
    """Any bytes in any place: no exception, a bounded number of commands, no endless loop."""
    chance, taken = random.Random(3), 0
    for number in range(300):
        if number % 10 == 0:
            both = Both()
        both.writer.post_command(command(1, bytes(100)))
        at = OPERATIONS + 64 + both.reader._operations.position % (4 * LONGEST_COMMAND)
        os.pwrite(both.descriptor, chance.randbytes(chance.randrange(1, 40)), at + chance.randrange(160))
        if chance.random() < 0.3:
            value = struct.pack("<Q", chance.getrandbits(chance.choice((8, 20, 62))))
            os.pwrite(both.descriptor, value, OPERATIONS + chance.choice((HEAD, INTENT, INTENT + 8)))
        both.writer.set_point(0, command(1, bytes(100), lease_ns=1))
        os.pwrite(both.descriptor, chance.randbytes(8), PLACE_0 + HEAD + chance.randrange(300))
        for _ in range(3):
            commands = both.reader.drain_commands()
            assert len(commands) <= MOST_PER_CYCLE + PLACES
            taken += len(commands)
    assert 0 < taken < 2 * 300 - 100, "more than 100 were damaged"


@pytest.mark.parametrize("last", [2**64 - 8, 2**64 - 1])
def test_counts_at_the_end_of_their_words_get_no_exception_out_of_the_loop(both, last):
    os.pwrite(both.descriptor, struct.pack("<Q", last), OPERATIONS + HEAD)
    for _ in range(3):
        assert list(both.reader.drain_commands()) == []


def test_answers_come_back_by_their_numbers_and_long_ones_are_cut(both):
    given = [
        Completion(7),
        Completion(7, 3),
        Acceptance(("arm",)),
        Refusal(Code.PAUSED_ALREADY),
        Refusal(Code.INVALID, {"controller": ("arm", "head"), "rate": 0.5}),
    ]
    long = Refusal(
        Code.CONTROLLER_FAULT, {"controller": "arm", "problem": '"ä\n' * 10_000, "seen": ("a",) * 999}
    )
    many = Acceptance(tuple(f"controller_{index:060}" for index in range(63)))
    no_utf_8 = Refusal(Code.CONTROLLER_FAULT, {"problem": "no file a\udcff"})
    large = Refusal(Code.UNKNOWN_GOAL, {"goal": -(10**30), "last": 2**63 - 1})
    for number, answer in enumerate([*given, long, many, no_utf_8, large]):
        both.reader.answer_command(number, answer)
    found = both.answers.new()
    assert [one.number for one in found] == [*range(9)]
    *whole, cut, few, escaped, written = (one.answer for one in found)
    assert whole == given
    assert (cut.code, cut.fields["controller"]) == (Code.CONTROLLER_FAULT, "arm")
    assert long.fields["problem"].startswith(cut.fields["problem"])
    assert len(cut.fields["problem"]) > 20
    assert isinstance(few, Acceptance)
    assert escaped.text == "no file a\\udcff"
    assert written.fields == {"goal": f"-1{'0' * 30}", "last": 2**63 - 1}
    assert both.answers.new() == []


def test_a_descriptor_of_something_else_is_refused():
    descriptor = os.memfd_create("other")
    os.ftruncate(descriptor, 4096)
    with pytest.raises(ValueError, match="not a mailbox"):
        MailboxWriter(descriptor)
