"""Rules of the verdict in one table: signal, bound, accused part and remedy of each.

Rooms of the analysis measure: buses in `servos/`, joints in `joints/`, the loop in `causes/`, sensors in
`conduct/`. They report findings with the codes of this table, which is the only place with remedies.
`evidence.py` first decides whether a rule applies: the evidence that it `needs` must be complete.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Flag, auto
from typing import NamedTuple


class Needs(Flag):
    """Conditions that a run must meet before a rule may accuse a part: else the cause can be another."""

    NOTHING = 0
    MACHINE = auto()
    """The machine scheduled the loop on time; otherwise late and missing replies can be its fault."""
    LOOP = auto()  # The loop kept its rate, so goals were on time
    STATES = auto()  # The states of the joint are complete
    INTACT = auto()  # The replies of its bus are intact, so its positions are credible
    LOG = auto()  # No record was lost on the way to the log


_REPLIES = Needs.MACHINE | Needs.LOG
_JOINT = Needs.MACHINE | Needs.LOOP | Needs.STATES | Needs.INTACT | Needs.LOG


class Rule(NamedTuple):
    """Description of one rule of the verdict, for the reference and for the evidence gate."""

    accuses: str  # Accused part in words, for the reference
    signal: str
    bound: str  # Threshold and its reason
    remedy: str = ""
    """Recommended action for the user. Placeholders `{name}`, `{bus}`, `{port}` and `{servo_id}` are
    replaced by those of the accused part."""
    needs: Needs = Needs.NOTHING


RULES: Mapping[str, Rule] = {
    # Lines
    "bus_lost": Rule(
        "bus",
        "loss of the port, reported by the system",
        "once",
        "Check the adapter's plugs and cable; `dmesg` shows what the system reported.",
    ),
    "power_lost": Rule(
        "bus",
        "all servos of a bus rebooted",
        "two servos or more within 0.5 s",
        "Check the supply, its plug and its switch.",
    ),
    "another_host": Rule(
        "bus",
        "instructions from another sender, unrequested replies, or echoes of its own instructions",
        "three instructions, one write of servo items, or ten replies; fewer can be noise",
        "Stop the other program (`fuser {port}` shows it), or unplug the other adapter; for "
        "echoes, check the direction control of the adapter.",
        Needs.LOG,
    ),
    "late_replies": Rule(
        "bus, or the machine if several buses are late at once",
        "delay of replies in addition to wire time, return delay and adapter delay",
        "2 ms, in a tenth of the exchanges or in five replies after the timeout; 12 to 18 ms indicate a "
        "latency timer of 16 ms",
        "Check adapter, driver and USB hub.",
        _REPLIES,
    ),
    "noise": Rule(
        "bus",
        "stray bytes, outside of any packet",
        "after 0.5 % of the instructions, and at least ten: moving a plug causes fewer",
        "Check its shield, ground and termination; unplug one servo after the other to find the source.",
        Needs.LOG,
    ),
    "lossy_line": Rule(
        "bus, or the machine if several buses lose replies at once",
        "losses of all servos of the bus at once, or spread evenly over its servos",
        "five, and half of the losses of the bus; for several buses, 60 % of the losses of each",
        "Check adapter, plugs, termination, ground and the cable's length, or lower baud_rate.",
        _REPLIES,
    ),
    # Servos
    "servo_lost": Rule(
        "servo, or the bus that lost all of its servos at once",
        "lost by the loop: three missing replies in a row, and none for 50 ms",
        "once; for several servos together: within 0.5 s",
        "Check its cable, plugs and supply, also at the joint angle of the loss; `dxlrun scan {port}` "
        "lists the servos with an answer.",
    ),
    "servo_rebooted": Rule(
        "servo",
        "a register that only a reboot resets",
        "once, unless requested by a client",
        "Check its plugs, and whether the supply can give the current.",
    ),
    "torque_lost": Rule(
        "servo",
        "Torque Enable is 0 without a request",
        "once",
        "Look for overload, heat, low voltage: `dxlrun servo {port} {servo_id} get` prints its errors.",
    ),
    "slow_servo": Rule(
        "servo",
        "its reply time without preceding replies and wire time, compared with the other servos of its bus",
        "100 us later in three quarters of its replies; or five replies 300 us later, ten times as many as "
        "all other servos together (by chance once in 1000 runs)",
        "Compare its Return Delay Time and firmware with those of other servos "
        "(`dxlrun servo {port} {servo_id} get`), and check its supply.",
        _REPLIES,
    ),
    "lossy_servo": Rule(
        "servo, or servos that lose replies together",
        "losses of its replies in cycles with answers of other servos of its bus",
        "five, and ten times the median of the other servos",
        "Check its plugs and its cable; exchange the servo if a new cable does not help.",
        _REPLIES,
    ),
    "broken_replies": Rule(
        "servo",
        "stray bytes, outside of any packet, in place of its reply",
        "five, and 70 % of the broken replies of its bus",
        "Unplug it and run `dxlrun scan {port}`: if ID {servo_id} still answers, another servo has this ID; "
        "else check its plugs.",
        Needs.LOG,
    ),
    "servo_error": Rule(
        "servo",
        "the error bits of its replies, its hardware error, and a temperature near its limit or impossible",
        "one reply; 10 deg C below Temperature Limit; 120 deg C",
    ),
    "supply": Rule(
        "bus, or a single servo with less voltage",
        "the lowest voltage of the run, and its time",
        "an input voltage error, or 3 % below the highest while the load is high",
        "Check battery, supply, plugs and the length of the cables.",
        Needs.LOG,
    ),
    # Joints
    "stood_still": Rule(
        "joint",
        "its position while its trajectory moves",
        "at most two ticks in 0.5 s while its trajectory moves by 9 deg, with an error as large",
        "Turn it by hand without torque; compare torque, mode and limits with the robot file "
        "(`dxlrun servo {port} {servo_id} get`).",
        _JOINT,
    ),
    "position_jumped": Rule(
        "joint",
        "two positions within half a second",
        "9 deg apart, and a quarter more than its model can turn in that time",
        "Turn it by hand without torque and watch its position.",
        Needs.INTACT | Needs.LOG,
    ),
    "oscillates": Rule(
        "joint, or the controller if its goals swing",
        "swings around its trajectory that the trajectory does not have",
        "2 deg, six times a second for a second; or ten even swings of 0.6 deg in a row",
        "Lower the gains of servo and controller; look for play in gears and horn.",
        _JOINT,
    ),
    "follows_worse": Rule(
        "joint",
        "error, lag and load compared with earlier values, at the same places and in the same direction",
        "9 deg of error for a second; or 4.6 deg and three times the earlier error; or a change by 2 deg or "
        "an eighth of the torque, three times the change of any other joint",
        "Turn it by hand without torque, and compare gains and limits with the robot file "
        "(`dxlrun servo {port} {servo_id} get`).",
        _JOINT,
    ),
    # Loop
    "busy_machine": Rule(
        "machine",
        "seconds without an idle core, with a core taken by the host of a virtual machine, with the loop "
        "waiting for a core, or without a sample of the machine",
        "three seconds and a tenth of the run",
    ),
    "own_work": Rule(
        "loop, or the slow controller or bus",
        "time of long cycles beyond their planned exchanges",
        "half of the excess of all long cycles, in at least three cycles",
        "Make it faster, give it a lower rate (`{{rate: ...}}`), or lower the rate of the loop.",
        Needs.MACHINE,
    ),
    "skipped": Rule(
        "loop",
        "skipped periods",
        "more than `tolerated_skips` of all periods; shorter runs count as 2 s",
    ),
    # Sensors and devices
    "silent": Rule(
        "device or sensor",
        "lost by the loop",
        "once",
        "Check its cable, plugs and supply; until it returns, its states keep their last values.",
    ),
    "frozen": Rule(
        "device or sensor",
        "identical values after trembling ones",
        "a second, and ten times the longest time before",
        "Its values are old: check its sensor, and switch it off and on.",
        Needs.LOG,
    ),
    # The run: these accuse no part
    "run_failed": Rule("", "a process of the run failed, or the loop never ran a cycle", "once"),
    "fell": Rule(
        "", "the direction of gravity in the frame of the IMU", "60 deg from its direction at the start"
    ),
    "goal_missed": Rule(
        "", "a goal of a played motion", "missed, aborted, or not reached before the run ended"
    ),
    "errors_logged": Rule("", "errors without another rule", "one"),
    "log_not_whole": Rule("", "missing or unreadable records", "one"),
    "invalid_states": Rule("", "invalid states of a joint", "1 % of the cycles, and three"),
    "kept_rate": Rule("", "skipped periods, and the wake-up latency of the loop", "always reported"),
    "steered": Rule("", "requests of clients", "one"),
    "replies": Rule("", "servos without losses, and the three with most missing replies", "always reported"),
}
"""All rules by the code of their findings: buses first, then servos, supply, joints, the loop, sensors and
devices, and the run."""
