"""When replies are slept for, when they are polled for, and that no more than a share of a core is spent."""

import ctypes

import pytest

from dxlwire.exchange import kernel
from dxlwire.port.ports import AUTO_SHARE, MOST_SHARE, ReplyPolling

LIBRARY = kernel.library()

CYCLE_NS = 1_000_000
WAKE_NS = 50_000


class Line:
    """Answers each request after a while; polled by the time that a clock of its own shows."""

    def __init__(self, *wish, after_ns=400_000, overshoot_ns=20_000):
        self.now_ns = 10_000_000
        self.after_ns, self.overshoot_ns = after_ns, overshoot_ns
        self.naps = []
        self.polled_ns = 0
        self.polling = kernel.polling_state(ReplyPolling(*wish))

    def await_until(self, due_ns, deadline_ns):
        """Sleep as the kernel says; return until when it polls."""
        until = ctypes.c_int64()
        nap = LIBRARY.dxl_polling_begin
        nap.restype, nap.argtypes = ctypes.c_int64, [ctypes.c_void_p, *[ctypes.c_int64] * 3, ctypes.c_void_p]
        polling = ctypes.addressof(self.polling)
        nap_ns = nap(polling, due_ns, self.now_ns, deadline_ns, ctypes.addressof(until))
        if nap_ns:
            self.naps.append(nap_ns)
            self.now_ns += nap_ns + self.overshoot_ns
        return until.value

    def came(self, due_ns, at_ns):
        came = LIBRARY.dxl_polling_came
        came(ctypes.byref(self.polling), ctypes.c_int64(due_ns), ctypes.c_int64(at_ns))

    def cycle(self, due_ns=400_000):
        """Ask and await; return how late the reply is taken."""
        start = self.now_ns
        due, there = start + due_ns, start + self.after_ns
        until = self.await_until(due, start + 10 * CYCLE_NS)
        since, looks = self.now_ns, 0
        while until and self.now_ns < until and (looks == 0 or self.now_ns < there):
            self.now_ns += 1_000
            looks += 1
        if until:
            LIBRARY.dxl_polling_spent(ctypes.byref(self.polling), ctypes.c_int64(self.now_ns - since), looks)
            self.polled_ns += self.now_ns - since
        if self.now_ns < there:
            self.now_ns = there + WAKE_NS
        late = self.now_ns - there
        if there - start < CYCLE_NS:
            self.came(due, self.now_ns)
        self.now_ns = start + CYCLE_NS
        return late


def settled(line, cycles=300, **due):
    """Let the estimate settle; return how late each of the last replies was taken."""
    return [line.cycle(**due) for _ in range(cycles)][-50:]


def test_a_reply_is_slept_for_until_shortly_before_it_is_due_and_then_taken_at_once():
    line = Line()
    late = settled(line)
    assert max(late) <= 1_000
    assert line.naps[-1] == pytest.approx(400_000 - line.polling.margin_ns, abs=30_000)


@pytest.mark.parametrize(
    ("after_ns", "due_ns"), [(150_000, 500_000), (900_000, 400_000)], ids=["sooner", "later"]
)
def test_replies_that_keep_another_distance_than_the_plan_says_are_followed(after_ns, due_ns):
    line = Line(after_ns=after_ns)
    late = settled(line, due_ns=due_ns)
    assert sum(late) / len(late) < 25_000


@pytest.mark.parametrize(
    ("wish", "share"), [((), AUTO_SHARE), ((1_000_000,), MOST_SHARE), ((1_000_000, 0.02), 0.02)]
)
def test_no_more_than_a_share_of_a_core_is_polled_even_for_replies_that_never_come(wish, share):
    line = Line(*wish, after_ns=10 * CYCLE_NS)
    for _ in range(2_000):
        line.cycle()
    assert 0 < line.polled_ns <= share * 2_001 * CYCLE_NS


@pytest.mark.parametrize("ahead_ns", [-50_000, 0, 10_000, 100_000])
def test_one_reply_is_polled_for_no_longer_than_the_longest_time(ahead_ns):
    line = Line(300_000)
    line.polling.credit_ns = line.polling.saved_ns
    start = line.now_ns
    until = line.await_until(start + line.polling.margin_ns + ahead_ns, 1 << 62)
    assert start < until <= start + sum(line.naps) + 300_000


def test_without_credit_a_reply_is_neither_slept_nor_polled_for():
    line = Line()
    assert line.await_until(line.now_ns + 400_000, 1 << 62) == 0
    assert line.naps == []


def test_nobody_sleeps_beyond_the_next_deadline():
    line = Line()
    settled(line)
    line.naps.clear()
    assert line.await_until(line.now_ns + 400_000, line.now_ns + 300_000) == 0
    assert line.naps == []


def test_one_reply_that_is_very_late_does_not_let_the_next_ones_be_slept_through():
    line = Line()
    settled(line)
    line.came(line.now_ns - 15_000_000, line.now_ns)
    assert sum(line.cycle() for _ in range(20)) / 20 < 25_000


def test_replies_that_begin_to_come_much_sooner_are_found_soon():
    line = Line(after_ns=900_000)
    settled(line, due_ns=900_000)
    line.after_ns = 100_000
    assert [line.cycle(due_ns=900_000) for _ in range(8)][-1] < 25_000
