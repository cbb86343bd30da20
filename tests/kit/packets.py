"""Packets put together by hand: nothing of the runtime's or of the simulation's packet code is used."""


def _crc_of(value: int) -> int:
    for _ in range(8):
        value = value << 1 ^ (0x18005 if value & 0x8000 else 0)
    return value


_CRC = tuple(_crc_of(byte << 8) for byte in range(256))


def crc(data: bytes) -> int:
    """Return the CRC-16 of Protocol 2.0 (polynomial 0x8005), as a textbook has it."""
    value = 0
    for byte in data:
        value = (value << 8 & 0xFF00) ^ _CRC[value >> 8 ^ byte]
    return value


def packet1(servo_id: int, *body: int) -> bytes:
    """Return a packet of Protocol 1.0 around instruction and parameters, or error and parameters."""
    inner = bytes((servo_id, len(body) + 1, *body))
    return b"\xff\xff" + inner + bytes((~sum(inner) & 0xFF,))


def packet2(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return a packet of Protocol 2.0, stuffed."""
    body = (bytes((instruction,)) + parameters).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    whole = b"\xff\xff\xfd\x00" + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return whole + crc(whole).to_bytes(2, "little")
