"""What kernel and parser of the runtime take for a reply; all else the kernel leaves to the parser."""

from __future__ import annotations

import numpy as np
from tests.kit.exchanges import AT_NS, GOOD, Host, SpoiltReplies, every

import fuzz_kernel as fuzz
from dxlrun.errors import PortError


class ParserHost(Host):
    """Four servos that the parser alone reads."""

    by_parser = True

    def __init__(self, way):
        plans, self.dialect = fuzz.robot(way, 1)
        self.side = fuzz.Side(plans, by_parser=self.by_parser)
        self.goals = np.full_like(self.side.goals.values, np.nan)
        (self.bus,) = self.side.hardware._buses
        self.byte_ns = self.bus.byte_ns

    def reads(self):
        return self.side.prepare()[0]

    def exchange(self, given):
        self.ended = self.side.ended
        self.side.cycle([given], self.goals)
        return self.side.states.valid.tolist()

    @property
    def log(self):
        return [(one.kind, one.data, one.last_ns) for one in self.side.log]

    @property
    def errors(self):
        return self.side.hardware._servos[0].reads.errors

    @property
    def noise_bytes(self):
        return self.bus.noise_bytes


class KernelHost(ParserHost):
    """Four servos that the kernel reads."""

    by_parser = False

    def check_reader(self, by_kernel):
        assert (self.side.ended > self.ended) == by_kernel


class TestParser(SpoiltReplies):
    host = ParserHost


class TestKernel(SpoiltReplies):
    host = KernelHost

    @every
    def test_a_line_that_is_ready_without_a_byte_is_waited_for(self, line, monkeypatch):
        wait, calls = line.side.lines.wait_for_bytes, []

        def ready(deadline_ns):
            calls.append(deadline_ns)
            return [0] if len(calls) == 2 else wait(deadline_ns)

        monkeypatch.setattr(line.side.lines, "wait_for_bytes", ready)
        assert line.cycle(by_kernel=True) == GOOD
        assert len(calls) > 2

    @every
    def test_a_line_that_is_gone_is_left_to_the_parser_at_once(self, line, monkeypatch):
        looks = []

        def gone(buffer):
            looks.append(len(buffer))
            raise PortError("it is gone")

        monkeypatch.setattr(line.side.lines.ports[0], "read_into", gone)
        assert line.cycle(by_kernel=False) == [False] * 4
        assert str(line.bus.failure) == "it is gone"
        assert len(looks) == 2  # the kernel's, and the parser's, which has the reason

    @every
    def test_reply_is_awaited_from_when_the_host_had_sent_its_request(self, line):
        line.side.lines.ports[0].stall_ns = 50_000_000  # longer than any reply is awaited

        def pieces(packets):
            return [(50_000_000 + AT_NS, b"".join(packets))]

        assert line.cycle(pieces=pieces, by_kernel=True) == GOOD

    @every
    def test_reply_that_came_while_the_host_stood_still_is_taken(self, line, monkeypatch):
        wait = line.side.lines.wait_for_bytes

        def late(deadline_ns):
            if deadline_ns:
                line.side.lines.clock.wait_until(deadline_ns + 30_000_000)
                return []
            return wait(0)

        monkeypatch.setattr(line.side.lines, "wait_for_bytes", late)
        assert line.cycle(by_kernel=True) == GOOD
