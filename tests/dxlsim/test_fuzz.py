"""Whatever a host sends, a bus does not fall over, and whatever it answers can be trusted.

The campaign of 1,000,000 strings is bench/fuzz_simulation.py; a seeded sample of it runs here.
"""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.kit.packets import crc, packet1, packet2

from bench import fuzz_simulation
from dxlsim.wire.servo_protocol1 import ErrorBit

LIKE_PACKETS = st.sampled_from([0xFF, 0xFD, 0xFE, 0x00, 0x01, 0x02, 0x03, 0x55, 0x74, 0x82, 0x83, 0x92])
NOISE = st.lists(LIKE_PACKETS | st.integers(0, 255), max_size=60).map(bytes)
SMALL = settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],  # each example makes a bus of its own
)


def check1(received: bytes) -> None:
    """Fail when the bytes are anything but status packets with good checksums."""
    while received:
        assert received[:2] == b"\xff\xff"
        packet, received = received[: 4 + received[3]], received[4 + received[3] :]
        assert sum(packet[2:]) & 0xFF == 0xFF


def check2(received: bytes) -> None:
    """Fail when the bytes are anything but status packets with good CRCs."""
    while received:
        assert received[:4] == b"\xff\xff\xfd\x00"
        size = 7 + int.from_bytes(received[5:7], "little")
        packet, received = received[:size], received[size:]
        assert packet[7] == 0x55
        assert crc(packet[:-2]) == int.from_bytes(packet[-2:], "little")


INSTRUCTIONS = st.sampled_from([1, 2, 3, 4, 5, 8, 0x10, 0x20, 0x82, 0x83, 0x8A, 0x92, 0x93, 0x9A, 0x77])
"""Not the factory reset: after it the servo listens elsewhere."""
PACKETS = st.tuples(st.sampled_from([1, 0xFE]), INSTRUCTIONS, NOISE)


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_random_and_mutated_strings_do_no_harm_and_get_no_false_answer(protocol):
    tally = fuzz_simulation.campaign(protocol, 2_000, seed=7)
    assert tally.strings == 2_000
    assert tally.silent > 50
    assert tally.answers > 50


@pytest.mark.parametrize("model", ["AX-12A", "MX-64"])
@SMALL
@given(st.lists(NOISE | PACKETS, max_size=5))
def test_noise_and_any_packet_of_protocol_1(make_line, model, pieces):
    line = make_line((1,), model)
    for piece in pieces:
        line.ports.ports[0].write_packet(
            piece if isinstance(piece, bytes) else packet1(piece[0], piece[1], *piece[2])
        )
        check1(line.receive())


@pytest.mark.parametrize("model", ["XM430-W350", "XL-320", "YM070-210-M001", "PH42-020-S300"])
@SMALL
@given(st.lists(NOISE | PACKETS, max_size=5))
def test_noise_and_any_packet_of_protocol_2(make_line2, model, pieces):
    line = make_line2((1,), model)
    line.bus.absent = "slot"
    for piece in pieces:
        line.ports.ports[0].write_packet(piece if isinstance(piece, bytes) else packet2(*piece))
        received = line.receive()
        if isinstance(piece, bytes) or piece[1] not in (0x8A, 0x9A):
            check2(received)
        line.wait(0.2)


@pytest.mark.parametrize("answers", [False, True])
@SMALL
@given(st.binary(max_size=20), st.integers(0, 7), st.integers(0, 100))
def test_a_broken_crc_is_never_obeyed(make_line2, answers, parameters, bit, place):
    line = make_line2((1,))
    line.servo().answers_damaged = answers
    before = bytes(line.read_bytes(1, 0, 120))
    packet = bytearray(packet2(1, 0x03, bytes((64, 0)) + parameters))
    packet[7 + place % (len(packet) - 7)] ^= 1 << bit
    line.ports.ports[0].write_packet(packet)
    assert line.statuses() == ([(1, 3, b"")] if answers else [])
    line.wait(0.1)
    assert line.read_bytes(1, 0, 120) == before


@pytest.mark.parametrize("answers", [False, True])
@SMALL
@given(st.binary(max_size=20), st.integers(0, 7), st.integers(0, 100))
def test_a_broken_checksum_is_never_obeyed(make_line, answers, parameters, bit, place):
    line = make_line((1,))
    line.servo().answers_damaged = answers
    packet = bytearray(packet1(1, 0x03, 24, *parameters))
    packet[4 + place % (len(packet) - 4)] ^= 1 << bit
    line.ports.ports[0].write_packet(packet)
    assert line.receive() == (packet1(1, ErrorBit.CHECKSUM) if answers else b"")
    assert line.read(1, 24, 1) == 0
