"""Devices while the line and everything on it fails: no state is old or another's, and servos pay nothing.

A storm is 200 cycles and 160 to recover; CI runs two, `pytest --campaign=release FILE` 400.
"""

from functools import partial

import numpy as np
from tests.kit.campaigns import campaign
from tests.kit.rigs import make_plan, start_rig

from dxlrun.channels.event_records import EventCode
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript

from .test_devices import ALL, NONE, SERVOS, device, devices

LOSSES = ("lose servo={id}", "truncate servo={id} keep={keep}", "corrupt servo={id}")
WORSE = ("delay servo={id} by={by}us", "duplicate servo={id}", "noise size={keep}", "lose from=host")
ITEMS = (("speed",), ("speed", "rate"), ("speed", "led"), ("speed", "pwm", "warm", "led"))


def storm(rig, chance, ids, kinds):
    """Do something to the line, to a device, or to a servo."""
    servo_id = chance.choice(ids)
    if chance.random() < 0.3:
        rig.buses[0].at(rig.clock.now_ns(), lambda: node(rig, servo_id).silence(chance.random() < 0.4))
        return
    if not (rig.sources.valid.all() and rig.states.valid.all()):
        return  # it waits for a reply, and would still wait at the end
    text = chance.choice(kinds).format(
        id=servo_id, keep=chance.randrange(4, 10), by=chance.randrange(100, 3000)
    )
    now_ns = rig.clock.now_ns()
    script = FaultScript([parse_fault(text)], chance.randrange(1000))
    script.attach(rig.buses, start_ns=now_ns, now_ns=now_ns)


def node(rig, servo_id):
    return rig.servo(servo_id)


@campaign(ci=2, night=50, release=400)
def test_a_storm_makes_no_state_old_and_costs_the_servos_nothing(number, chance):
    only_devices = number % 2 == 0
    capabilities = chance.choice((ALL, NONE, '["sync_read"]', '["bulk_read"]'))
    wanted = [chance.choice(ITEMS) for _ in range(chance.randrange(1, 5))]
    plan = make_plan(
        SERVOS,
        protocol=2.0,
        model="XM430-W350",
        devices=devices(*wanted, capabilities=capabilities),
        fast=chance.random() < 0.5,
        return_delay_ns=chance.choice((0, 250_000)),
    )
    rig = start_rig(plan)
    rig.packets.list.clear()
    rig.ledger.entries.clear()
    ids = [each.servo_id for each in plan.devices] + [] * only_devices + list(SERVOS) * (not only_devices)
    kinds = LOSSES if only_devices else (*LOSSES, *WORSE)
    columns = {each.source: each.blocks[-1].fields[-1].column for each in plan.devices}
    ages = np.zeros(len(wanted), dtype=np.int64)

    def run_cycle(cycle):
        for index in range(len(wanted)):
            device(rig, index).registers["profile_velocity"] = 100 * cycle + index
        rig.goals.position[:] += 0.001 * (-1) ** cycle
        try:
            rig.cycle()
        except AssertionError:  # a cycle that is late: only a servo may make it so
            assert not only_devices
            rig.clock.wait_until(rig.clock.now_ns() + 1_000_000)
        for row, column in columns.items():
            if rig.sources.valid[row]:
                assert rig.sources.values[column] == 100 * cycle + row
                assert 0 <= rig.sources.age_ns[row] < 12_000_000
            else:
                assert rig.sources.age_ns[row] > ages[row]
        ages[:] = rig.sources.age_ns
        if only_devices:
            assert rig.states.valid.all()

    for cycle in range(200):
        for _ in range(chance.choice((0, 0, 0, 1, 2))):
            storm(rig, chance, ids, kinds)
        run_cycle(cycle)
    for servo_id in ids:  # behind what the storm has still to do
        rig.buses[0].at(rig.clock.now_ns(), partial(node(rig, servo_id).silence, on=False))
    for cycle in range(200, 360):
        run_cycle(cycle)
    assert rig.sources.valid.all()
    assert rig.states.valid.all()
    assert rig.packets.sent() == rig.into_bus()
    assert rig.packets.received() == rig.out_of_bus()
    if only_devices:
        assert set(rig.events.sources(EventCode.READ_LOST)) <= {one.name for one in plan.devices}
