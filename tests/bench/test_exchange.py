"""The benchmark of the exchange: what each host exchanges, judged by byte counts and by the ledger.

How fast a host is decides nothing here.
"""

import numpy as np
import pytest

from dxlrun.errors import ProcessFault
from dxlrun_lab.late_servos import LedgerTransaction
from exchange.bus import Settings, bench_bus, chosen_hosts
from exchange.canned import CannedResponder
from exchange.case import Case, Registers
from exchange.hosts import HOSTS
from exchange.rounds import measure
from exchange.wire import judge

pytestmark = pytest.mark.long

SECONDS = 0.2
ALL = [kind.name for kind in HOSTS]


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_every_host_exchanges_the_same_bytes_with_the_canned_responder(protocol: float):
    case = Case(protocol, 3)
    (found,) = bench_bus([("canned", case)], Settings(chosen_hosts(ALL), SECONDS)).cases
    hosts = {one.host: one for one in found.hosts}
    assert set(hosts) == set(ALL) if protocol == 2.0 else set(hosts) == {n for n in ALL if "fast" not in n}
    registers = Registers.of(case.plan(wire=False))
    assert hosts["ours"].sent_bytes == hosts["unrecorded"].sent_bytes == hosts["floor"].sent_bytes
    assert hosts["ours"].received_bytes == hosts["floor"].received_bytes
    for name in ("sdk", "rustypot"):
        one = hosts[name]
        assert one.sent_bytes == hosts["sdk"].sent_bytes
        assert one.received_bytes == 3 * (registers.read_length + (6 if protocol == 1.0 else 11))
    if protocol == 2.0:  # one status for all: 4 bytes a servo beside its data instead of 11
        assert hosts["sdk-fast"].received_bytes == 8 + 3 * (registers.read_length + 4)
        assert hosts["rustypot-fast"].received_bytes == hosts["sdk-fast"].received_bytes
    ours, budget = hosts["ours"], case.plan(wire=False).buses[0].budget
    assert ours.sent_bytes + ours.received_bytes == budget.request_bytes + budget.reply_bytes


def test_on_simulated_servos_the_ledger_says_how_many_bytes_an_exchange_has():
    case = Case(2.0, 2)
    settings = Settings(chosen_hosts(["ours", "rustypot"]), 2 * SECONDS)
    budget = case.plan(wire=True).buses[0].budget
    for _ in range(10):  # behind a lost reply a servo gets no goals, and machines stand still now and then
        (found,) = bench_bus([("simulated", case)], settings).cases
        ours = next(one for one in found.hosts if one.host == "ours")
        if not ours.lost:
            break
    assert (found.against, found.baud_rate) == ("simulated", 1_000_000)
    assert ours.sent_bytes + ours.received_bytes == budget.request_bytes + budget.reply_bytes
    assert ours.wire.wire_us == budget.wire_ns / 1e3


def test_a_responder_that_ended_is_an_error_and_is_not_waited_for():
    responder = CannedResponder([Case(1.0, 1).simulated("main")], -1)
    responder._process.kill()
    with pytest.raises(ProcessFault, match="the canned responder ended"):
        responder.rehearse(0, Made(set()), first=True)
    responder.close()


class Made:
    """A host whose exchanges are lost on request."""

    def __init__(self, lost: set[int]):
        self.count, self.lost = 0, lost

    def start(self):
        pass

    def exchange(self) -> bool:
        self.count += 1
        return self.count not in self.lost

    recover = close = start

    def sent(self) -> tuple[()]:
        return ()


def test_a_turn_with_a_lost_reply_counts_only_as_lost_and_the_host_is_mended():
    recovered: list[str] = []
    hosts = {"good": Made(set()), "bad": Made({2, 6})}
    found = measure(hosts, 1e-6, most=5, recover=recovered.append)
    assert recovered == ["bad", "bad"]
    assert (found["good"].lost, found["bad"].lost) == (0, 2)
    assert found["good"].exchanges > 0
    assert found["bad"].walls_ns == []


def test_a_transaction_belongs_to_the_exchange_that_waited_for_it():
    answered = [
        LedgerTransaction(handed_ns=150, late_ns=3, taken=10, given=20),
        LedgerTransaction(handed_ns=250, late_ns=4, taken=30, given=40),
        LedgerTransaction(handed_ns=270, late_ns=5, taken=31, given=41),
        LedgerTransaction(handed_ns=990, late_ns=90, taken=99, given=99),  # behind the last of them
    ]
    found = judge(answered, np.array([100, 200, 300]), np.array([100, 100, 100]))
    assert found.late_ns.tolist() == [3, 9, 0]
    assert (found.sent_bytes, found.received_bytes) == (20, 20)
