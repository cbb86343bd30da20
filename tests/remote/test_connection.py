"""Clients that hang, flood, die or send rubbish, at the real socket; the loop's mailbox is the judge."""

import asyncio
import gc
import os
import random
import select
import socket
import subprocess
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from dxlrun.channels.heartbeat import Phase
from dxlrun.remote import gateway, server
from dxlrun.remote.client import RemoteRobot
from dxlrun.remote.live.live_topics import framed
from dxlrun.remote.network.commander import Client
from dxlrun.remote.requests.replies import RunEnded
from dxlrun.remote.requests.request_table import Role
from dxlrun.remote.server import MOST_CONNECTIONS, MOST_OF_PROCESS
from dxlrun.remote.sockets import MOST_BYTES, SocketLink

STOP = b"POST /stop HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n\r\n"
GO = b"POST /controllers/left/commands/go HTTP/1.1\r\nHost: x\r\n"


def test_clients_that_hang_do_not_keep_others_out(door):
    async def act():
        hanging = [await door.connect(GO[:length]) for length in range(MOST_CONNECTIONS + 20)]
        assert await door.stopped()
        closed = [reader for reader, _ in hanging if reader.at_eof()]
        for _, writer in hanging:
            writer.close()
        return len(closed)

    assert door.open(act) >= 20
    assert [command.kind for command in door.desk.taken] == ["stop"]


@pytest.mark.parametrize(("user", "accepted"), [(0, True), (1000, True), (1001, False)])
def test_other_users_of_this_computer_are_refused(user, accepted, monkeypatch):
    monkeypatch.setattr(os, "getuid", lambda: 1000)
    end = SimpleNamespace(getsockopt=lambda *_: server._CREDENTIALS.pack(7, user, 0))
    client = server._client(SimpleNamespace(get_extra_info=lambda _: end), {})
    assert (client is not None) is accepted


FLOOD = """
import collections, socket, sys, time
kept, until, told = collections.deque(maxlen=300), time.monotonic() + 60, False
while time.monotonic() < until:
    one = socket.socket(socket.AF_UNIX)
    one.setblocking(False)
    try:
        one.connect(sys.argv[1])
        one.send(b"POST /stop")
        kept.append(one)
    except (BlockingIOError, ConnectionError):
        one.close()
        if not told:
            print("the queue is full", flush=True)
            told = True
"""
STOPS = 8


def test_stop_is_taken_from_another_process_while_one_floods_the_socket_with_connections(door):
    def flood_and_stop():
        with subprocess.Popen([sys.executable, "-c", FLOOD, door.path], stdout=subprocess.PIPE) as flood:
            try:
                flood.stdout.readline()
                for _ in range(STOPS):
                    RemoteRobot("pair", SocketLink(Path(door.path), "test")).stop(wait=False)
            finally:
                flood.kill()

    door.open(partial(asyncio.to_thread, flood_and_stop))
    assert [command.kind for command in door.desk.taken] == ["stop"] * STOPS
    assert {command.origin for command in door.desk.taken} == {"test"}


def test_a_process_has_some_connections_and_leaves_those_of_others_alone(door, monkeypatch):
    process = iter([1, *[2] * 40, *range(3, 60)])
    monkeypatch.setattr(server, "_client", lambda *_: Client(f"process {next(process)}", Role.ADMIN))

    async def remain(count, ends):
        while (left := [end for end in ends if not end[0].at_eof()])[count:]:
            await asyncio.sleep(0.001)
        return left

    async def act():
        quiet = [await door.connect(GO[:9])]
        flood = [await door.connect(GO[:9]) for _ in range(40)]
        left = await remain(MOST_OF_PROCESS, flood)
        assert left == flood[-MOST_OF_PROCESS:]
        others = [await door.connect(GO[:9]) for _ in range(55)]
        left = await remain(MOST_CONNECTIONS - 56, flood)
        assert left == flood[-(MOST_CONNECTIONS - 56) :]
        assert len(await remain(56, quiet + others)) == 56
        for _, writer in (*quiet, *flood, *others):
            writer.close()

    door.open(act)


