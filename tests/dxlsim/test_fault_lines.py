"""A fault's line of text: read, refused, written back; whatever the grammar allows can happen."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from tests.kit.cases import read_lines
from tests.kit.simulated_line import Line

from dxlsim.faults.fault import fault_help, parse_fault
from dxlsim.faults.kinds import DEVICE, KINDS
from dxlsim.faults.values import READERS
from dxlwire.exceptions import InputError

MS = 1_000_000
LINES = [line.text for line in read_lines(Path(__file__).with_name("fault_lines.txt")) if line.text]
RIGHT = [line for line in LINES if " = " not in line and "=> " not in line]
VALUES: dict[str, str] = {
    "bus": "main",
    "servo": "1 2",
    "from": "host",
    "byte": "0 -1 7 200 -200",
    "flip": "1 0xff",
    "keep": "1 5 200",
    "by": "1ns 3ms 40ms",
    "turn by": "30deg -0.5rad 720deg",
    "tip by": "30deg -0.5rad",
    "about": "x z",
    "copies": "2 16",
    "data": "ff ffff0102 fffffd00",
    "size": "1 256",
    "every": "100us 2ms",
    "number": "0 1020 65535",
    "volts": "0 7.4 60",
    "celsius": "-50 200",
    "share": "0.01 0.5 1",
    "low": "0deg -1rad 30deg",
    "high": "31deg 2rad 150deg",
    "ohms": "0 0.5 2",
    "seed": "0 5",
    "faults": "1 20",
    "within": "1us 200ms",
    "kinds": "lose " + ",".join(kind for kind in KINDS if kind not in {"storm", "tip"}),
    "count": "1 7",
    "at": "0s 50ms 5s",
    "packet": "1 10 100000",
    "for": "1ns 30ms 5s",
}


@pytest.mark.parametrize("line", LINES)
def test_a_line_is_written_back_or_refused_with_a_sentence_that_corrects_it(line):
    text, refused, message = line.rpartition("=> ")
    if refused:
        with pytest.raises(InputError) as error:
            parse_fault(text.strip())
        assert message in str(error.value)
        assert len(error.value.sentences) == 1
        return
    given, _, canonical = line.partition(" = ")
    fault = parse_fault(given)
    assert str(fault) == (canonical or given)
    assert parse_fault(str(fault)) == fault


def test_text_has_every_kind_and_every_key_and_the_help_has_a_line_for_each_kind():
    assert {line.split(maxsplit=1)[0] for line in RIGHT} == set(KINDS)
    assert {word.partition("=")[0] for line in RIGHT for word in line.split()[1:]} == set(READERS)
    assert set(VALUES) == {*READERS, "turn by", "tip by"}
    assert [line.split(maxsplit=1)[0].rstrip(":") for line in fault_help()] == list(KINDS)
    delay = "delay servo=ID by=TIME [count=NUMBER] [bus=NAME] [at=TIME] [packet=NUMBER]: the next reply"
    assert fault_help()[3].startswith(delay)


def test_an_angle_in_radians_is_the_same_in_degrees():
    radians = parse_fault("turn servo=2 by=1rad")
    assert radians.given["by"] == pytest.approx(57.29578)
    assert parse_fault(str(radians)) == radians


def drawn(chance: random.Random, kind: str) -> str:
    """Return a line of a kind; some of them have keys that exclude each other."""
    needs = KINDS[kind].needs
    keys = [*needs, *(key for key in KINDS[kind].readers if key not in needs and chance.random() < 0.4)]
    values = {key: VALUES.get(f"{kind} {key}", VALUES[key]).split() for key in keys}
    return " ".join((kind, *(f"{key}={chance.choice(values[key])}" for key in keys)))


def right_lines(chance: random.Random, count: int) -> list[str]:
    """Return lines of all kinds in turn that are right."""
    right: list[str] = []
    kinds = tuple(name for name, kind in KINDS.items() if kind.of != DEVICE)  # there are servos alone
    while len(right) < count:
        line = drawn(chance, kinds[len(right) % len(kinds)])
        try:
            right.append(str(parse_fault(line)))
        except InputError:
            continue
    return right


@pytest.mark.parametrize("model", ["AX-12A", "XM430-W350"])
def test_faults_of_every_kind_together_end_nothing_and_are_noted_once(model):
    chance = random.Random(1 + (model == "XM430-W350"))
    share: list[float] = []
    for _ in range(6):
        line = Line(model)
        script = line.inject(*right_lines(chance, 2 * len(KINDS)), seed=chance.randrange(100))
        planned = [str(fault) for fault in script.waiting] + line.faults
        while line.clock.now_ns() < 300 * MS:
            for servo_id in (1, 2):
                line.bus.receive_bytes(line.packet(servo_id, 0x01), line.clock.now_ns())
                line.clock.wait_until(line.clock.now_ns() + 5 * MS)
                assert len(line.bus.drain_bytes(line.clock.now_ns())) < 10_000
        assert sorted([*line.faults, *map(str, script.waiting)]) == sorted(planned)
        share.append(len(line.faults) / len(planned))
    assert sum(share) / 6 > 0.25  # an adapter that is gone early leaves little to happen


def test_a_line_is_refused_with_a_sentence_or_read_and_written_back_whatever_it_is():
    chance, refused = random.Random(3), []
    for index in range(3000):
        line = drawn(chance, tuple(KINDS)[index % len(KINDS)])
        for _ in range(chance.randint(0, 3)):
            at, put = chance.randrange(len(line) + 1), ("", " ", "=", "x", "-", "9", "\x00", "é", line)
            line = line[:at] + chance.choice(put) + line[at + 1 :]
        try:
            fault = parse_fault(line)
        except InputError as error:
            refused.append(error)
        else:
            assert parse_fault(str(fault)) == fault
    assert 500 < len(refused) < 2900
    assert {len(error.sentences) for error in refused} == {1}
