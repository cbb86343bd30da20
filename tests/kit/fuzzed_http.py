"""Fuzzed requests on a port of HTTP: ones that command something, mutants of them in whole frames, noise."""

import os
import random
import re
import socket
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NamedTuple

Connect = Callable[[], socket.socket]
HALF_OPEN = 150
"""Connections that are left half open: more than twice as many as a port keeps."""
BATCH, MOST_BATCHES = 20, 50
"""Requests that are sent together, and batches of a connection; noise ends it."""
_STATUS = re.compile(rb"HTTP/1\.1 \d{3}")
_PAGE = os.sysconf("SC_PAGE_SIZE")


class Said(NamedTuple):
    method: str
    path: str
    body: bytes = b""
    head: str = "Host: x\r\n"
    """Lines of its head."""

    def frame(self) -> bytes:
        """Return it as HTTP/1.1."""
        first = f"{self.method} {self.path} HTTP/1.1\r\n{self.head}"
        return f"{first}Content-Length: {len(self.body)}\r\n\r\n".encode() + self.body


class Fuzzed(NamedTuple):
    """What was sent."""

    frames: int
    connections: int
    answers: int


def mutated(data: bytes, draw: random.Random) -> bytes:
    """Return bytes that differ a little."""
    match draw.randrange(5):
        case 0:
            return data[: draw.randrange(len(data) + 1)]
        case 1:
            return data * draw.randrange(1, 5)
        case 2:
            return draw.randbytes(draw.randrange(60))
        case _:
            found = bytearray(data or b"{")
            for _ in range(draw.randrange(1, 4)):
                found[draw.randrange(len(found))] = draw.randrange(256)
            return bytes(found)


def _mutant(said: Said, draw: random.Random) -> Said:
    """Return a request that differs, in a frame that is whole."""
    if draw.randrange(2):
        return said._replace(body=mutated(said.body, draw))
    path = mutated(said.path.encode(), draw).decode("latin-1")
    return said._replace(path="/" + re.sub(r"[^!-~]", "%", path))


def fuzz(connect: Connect, seeds: Sequence[Said], count: int, draw: random.Random) -> Fuzzed:
    """Send so many frames, all answers of whole ones awaited, on as many connections as that takes."""
    sent, connections, answers = 0, 0, 0
    while sent < count:
        connections += 1
        with connect() as end, suppress(OSError):  # it was closed for what broke the protocol
            for _ in range(min(MOST_BATCHES, (count - sent) // BATCH)):
                batch = [draw.choice(seeds) for _ in range(BATCH)]
                end.sendall(
                    b"".join((_mutant(one, draw) if draw.randrange(3) else one).frame() for one in batch)
                )
                sent += BATCH
                answers += _answers(end, BATCH)
            sent += 1
            # without its head: a wrong one that changes can become right, and the request may command then
            noise = draw.choice(seeds)._replace(head=Said._field_defaults["head"])
            end.sendall(mutated(noise.frame(), draw))
    return Fuzzed(sent, connections, answers)


def _answers(end: socket.socket, count: int) -> int:
    """Return how many answers came, of so many; fewer: the connection ended."""
    got = b""
    while (found := len(_STATUS.findall(got))) < count and (data := end.recv(1 << 16)):
        got += data
    return found


def check_port_survives_fuzzing(
    connect: Connect, reach: Connect, seeds: Sequence[Said], process: int, *, frames: int, draw: random.Random
) -> None:
    """Fuzz a port, and leave connections half open that `reach` opens.

    The port still serves, and the memory of its process does not grow after the first tenth of the frames.
    """
    kept: list[float] = []
    for count in (frames // 10, frames):
        sent = fuzz(connect, seeds, count, draw)
        with ExitStack() as opened:
            for number in range(HALF_OPEN):
                end = opened.enter_context(reach())
                with suppress(ConnectionError):  # ended already, as one of too many
                    end.sendall(b"\x16\x03\x01"[: number % 4])
            with connect() as end:
                end.sendall(seeds[0].frame())
                assert _answers(end, 1) == 1
        kept.append(memory(process))
        print(sent, kept, "MB")
    assert sent.answers > 0.5 * sent.frames
    assert kept[1] < kept[0] + 40.0  # 64 connections in their handshake take up to 32


def memory(process: int) -> float:
    """Return the resident memory of a process, MB."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * _PAGE / 1e6


def process_of(parent: int, words: str) -> int:
    """Return the process below another one that has these words in its command line; 0: there is none."""
    for child in children(parent):
        if words in Path(f"/proc/{child}/cmdline").read_bytes().decode():
            return child
        if found := process_of(child, words):
            return found
    return 0


def children(parent: int) -> list[int]:
    """Return the processes that another one started."""
    return [int(one) for one in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]
