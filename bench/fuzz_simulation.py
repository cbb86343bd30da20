"""Campaign: random and mutated bytes, goals and forces for simulated servos of every model.

Nothing may be raised; whatever is answered consists of whole status packets with right checksums; where no
intact packet is in the bytes since the last pause, there is no reply at all; memory does not grow;
and after each servo's share, set back to how it was, it still answers a ping. Packets and checksums are made
and judged by code of this file. A bus whose mechanics are stepped at random times in addition moves and
answers as one whose mechanics are not.

    python bench/fuzz_simulation.py 1000000
    python bench/fuzz_simulation.py 200000 --sanitized

CI runs a seeded sample of it (tests/dxlsim/test_packets.py).
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import itertools
import math
import random
import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.sanitizers import load_sanitized, run_sanitized

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.motion import compiled_mechanics
from dxlsim.simulation_plan import AdapterConfig, BusConfig, ServoConfig
from dxlsim.wire import compiled_line
from dxlwire.control_table import ControlTable, all_tables

PER_SERVO = 250
"""Strings that one servo receives before another takes its place."""
PER_PAUSE = 10
"""Strings that follow each other without a pause that would end a packet."""
INSTRUCTIONS = (1, 2, 3, 4, 5, 6, 8, 0x10, 0x20, 0x82, 0x83, 0x8A, 0x92, 0x93, 0x9A, 0x55, 0x77)
FIXED = (b"\x01\x44\x58\x4c\x22", b"\x02\x45\x52\x43\x4c", b"\x01\x43\x54\x52\x4c", b"\x02\x43\x54\x52\x4c")
BROADCAST = 0xFE


@dataclass(slots=True)
class Tally:
    """What came of a campaign."""

    strings: int = 0
    intact: int = 0
    """Runs of strings with an intact packet."""
    silent: int = 0
    """Runs of strings that had to stay unanswered."""
    answers: int = 0


def crc(data: bytes) -> int:
    """Return the CRC-16 of Protocol 2.0 (polynomial 8005 hex), bit by bit from a table made here."""
    value = 0
    for byte in data:
        value = (value << 8 & 0xFFFF) ^ _CRC[value >> 8 ^ byte]
    return value


def _crc_of_byte(value: int) -> int:
    for _ in range(8):
        value = value << 1 ^ (0x18005 if value & 0x8000 else 0)
    return value


_CRC = tuple(_crc_of_byte(byte << 8) for byte in range(256))


def packet(protocol: float, servo_id: int, instruction: int, parameters: bytes) -> bytes:
    """Return an intact instruction packet."""
    if protocol == 1.0:
        body = bytes((servo_id, len(parameters) % 254 + 2, instruction)) + parameters[: len(parameters) % 254]
        return b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))
    stuffed = (bytes((instruction,)) + parameters).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    head = b"\xff\xff\xfd\x00" + bytes((servo_id,)) + (len(stuffed) + 2).to_bytes(2, "little")
    return head + stuffed + crc(head + stuffed).to_bytes(2, "little")


def holds_intact_packet(protocol: float, data: bytes) -> bool:
    """Return whether an intact packet begins anywhere; written to be obvious."""
    for start in range(len(data)):
        if protocol == 1.0:
            if data[start : start + 2] == b"\xff\xff" and start + 3 < len(data):
                body = data[start + 2 : start + 4 + data[start + 3]]
                if len(body) == data[start + 3] + 2 and len(body) >= 4 and sum(body) & 0xFF == 0xFF:
                    return True
        elif data[start : start + 3] == b"\xff\xff\xfd" and start + 7 <= len(data):
            size = 7 + int.from_bytes(data[start + 5 : start + 7], "little")
            whole = data[start : start + size]
            if len(whole) == size >= 10 and crc(whole[:-2]) == int.from_bytes(whole[-2:], "little"):
                return True
    return False


def judge(protocol: float, reply: bytes) -> int:
    """Return the number of status packets; raises AssertionError for anything else."""
    answers = 0
    while reply:
        size = _status1(reply) if protocol == 1.0 else _status2(reply)
        answers += 1
        reply = reply[size:]
    return answers


def _status1(reply: bytes) -> int:
    assert reply[:2] == b"\xff\xff", reply.hex(" ")
    size = 4 + reply[3]
    assert len(reply) >= size, reply.hex(" ")
    assert sum(reply[2:size]) & 0xFF == 0xFF, reply.hex(" ")
    return size


def _status2(reply: bytes) -> int:
    assert reply[:4] == b"\xff\xff\xfd\x00", reply.hex(" ")
    assert reply[7] == 0x55, reply.hex(" ")
    size = 7 + int.from_bytes(reply[5:7], "little")
    if reply[4] == BROADCAST:  # a fast status stays short where servos are missing: one of its CRCs ends it
        ends = range(min(size, len(reply)), 11, -1)
        size = next((end for end in ends if _right_crc(reply[:end])), 0)
    assert size <= len(reply), reply.hex(" ")
    assert _right_crc(reply[:size]), reply.hex(" ")
    return size


def _right_crc(status: bytes) -> bool:
    return len(status) > 2 and crc(status[:-2]) == int.from_bytes(status[-2:], "little")


class Host:
    """One simulated servo and the bytes that are sent to it."""

    def __init__(self, table: ControlTable, rng: random.Random, tally: Tally) -> None:
        self.protocol, self.table, self.rng, self.tally = table.protocol, table, rng, tally
        self.rate = 1_000_000 if 1_000_000 in table.baud_rates.values() else 57_600
        servo = ServoConfig(1, table.model, 1.0, return_delay_ns=2000 * rng.randrange(20))
        absent = rng.choice(("silent", "slot")) if table.protocol == 2.0 else "silent"
        config = BusConfig("main", self.rate, (servo,), table.protocol, adapter=AdapterConfig(absent=absent))
        self.bus = SimulatedBus(config, Ledger(keep=False), 0)
        self.now_ns = 0
        self.pause_ns = 2_000_000 if table.protocol == 2.0 else 101_000_000

    def send(self, data: bytes) -> bytes:
        """Send bytes; return all that is answered."""
        self.bus.receive_bytes(data, self.now_ns)
        self.now_ns += len(data) * 10_000_000_000 // self.rate
        reply = b""
        while (due := self.bus.next_due_ns()) is not None:
            self.now_ns = max(self.now_ns, due)
            reply += self.bus.drain_bytes(self.now_ns)
        return reply

    def run(self) -> None:
        """Send strings until the next pause, and judge what comes back."""
        gentle = self.rng.random() < 0.5
        sent, reply = b"", b""
        for _ in range(PER_PAUSE):
            string = self._string(gentle)
            sent += string
            reply += self.send(string)
            self.tally.strings += 1
        self.now_ns += self.pause_ns
        if holds_intact_packet(self.protocol, sent):
            self.tally.intact += 1
        else:
            assert reply == b"", f"{sent.hex(' ')} was answered by {reply.hex(' ')}"
            self.tally.silent += 1
        self.tally.answers += judge(self.protocol, reply)

    def set_back(self) -> None:
        """Make it reachable as it was, and expect the answer to a ping."""
        servo = self.bus.servos[0]
        for name, wire in (("id", 1), ("protocol_type", 2), ("status_return_level", 2)):
            if name in servo.registers:
                servo.poke(name, wire)
        item = "baud_rate" if "baud_rate" in self.table.items else "baud_rate_bus"
        servo.poke(item, next(value for value, rate in self.table.baud_rates.items() if rate == self.rate))
        self.now_ns += 300_000_000
        assert judge(self.protocol, self.send(packet(self.protocol, 1, 1, b""))) == 1

    def _string(self, gentle: bool) -> bytes:
        """Return random bytes, a damaged packet or, where it is not gentle, an intact one."""
        kind = self.rng.random()
        if kind < 0.25:
            return self._noise()
        made = packet(self.protocol, *self._content())
        return self._damaged(made) if gentle or kind < 0.5 else made

    def _content(self) -> tuple[int, int, bytes]:
        rng = self.rng
        servo_id = rng.choice((1, 1, 1, BROADCAST, rng.randrange(253)))
        instruction = rng.choice(INSTRUCTIONS)
        if instruction in (0x10, 0x20) and rng.random() < 0.8:
            return servo_id, instruction, rng.choice(FIXED)
        if instruction >= 0x80:
            servo_id = rng.choice((BROADCAST, BROADCAST, BROADCAST, servo_id))
        wide = 1 if self.protocol == 1.0 else 2
        place = rng.choice(tuple(self.table.items.values()))
        address = rng.choice((place.address, place.address, rng.randrange(1 << 8 * wide))) % (1 << 8 * wide)
        length = rng.choice((place.size, place.size, rng.randrange(12)))
        parts = [address.to_bytes(wide, "little"), length.to_bytes(wide, "little")]
        if instruction in (0x02, 0x06):
            parts = parts if rng.random() < 0.9 else [rng.randbytes(1)]
        elif instruction in (0x03, 0x04):
            parts[1] = self._data(length)
        elif instruction in (0x82, 0x8A):
            parts.append(bytes(rng.choice((1, 1, rng.randrange(256))) for _ in range(rng.randrange(4))))
        elif instruction == 0x83:
            parts.append(b"".join(b"\x01" + self._data(length) for _ in range(rng.randrange(3))))
        else:
            parts = [b"\x00" * (wide == 1), b"\x01", *parts, self._data(rng.choice((0, length)))]
        return servo_id, instruction, b"".join(parts)

    def _data(self, size: int) -> bytes:
        bytes_of = (0, 0, 1, 2, 0xFF, 0xFD) if self.rng.random() < 0.7 else range(256)
        return bytes(self.rng.choices(bytes_of, k=size))

    def _noise(self) -> bytes:
        rng = self.rng
        made = rng.randbytes(rng.randint(0, 30))
        header = b"\xff\xff\xfd\x00"[: rng.randint(0, 4)] if self.protocol == 2.0 else b"\xff\xff"
        return made + header + made[:3] if rng.random() < 0.5 else made

    def _damaged(self, made: bytes) -> bytes:
        rng, broken = self.rng, bytearray(made)
        where = rng.randrange(len(broken))
        match rng.randrange(4):
            case 0:
                broken[where] ^= 1 << rng.randrange(8)
            case 1:
                del broken[where : where + rng.randint(1, 6)]
            case 2:
                broken[where:where] = rng.randbytes(rng.randint(1, 6))
            case _:
                del broken[where:]
        return bytes(broken)


def campaign(protocol: float, count: int, seed: int) -> Tally:
    """Send `count` strings to servos of all models in turn; raises AssertionError at a broken promise."""
    rng, tally = random.Random(seed), Tally()
    tables = [table for table in all_tables() if table.protocol == protocol]
    rng.shuffle(tables)
    for table in itertools.cycle(tables):
        host = Host(table, rng, tally)
        try:
            for _ in range(PER_SERVO // PER_PAUSE):
                host.run()
            host.set_back()
        except Exception as error:
            raise AssertionError(f"{table.model}, seed {seed}, string {tally.strings}: {error}") from error
        if tally.strings >= count:
            return tally
    return tally


class Shafts:
    """Two equal buses with servos of three models; the mechanics of the second one are stepped more often."""

    def __init__(self, tables: list[ControlTable], rng: random.Random) -> None:
        self.rng, self.tables, self.now_ns = rng, rng.choices(tables, k=3), 0
        self.protocol = tables[0].protocol
        config = BusConfig(
            "main",
            1_000_000,
            tuple(
                ServoConfig(servo_id, table.model, rng.uniform(-7.0, 7.0))
                for servo_id, table in enumerate(self.tables, 1)
            ),
            self.protocol,
        )
        self.buses = [SimulatedBus(config, Ledger(keep=False), 0) for _ in range(2)]
        for bus in self.buses:
            for servo in bus.servos:
                servo.line.baud_rate = config.baud_rate

    def move(self) -> None:
        """Write a register or apply a force, let time pass, and compare the buses."""
        rng, number = self.rng, self.rng.randrange(3)
        table, kind = self.tables[number], self.rng.random()
        item = rng.choice(
            [each for each in table.items.values() if each.access == "RW" and each.area == "RAM"]
        )
        wire = rng.choice(
            (0, 1, item.maximum, rng.randint(0, abs(item.maximum)), rng.getrandbits(8 * item.size))
        )
        wire &= (1 << 8 * item.size) - 1
        by, while_ns = rng.uniform(-9.0, 9.0), rng.randrange(10**9)
        pauses_ns = rng.choices((0, 1, 999_999, 2_000_000, rng.randrange(10**8), rng.randrange(10**10)), k=3)
        for bus in self.buses:
            mechanics, servo = bus.mechanics, bus.servos[number]
            if kind < 0.7:
                place = item.address.to_bytes(1 if self.protocol == 1.0 else 2, "little")
                data = packet(self.protocol, number + 1, 3, place + wire.to_bytes(item.size, "little"))
                bus.receive_bytes(data, self.now_ns)
            elif kind < 0.8:
                servo.poke(item.name, wire)
            elif kind < 0.9:
                mechanics.turn_shaft(servo.shaft.index, by, while_ns, lambda _: None)
            else:
                mechanics.jam_shaft(servo.shaft.index, by > 0.0)
        for pause_ns in pauses_ns:
            self.now_ns += pause_ns
            self.buses[1].advance_to(self.now_ns)
        self.buses[0].advance_to(self.now_ns)
        seen = [self._seen(bus) for bus in self.buses]
        assert seen[0] == seen[1], f"{table.model}: {item.name} = {wire}"
        assert all(map(math.isfinite, self.buses[0].mechanics.plant.angle.tolist()))

    def _seen(self, bus: SimulatedBus) -> list[bytes]:
        plant, size = bus.mechanics.plant, 49 if self.protocol == 1.0 else 120
        reads = [bus.drain_bytes(self.now_ns), plant.angle.tobytes(), plant.velocity.tobytes()]
        for servo in bus.servos:
            servo.present(self.now_ns, 0, size)
            reads.append(bytes(servo.registers._memory))
        servos = bus.mechanics.servos.copy()
        servos["temperature"] = 0.0  # Calm servos skip changes of 1e-7 degrees
        return [*reads, servos.tobytes()]


def shake(protocol: float, count: int, seed: int) -> None:
    """Move shafts `count` times; raises AssertionError where their motion depends on the times of steps."""
    rng = random.Random(seed)
    tables = [table for table in all_tables() if table.protocol == protocol]
    for number in range(0, count, PER_SERVO):
        shafts = Shafts(tables, rng)
        for _ in range(min(PER_SERVO, count - number)):
            shafts.move()


def memory_kib() -> int:
    """Return what this process really holds: rubbish collected, what is free given back."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 1024


def main() -> None:
    """Run the campaign: strings, half of them for each protocol, and a move of shafts for ten of them."""
    parser = argparse.ArgumentParser()
    parser.add_argument("strings", type=int, nargs="?", default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sanitized", action="store_true", help="with AddressSanitizer and UBSan of gcc")
    chosen = parser.parse_args()
    modules = (compiled_line, compiled_mechanics)
    if chosen.sanitized:
        run_sanitized(modules)
    is_sanitized = load_sanitized(modules)
    for protocol in (1.0, 2.0):
        campaign(protocol, 25_000, chosen.seed)  # all models are loaded
        before, began = memory_kib(), time.monotonic()
        tally = campaign(protocol, chosen.strings // 2, chosen.seed)
        grown = memory_kib() - before
        shake(protocol, chosen.strings // 20, chosen.seed)
        took = time.monotonic() - began
        print(f"Protocol {protocol}: {tally}, memory grew by {grown} KiB, {took:.0f} s", flush=True)
        assert grown < (1 << 20 if is_sanitized else 4096), "something is never given back"


if __name__ == "__main__":
    main()
