"""Work in a copy of the gateway's process: what comes back, and what happens when nothing does."""

import asyncio
import os
import socket
import time
from contextlib import suppress
from pathlib import Path

import pytest
from tests.kit.awaited import DEADLINE_S

from dxlrun import Refused, RemoteRobot
from dxlrun.errors import RunGone
from dxlrun.remote.computation import computed
from dxlrun.testing import plan_of
from dxlrun.tooling.runs import VirtualLink

ROBOTS = Path(__file__).parents[2] / "robots"


def brood():
    while True:
        with suppress(BaseException):
            time.sleep(0.01)


def test_the_result_comes_back_whole():
    work = bytes(range(256)) * 4096
    assert asyncio.run(computed(lambda: work, 10.0)) == work
    assert asyncio.run(computed(lambda: b"", 10.0)) == b""


def fail():
    raise SystemExit(0)


@pytest.mark.parametrize("work", [fail, lambda: os._exit(3), lambda: bytes(-1)])
def test_what_fails_has_no_result(work):
    assert asyncio.run(computed(work, 10.0)) is None


def test_a_copy_that_is_not_needed_any_more_is_ended_and_leaves_no_process(monkeypatch):
    born = []  # other tests of this process may have left it children: multiprocessing keeps one

    def fork():
        born.append(forked())
        return born[-1]

    forked = os.fork
    monkeypatch.setattr(os, "fork", fork)

    async def cancelled():
        computing = asyncio.ensure_future(computed(brood, 60.0))
        await asyncio.sleep(0.01)
        computing.cancel()
        with suppress(asyncio.CancelledError):
            await computing

    asyncio.run(cancelled())
    (child,) = born
    with pytest.raises(ChildProcessError):
        os.waitpid(child, os.WNOHANG)


def test_a_connection_that_is_closed_meanwhile_is_closed():
    ours, theirs = socket.socketpair()
    theirs.settimeout(DEADLINE_S)

    async def hang_up():
        computing = asyncio.ensure_future(computed(brood, 60.0))
        await asyncio.sleep(0.1)
        ours.close()
        received = await asyncio.to_thread(theirs.recv, 1)
        computing.cancel()
        with suppress(asyncio.CancelledError):
            await computing
        return received

    with theirs:
        assert asyncio.run(hang_up()) == b""


def test_virtual_time_stands_still_while_a_copy_works():
    """Else a motion begins later on a busy machine, or its copy is killed after 8 s of virtual time."""
    with RemoteRobot("bioloid_torso", VirtualLink(plan_of(ROBOTS / "bioloid_torso.yaml"))) as robot:
        assert robot.play(ROBOTS / "motions/three_parts.yaml").cycle == 1


def test_on_virtual_time_a_copy_that_hangs_is_ended_too(monkeypatch):
    monkeypatch.setattr("dxlrun.testing.virtual_link.PATIENCE", 0.01)
    monkeypatch.setattr("dxlrun.remote.gateway.GatewayApp._played", lambda *_: brood())
    with RemoteRobot("bioloid_torso", VirtualLink(plan_of(ROBOTS / "bioloid_torso.yaml"))) as robot:
        with pytest.raises(Refused, match="8 s"):
            robot.play(ROBOTS / "motions/three_parts.yaml")
        assert robot.states().cycle == 0
    with pytest.raises(RunGone, match="its link is closed"):
        robot.states()