def test_head_and_body_of_a_reply_are_sent_together(door, monkeypatch):
    sent = []
    transport = asyncio.selector_events._SelectorSocketTransport
    write = transport.write
    monkeypatch.setattr(transport, "write", lambda self, data: (sent.append(bytes(data)), write(self, data)))

    async def act():
        reader, writer = await door.connect(STOP)
        answer = await reader.readuntil(b"}")
        writer.close()
        return answer

    answer = door.open(act)
    assert [data for data in sent if data not in (b"", STOP)] == [answer]


def test_a_silent_connection_is_closed(door, monkeypatch):
    monkeypatch.setattr(server, "SILENCE_S", 0.02)

    async def act():
        ends = [await door.connect(data) for data in (b"", GO[:30], GO + b"Content-Length: 20\r\n\r\n{")]
        answers = []
        for reader, writer in ends:
            try:
                answers.append(await asyncio.wait_for(reader.read(), 60))
            except ConnectionResetError:
                answers.append(b"")
            writer.close()
        return answers

    assert door.open(act) == [b"", b"", b""]
    assert door.desk.taken == []


STREAM = b"GET /stream?topic=/joint_states HTTP/1.0\r\n\r\n"


def test_a_stream_stays_open_while_it_is_read_or_quiet_and_a_sleeping_listener_is_closed(door, monkeypatch):
    """What that one does not take stays in the ring: the gateway keeps no more for it than for others."""
    monkeypatch.setattr(server, "SILENCE_S", 0.1)
    monkeypatch.setattr(gateway, "BEAT_S", 0.02)
    kept = []

    async def act():
        quiet, quiet_end = await door.connect(b"GET /stream?topic=/events HTTP/1.0\r\n\r\n")
        reading, reading_end = await door.connect(STREAM)
        sleeping = socket.socket(socket.AF_UNIX)
        sleeping.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sleeping, door.path)
        sleeping.send(STREAM)
        until = asyncio.get_running_loop().time() + 60
        await quiet.readuntil(b"\r\n\r\n")
        await reading.readuntil(b"\r\n\r\n")
        connections = []
        while len(connections) < 3:
            found = [one for one in gc.get_objects() if type(one) is server.Connection and one.transport]
            connections = [one for one in found if not one.transport.is_closing()]
            await asyncio.sleep(0.001)
        connections[0].last_byte_s = 0.0
        connections[0].pause_writing()
        connections[0].resume_writing()  # as when a slow listener has taken a part
        assert connections[0].last_byte_s > 0.0
        read = 0
        while asyncio.get_running_loop().time() < until:
            for _ in range(50):
                door.desk.finish_cycle()
            read += len(await reading.read(1 << 20))
            sizes = [one.transport.get_write_buffer_size() for one in connections if one.transport]
            kept.append(max(sizes, default=0))
            if hung_up(sleeping):
                break
        else:
            raise AssertionError("the sleeping listener was never closed")
        door.desk.heartbeat.enter_phase(Phase.DONE)
        ends = [await asyncio.wait_for(one.read(), 60) for one in (reading, quiet)]
        for end in (reading_end, quiet_end, sleeping):
            end.close()
        return read, ends

    read, ends = door.open(act)
    assert read > 100_000
    assert max(kept) < 1 << 18
    assert all(end.endswith(framed(RunEnded())) for end in ends)
    assert bytes(4) in ends[1]


def hung_up(end: socket.socket) -> bool:
    """Whether the other side has closed a connection of which nothing is read."""
    look = select.poll()
    look.register(end, select.POLLRDHUP)
    return bool(look.poll(0))


