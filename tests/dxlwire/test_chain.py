"""Several statuses after one instruction: each counts by ID and length, whatever became of the others."""

import pytest
from tests.kit.plans import ScriptedLine, make_plan

from dxlwire.exchange.bus_engine import Lines
from dxlwire.packets import PacketLog
from dxlwire.plan.line import Line
from dxlwire.transaction import TransactionOutcome
from dxlwire.wire import protocol2

LINE = Line(1_000_000, 0, 0, protocol2)
SYNC_READ = LINE.read_many([(1, 126, 4), (2, 126, 4), (3, 126, 4)])
GOOD = {n: protocol2.status_packet(n, 0, bytes((n, n, n, n))) for n in (1, 2, 3)}


class Job:
    """Sends the sync read, keeps every status and how it ended."""

    def __init__(self):
        self.statuses, self.outcome, self.strays = {}, None, 0

    def next_transaction(self, reply):
        if reply is None:
            return SYNC_READ
        self.outcome, self.strays = reply.outcome, reply.strays
        return None

    def status(self, index, reply):
        self.statuses[index] = (reply.error, bytes(reply.parameters), reply.last_ns)


def ask(*said):
    line, job = ScriptedLine(said), Job()
    plan = make_plan((1, 2, 3), protocol=2.0, model="XM430-W350")
    lines = Lines([plan], line, line.clock, PacketLog())
    (bus,) = lines.buses
    bus.load_job(job)
    lines.pump()
    assert line.written == [SYNC_READ.packet]
    return job, line.clock.now_ns() - 1_000


def values(job):
    return {index: data for index, (_, data, _) in job.statuses.items()}


ALL = {0: b"\1\1\1\1", 1: b"\2\2\2\2", 2: b"\3\3\3\3"}


def test_all_in_turn():
    job, elapsed = ask((400_000, GOOD[1]), (550_000, GOOD[2]), (700_000, GOOD[3]))
    assert (job.outcome, values(job)) == (TransactionOutcome.OK, ALL)
    assert elapsed == 700_000
    assert [last for _, _, last in job.statuses.values()] == [401_000, 551_000, 701_000]


def test_all_at_once_and_in_pieces():
    stream = GOOD[1] + GOOD[2] + GOOD[3]
    assert values(ask((800_000, stream))[0]) == ALL
    assert values(ask((400_000, stream[:20]), (600_000, stream[20:31]), (800_000, stream[31:]))[0]) == ALL


def test_another_order_is_taken_by_id():
    assert values(ask((500_000, GOOD[3]), (600_000, GOOD[1]), (700_000, GOOD[2]))[0]) == ALL


@pytest.mark.parametrize("absent", [1, 2, 3])
def test_an_absent_servo_is_silence_not_garbage(absent):
    job, elapsed = ask(*((300_000 + n * 150_000, GOOD[n]) for n in (1, 2, 3) if n != absent))
    assert job.outcome is TransactionOutcome.TIMEOUT
    assert values(job) == {index: data for index, data in ALL.items() if index != absent - 1}
    assert elapsed == SYNC_READ.timeout_ns


def test_nobody_answers_twice():
    job, _ = ask((400_000, GOOD[1]), (550_000, GOOD[1]), (700_000, GOOD[2]), (850_000, GOOD[3]))
    assert (job.outcome, values(job), job.strays) == (TransactionOutcome.OK, ALL, 1)


@pytest.mark.parametrize(
    "wrong",
    [
        protocol2.status_packet(2, 0, b"\2\2\2"),
        protocol2.status_packet(2, 0, b"\2\2\2\2\2"),
        protocol2.status_packet(9, 0, b"\2\2\2\2"),
        GOOD[2][:-1] + b"\0",
        GOOD[2][:9],
        protocol2.read_range(2, 126, 4),  # of another host: the servo did not garble it
    ],
)
def test_only_the_right_id_length_and_crc_count(wrong):
    job, _ = ask((400_000, GOOD[1]), (550_000, wrong), (700_000, GOOD[3]))
    assert job.outcome is (TransactionOutcome.TIMEOUT if wrong[7:8] == b"\2" else TransactionOutcome.GARBLED)
    assert values(job) == {0: ALL[0], 2: ALL[2]}


def test_a_refusal_ends_its_turn_and_no_other():
    refusal = protocol2.status_packet(2, 0x07)
    job, elapsed = ask((400_000, GOOD[1]), (550_000, refusal), (700_000, GOOD[3]))
    assert job.outcome is TransactionOutcome.REFUSED
    assert values(job) == {0: ALL[0], 2: ALL[2]}
    assert elapsed == 700_000


def test_an_alert_comes_with_good_data():
    alert = protocol2.status_packet(2, 0x80, b"\2\2\2\2")
    job, _ = ask((400_000, GOOD[1]), (550_000, alert), (700_000, GOOD[3]))
    assert (job.outcome, values(job)) == (TransactionOutcome.OK, ALL)
    assert job.statuses[1][0] == 0x80


def test_stuffed_data_has_its_length_without_stuffing():
    stuffed = protocol2.status_packet(2, 0, b"\xff\xff\xfd\2")
    assert len(stuffed) == len(GOOD[2]) + 1
    job, _ = ask((400_000, GOOD[1]), (550_000, stuffed), (700_000, GOOD[3]))
    assert job.outcome is TransactionOutcome.OK
    assert values(job)[1] == b"\xff\xff\xfd\2"


def test_a_reply_sooner_than_the_wire_allows_is_an_older_one():
    job, _ = ask((100_000, GOOD[1]), (400_000, GOOD[1]), (550_000, GOOD[2]), (700_000, GOOD[3]))
    assert (job.outcome, job.strays) == (TransactionOutcome.OK, 1)
    assert job.statuses[0][2] == 401_000
