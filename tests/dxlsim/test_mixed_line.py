"""Servos of both protocols on one line: why a bus has one protocol (docs/explanation/bus.md)."""

import pytest
from tests.kit.campaigns import campaign
from tests.kit.mixed_line import MixedBus
from tests.kit.packets import packet1, packet2

from dxlsim.bus.ledger import Ledger
from dxlsim.simulation_plan import ServoConfig

AX_IDS, X_ID, MS = range(1, 9), 11, 1_000_000
STATE = ("present_load", "present_velocity", "present_position")
READ_STATE = packet2(X_ID, 2, bytes((126, 0, 10, 0)))
"""Read of an XL430 in a cycle: load (2 bytes), velocity (4), position (4)."""


def mixed(ledger: Ledger, shown: dict[str, int], *ax_ids: int) -> MixedBus:
    """Return a line of AX-12A and an XL430 whose registers show some values, which may change later."""
    servos = [ServoConfig(servo_id, "AX-12A", 2.0) for servo_id in ax_ids]
    bus = MixedBus([*servos, ServoConfig(X_ID, "XL430-W250", 2.0, 0)], ledger)
    bus.servo(X_ID).show_live({name: lambda name=name: shown[name] for name in shown})
    return bus


@pytest.mark.parametrize(
    ("state", "sent", "found", "becomes", "error"),
    [
        pytest.param(
            (-162, -27, 50_529_281),
            "ff ff fd 00 0b 0e 00 55 00 5e ff e5 ff ff ff 01 04 03 03 54 a0",
            "ff ff 01 04 03 03 54 a0",
            0x54,
            0,
            id="a wheel after 12,336 turns writes ID (3)",
        ),
        pytest.param(
            (-162, -27, 393_975),
            "ff ff fd 00 0b 0e 00 55 00 5e ff e5 ff ff ff f7 02 06 00 0e 06",
            "ff ff f7 02 06 00",
            1,
            0,
            id="a continuous joint after 96 turns resets to factory settings",
        ),
        pytest.param(
            (-110, -58, 769),
            "ff ff fd 00 0b 0e 00 55 00 92 ff c6 ff ff ff 01 03 00 00 fb 95",
            "ff ff 01 03 00 00 fb",
            1,
            0x40,
            id="a joint at 68 deg sends an undefined instruction",
        ),
    ],
)
def test_ax_executes_what_the_status_of_an_xl430_contains(state, sent, found, becomes, error):
    ledger, ax_id = Ledger(), bytes.fromhex(found)[2]
    bus = mixed(ledger, dict(zip(STATE, state, strict=True)), ax_id)
    ax = bus.servo(ax_id)
    bus.receive_bytes(READ_STATE, 0)
    assert bus.drain_bytes(MS).hex(" ") == sent
    assert found in sent
    bus.drain_bytes(3 * MS)
    answers = [entry.data for entry in ledger.entries if (entry.bus, entry.direction) == ("1", "out")]
    assert (ax.servo_id, answers) == (becomes, [packet1(ax_id, error)]), "nobody has addressed the AX-12A"


@pytest.mark.parametrize(
    ("turns", "least_missed"), [((0, 4095), 0.3), ((-1_048_575, 1_048_575), 0.7)], ids=["arm", "continuous"]
)
@campaign(ci=1000, night=100_000, release=1_000_000)
def test_ax_misses_instructions_after_the_status_of_an_xl430(turns, least_missed, amount, chance):
    """The host reads an XL430 in a random state, and then an AX-12A, `amount` times."""
    shown = dict.fromkeys(STATE, 0)
    bus = mixed(Ledger(keep=False), shown, *AX_IDS)
    reads = {servo_id: packet1(servo_id, 2, 36, 6) for servo_id in AX_IDS}
    missed = changed = 0
    for t_ns in range(0, int(amount) * 4 * MS, 4 * MS):
        state = chance.randint(-1000, 1000), chance.randint(-265, 265), chance.randint(*turns)
        shown.update(zip(STATE, state, strict=True))
        bus.receive_bytes(READ_STATE, t_ns)
        bus.drain_bytes(t_ns + MS)
        bus.drain_bytes(t_ns + 2 * MS)  # an answer of an AX-12A to the status
        servo_id = chance.choice(AX_IDS)
        bus.receive_bytes(reads[servo_id], t_ns + 2 * MS)
        missed += not bus.drain_bytes(t_ns + 4 * MS).startswith(bytes((0xFF, 0xFF, servo_id, 8)))
        for ax, servo_id in zip(bus.kinds[0].servos, AX_IDS, strict=True):
            if ax.servo_id != servo_id:
                changed += 1
                ax.poke("id", servo_id)
    obeyed = sum(ax.counts.received for ax in bus.kinds[0].servos) - (amount - missed)
    print(
        f"{amount:,} reads, {missed:,} missed; {obeyed:,} other instructions obeyed, {changed} changed an ID"
    )
    assert least_missed < missed / amount < 0.9