def test_a_listener_that_is_killed_leaves_nothing_behind(door):
    async def act():
        for _ in range(3 * MOST_OF_PROCESS):
            reader, writer = await door.connect(STREAM)
            await reader.readuntil(b"\r\n\r\n")
            writer.transport.abort()
            door.desk.finish_cycle()
        while [one for one in asyncio.all_tasks() if "RequestResponseCycle" in str(one.get_coro())]:
            await asyncio.sleep(0.001)
        assert await door.stopped()

    door.open(act)


RUBBISH = [
    random.Random(3).randbytes(4096),
    b"\r\n" * 100_000,
    b"GET / HTTP/9.9\r\n\r\n",
    b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n",
    b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 10_000,
    GO + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\n",
    GO + b"Transfer-Encoding: chunked\r\n\r\nXYZ\r\n",
    b"GET /robot HTTP/1.1\r\nHost: x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n" + bytes(100),
    STOP[:-2],
]


def test_rubbish_is_no_command_and_the_next_client_is_served(door):
    async def act():
        for rubbish in RUBBISH:
            _, writer = await door.connect(rubbish)
            await asyncio.sleep(0)
            assert await door.stopped()
            writer.close()

    door.open(act)
    assert [command.kind for command in door.desk.taken] == ["stop"] * len(RUBBISH)


@pytest.mark.parametrize("way", ["announced", "in pieces"])
def test_ten_megabytes_are_refused_and_not_read(door, way):
    def flood():
        head = (
            b"Content-Length: 10000000\r\n\r\n"
            if way == "announced"
            else b"Transfer-Encoding: chunked\r\n\r\n"
        )
        piece = bytes(65_536) if way == "announced" else b"10000\r\n" + bytes(65_536) + b"\r\n"
        sent = 0
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(door.path)
            client.sendall(GO + head)
            with suppress(ConnectionError):
                while sent < 10_000_000:
                    sent += client.send(piece)
            return sent, client.recv(100)

    async def act():
        told = await asyncio.to_thread(flood)
        assert await door.stopped()
        return told

    sent, answer = door.open(act)
    assert sent < 2 * MOST_BYTES
    assert answer.startswith(b"HTTP/1.1 413 ")
    assert [command.kind for command in door.desk.taken] == ["stop"]


def test_a_client_that_asks_without_reading_is_not_served_for_ever(door):
    request = b"GET /robot HTTP/1.1\r\nHost: x\r\n\r\n"

    async def act():
        _, writer = await door.connect()
        sent = 0
        while sent < 10_000_000:  # more than socket and gateway may keep
            writer.write(request * 1000)
            sent += 1000 * len(request)
            try:
                await asyncio.wait_for(writer.drain(), 0.2)
            except TimeoutError:
                break
        assert await door.stopped()
        writer.transport.abort()
        return sent

    assert door.open(act) < 10_000_000


def test_connections_that_came_and_went_leave_nothing_in_memory(door):
    async def act():
        for _ in range(200):
            _, writer = await door.connect(GO[:20])
            writer.close()
            await writer.wait_closed()
        assert await door.stopped()
        await asyncio.sleep(0.01)
        gc.collect()
        return sum(isinstance(one, server.Connection) for one in gc.get_objects())

    assert door.open(act) <= 5


def test_a_client_without_a_name_is_known_by_its_process(door):
    door.open(door.stopped)
    assert door.desk.taken[0].origin == f"process {os.getpid()}"


def test_the_gateway_ends_when_its_line_does_also_with_clients_that_hang(door):
    clients = [socket.socket(socket.AF_UNIX) for _ in range(2)]

    async def act():
        for client, data in zip(clients, (GO[:20], GO + b"Content-Length: 20\r\n\r\n{"), strict=True):
            client.connect(door.path)
            client.send(data)
        assert await door.stopped()

    door.open(act)
    for client in clients:
        with client, suppress(ConnectionResetError):
            while client.recv(1000):  # until the end
                pass
