"""Requests of the loop for lost lines: one request per loss, and the descriptor that comes with the reply."""

import os
import socket

from msgspec.json import Decoder

from dxlrun.channels.child_processes import LineLost, LineReturned, MessageChannel
from dxlrun.run.loop_process import LineReopener


def test_lost_line_is_requested_once_per_loss(tmp_path):
    ours, theirs = socket.socketpair()
    guardian = MessageChannel(theirs, Decoder(LineLost))
    reopen = LineReopener(MessageChannel(ours, Decoder(LineReturned)))
    with open(tmp_path / "line", "w+b") as line:
        for _ in range(2):
            assert reopen(0) is None
            assert reopen(0) is None
            assert guardian.receive_messages() == [LineLost(0)]
            guardian.send_message(LineReturned(0), [line.fileno()])
            descriptor = reopen(0)
            assert os.fstat(descriptor).st_ino == os.fstat(line.fileno()).st_ino
            os.close(descriptor)
    guardian.close()
    assert reopen(0) is None
    ours.close()
