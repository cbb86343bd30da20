"""Whatever a host sends, a bus does not fall over, and whatever it answers can be trusted.

The campaign of 1,000,000 strings is bench/fuzz_simulation.py; a seeded sample of it runs here.
"""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.simulated_line import Line, split_statuses

from bench import fuzz_simulation

LIKE_PACKETS = st.sampled_from([0xFF, 0xFD, 0xFE, 0x00, 0x01, 0x02, 0x03, 0x55, 0x74, 0x82, 0x83, 0x92])
NOISE = st.lists(LIKE_PACKETS | st.integers(0, 255), max_size=60).map(bytes)
INSTRUCTIONS = st.sampled_from([1, 2, 3, 4, 5, 8, 0x10, 0x20, 0x82, 0x83, 0x8A, 0x92, 0x93, 0x9A, 0x77])
"""Not the factory reset: after it the servo listens elsewhere."""
PACKETS = st.tuples(st.sampled_from([1, 0xFE]), INSTRUCTIONS, NOISE)
SMALL = settings(max_examples=60, deadline=None)


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_random_and_mutated_strings_do_no_harm_and_get_no_false_answer(protocol):
    tally = fuzz_simulation.campaign(protocol, 2_000, seed=7)
    assert tally.strings == 2_000
    assert tally.silent > 50
    assert tally.answers > 50


@pytest.mark.parametrize(
    "model", ["AX-12A", "MX-64", "XM430-W350", "XL-320", "YM070-210-M001", "PH42-020-S300"]
)
@SMALL
@given(st.lists(NOISE | PACKETS, max_size=5))
def test_noise_and_any_packet_get_whole_answers(model, pieces):
    line = Line(model, 1)
    line.bus.absent = "slot"
    for piece in pieces:
        line.send(piece if isinstance(piece, bytes) else line.packet(*piece))
        received = line.receive()
        if isinstance(piece, bytes) or piece[1] not in (0x8A, 0x9A):  # fast forms share a status
            split_statuses(received, line.protocol)
        line.wait(0.2 if line.protocol == 2.0 else 0.0)


@pytest.mark.parametrize("model", ["AX-12A", "XM430-W350"])
@pytest.mark.parametrize("answers", [False, True])
@SMALL
@given(st.binary(max_size=20), st.integers(0, 7), st.integers(0, 100))
def test_an_instruction_with_a_broken_checksum_is_never_obeyed(model, answers, parameters, bit, place):
    line = Line(model, 1)
    line.servo().answers_damaged = answers
    size, header = (49, 4) if line.protocol == 1.0 else (120, 7)
    before = line.read_bytes(0, size)
    packet = bytearray(line.packet(1, 0x03, line.word(line.item("torque_enable").address) + parameters))
    packet[header + place % (len(packet) - header)] ^= 1 << bit
    line.send(bytes(packet))
    assert line.statuses() == ([(1, 0x10 if line.protocol == 1.0 else 3, b"")] if answers else [])
    line.wait(0.1)
    assert line.read_bytes(0, size) == before
