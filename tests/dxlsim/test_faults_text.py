"""A fault's line of text: read, refused with a sentence that mends it, and written back."""

from __future__ import annotations

import pytest

from dxlsim.faults.fault import fault_help, parse_fault
from dxlsim.faults.kinds import KINDS
from dxlsim.faults.values import READERS
from dxlwire.exceptions import InputError

LINES = (
    "lose servo=3 at=2s",
    "lose from=host packet=7",
    "corrupt servo=3 byte=5 packet=100",
    "corrupt bus=main servo=3 byte=-1 flip=0x80 count=3 at=2500us",
    "truncate servo=3 keep=4",
    "delay servo=3 by=5ms",
    "duplicate servo=3 copies=3",
    "noise data=ff00fd at=1s",
    "noise size=20",
    "silence servo=3 at=1s for=500ms",
    "babble servo=3 size=4 every=1ms for=2s",
    "reboot servo=0 for=1ns",
    "brownout for=200ms",
    "voltage servo=1 volts=7.4",
    "overload servo=3",
    "overheat servo=3 celsius=81.123456789",
    "turn servo=2 by=30deg for=1s",
    "turn servo=2 by=-0.125deg at=1s for=500ms",
    "tip servo=241 by=60deg about=x at=2s for=500ms",
    "other_model servo=3 number=1020 for=1s",
    "duplicate_id servo=253",
    "loose servo=2 share=0.5 low=0deg high=30.5deg for=1s",
    "lossy share=0.02 at=1s",
    "lossy servo=2 share=1",
    "slow servo=2 by=300us at=1s for=2s",
    "jam servo=2 at=1s",
    "sag ohms=0.8 for=2s",
    "timer by=4ms at=1s",
    "unplug bus=main at=5s for=2s",
    "wedge at=0s",
    "storm seed=7 faults=10 within=30s kinds=lose,corrupt",
)


@pytest.mark.parametrize("line", LINES)
def test_a_line_is_written_back_as_it_was_read(line):
    assert str(parse_fault(line)) == line


def test_every_kind_has_a_line_here():
    assert {line.split()[0] for line in LINES} == set(KINDS)


def test_some_line_here_has_each_key():
    assert {word.partition("=")[0] for line in LINES for word in line.split()[1:]} == set(READERS)


def test_a_line_can_be_written_in_other_ways_and_has_one_canonical_text():
    other = parse_fault("  corrupt   at=0.5s flip=1 byte=0x10 servo=3 ")
    assert str(other) == "corrupt servo=3 byte=16 flip=0x01 at=500ms"
    assert other == parse_fault(str(other))
    assert str(parse_fault("lose servo=3 count=1")) == "lose servo=3"
    radians = parse_fault("turn servo=2 by=1rad")
    assert radians.given["by"] == pytest.approx(57.29578)
    assert parse_fault(str(radians)) == radians


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "the fault is empty; write a fault such as: lose servo=3 at=2s"),
        ("losee servo=3", "unknown fault 'losee'; did you mean lose?"),
        ("explode", "unknown fault 'explode'; the faults are lose, corrupt, truncate"),
        ("lose 3", "lose: '3' is not key=value; write it as in: lose [servo=ID] [from=host]"),
        ("lose servos=3", "lose takes no 'servos'; did you mean servo?"),
        ("lose servo=3 servo=4", "lose: servo= is given twice; give it once"),
        ("lose", "lose needs servo=ID (alters a reply) or from=host (alters an instruction)"),
        ("lose servo=3 from=host", "lose needs servo=ID (alters a reply) or from=host"),
        ("lose from=me", "lose: from=me: write from=host for an instruction, servo=ID for a reply"),
        ("lose servo=254", "lose: servo=254: write a whole number from 0 to 253"),
        ("lose servo=x", "lose: servo=x: write a whole number from 0 to 253"),
        ("lose servo=3 at=2", "lose: at=2: write a time such as 2s, 500ms or 100us"),
        ("lose servo=3 at=-2s", "lose: at=-2s: write a time such as 2s, 500ms or 100us"),
        ("lose servo=3 at=2s packet=3", "lose has both at= and packet=; omit one of them"),
        ("delay servo=3", "delay needs by=; write it as in: delay servo=ID by=TIME"),
        ("delay", "delay needs servo= and by="),
        ("silence servo=3 for=0s", "silence: for=0s: write a time longer than 0, such as 500ms"),
        ("voltage volts=nan", "voltage: volts=nan: write a number from 0 to 60, without its unit"),
        ("voltage volts=12V", "voltage: volts=12V: write a number from 0 to 60, without its unit"),
        ("noise data=xy", "noise: data=xy: write 1 to 256 bytes in hex, such as ff00fd"),
        ("noise data=ff size=3", "noise has both data= and size=; omit one of them"),
        ("unplug bus=", "unplug: bus=: write the name of a bus"),
        ("turn servo=2", "turn needs by=; write it as in: turn servo=ID by=ANGLE [for=TIME]"),
        ("turn by=30deg", "turn needs servo="),
        ("turn servo=2 by=1s", "turn: by=1s: write an angle such as 30deg or -0.5rad, of at most 100 turns"),
        ("turn servo=2 by=30", "by=30: write an angle such as 30deg or -0.5rad"),
        ("turn servo=2 by=0deg", "by=0deg: write an angle such as 30deg"),
        ("turn servo=2 by=nandeg", "by=nandeg: write an angle such as 30deg"),
        (
            "turn servo=2 by=36001deg",
            "by=36001deg: write an angle such as 30deg or -0.5rad, of at most 100 turns",
        ),
        ("delay servo=3 by=30deg", "delay: by=30deg: write a time longer than 0, such as 500ms"),
        ("storm faults=3 within=1s kinds=storm", "storm: kinds=storm: unknown kind 'storm' in a storm"),
        ("storm faults=3 within=1s kinds=los", "unknown kind 'los' in a storm; did you mean lose?"),
    ],
)
def test_a_wrong_line_is_refused_with_one_sentence_that_corrects_it(line, message):
    with pytest.raises(InputError) as refused:
        parse_fault(line)
    assert message in str(refused.value)
    assert len(refused.value.sentences) == 1


def test_the_help_has_a_line_for_every_kind():
    assert [line.split()[0].rstrip(":") for line in fault_help()] == list(KINDS)
    delay = "delay servo=ID by=TIME [count=NUMBER] [bus=NAME] [at=TIME] [packet=NUMBER]: the next reply"
    assert fault_help()[3].startswith(delay)
