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
        "the system reports that the port is gone",
        "once",
        "Check the adapter's plugs and cable; `dmesg` shows what the system reported.",
    ),
    "power_lost": Rule(
        "bus",
        "all servos of a bus rebooted",
        "within 0.5 s, two servos or more",
        "Check the supply, its plug and its switch.",
    ),
    "another_host": Rule(
        "bus",
        "instructions on the line that this run did not send, replies that it did not ask for, or its own "
        "instructions that come back",
        "three instructions (of 256 checksums of noise one fits), one that writes items of a servo, or ten "
        "replies",
        "Stop the other program (`fuser {port}` shows it), or unplug the other adapter; where own "
        "instructions come back, check what switches the adapter's direction.",
        Needs.LOG,
    ),
    "late_replies": Rule(
        "bus, or the machine where several buses are late at once",
        "how much later replies come than wire, return delay and adapter need",
        "2 ms, in a tenth of the exchanges or after they were given up; 12 to 18 ms are a timer of 16 ms",
        "Check adapter, driver and USB hub.",
        _REPLIES,
    ),
    "noise": Rule(
        "bus",
        "bytes that belong to no packet",
        "after 0.5 % of the instructions, and ten: a plug that is moved makes fewer",
        "Check its shield, ground and termination; unplug one servo after the other to find one that sends "
        "unasked.",
        Needs.LOG,
    ),
    "lossy_line": Rule(
        "bus, or the machine where several buses lose replies at once",
        "occasions at which no servo of a bus answered, and those that are spread evenly over its servos",
        "five, and half of the occasions of the bus; of several buses 60 % of theirs",
        "Check adapter, plugs, termination, ground and the cable's length, or lower baud_rate.",
        _REPLIES,
    ),
    # Servos
    "servo_lost": Rule(
        "servo, or the bus that lost all of its servos at once",
        "the loop lost it: no reply to three reads, and to those of half a second",
        "once; together with others: within 0.5 s",
        "Check its cable, plugs and supply, at that angle, too; `dxlrun scan {port}` shows which servos "
        "answer.",
    ),
    "servo_rebooted": Rule(
        "servo",
        "a register that only a reboot resets",
        "once, unless a client asked for it",
        "Check its plugs, and whether the supply can give the current.",
    ),
    "torque_lost": Rule(
        "servo",
        "Torque Enable is 0 without a request",
        "once",
        "Look for overload, heat, low voltage: `dxlrun servo {port} {servo_id} get` has its errors.",
    ),
    "slow_servo": Rule(
        "servo",
        "its own part of its reply time, compared with the other servos of its bus",
        "100 us later in three quarters of its replies; or five replies 300 us later, ten times as many as "
        "all others have (by chance once in 1000 runs)",
        "Compare its Return Delay Time and firmware with those of the others "
        "(`dxlrun servo {port} {servo_id} get`), and check its supply.",
        _REPLIES,
    ),
    "lossy_servo": Rule(
        "servo, or servos that lose replies together",
        "occasions at which it did not answer, and others of its bus that were asked in the same cycle did",
        "five, and ten times as many as another servo has in the median",
        "Check its plugs and its cable; exchange the servo where a new cable does not help.",
        _REPLIES,
    ),
    "broken_replies": Rule(
        "servo",
        "bytes that belong to no packet where its reply is due",
        "five, and 70 % of those of its bus",
        "Unplug it and run `dxlrun scan {port}`: if ID {servo_id} still answers, two servos have it; else "
        "check its plugs.",
        Needs.LOG,
    ),
    "servo_error": Rule(
        "servo",
        "the error bits of its replies, its hardware error, and a temperature that is near its limit or that "
        "it cannot have",
        "one reply; 10 deg C below Temperature Limit; 120 deg C",
    ),
    "supply": Rule(
        "bus, or the servo that alone has less voltage",
        "the lowest voltage of the run, and when",
        "an input voltage error, or 3 % below the highest while the load is high",
        "Check battery, supply, plugs and the length of the cables.",
        Needs.LOG,
    ),
    # Joints
    "stood_still": Rule(
        "joint",
        "its position while its trajectory moves",
        "two ticks in 0.5 s while it is to move by 9 deg, and it is as far behind",
        "Turn it by hand without torque; compare torque, mode and limits with the robot file "
        "(`dxlrun servo {port} {servo_id} get`).",
        _JOINT,
    ),
    "position_jumped": Rule(
        "joint",
        "two positions in half a second",
        "9 deg and a quarter further apart than its model turns in that time",
        "Turn it by hand without torque and watch its position.",
        Needs.INTACT | Needs.LOG,
    ),
    "oscillates": Rule(
        "joint, or the controller whose goals swing",
        "swings around its trajectory that this does not have itself",
        "2 deg, six times a second for a second; 0.6 deg where ten of them follow evenly",
        "Lower the gains of servo and controller; look for play in gears and horn.",
        _JOINT,
    ),
    "follows_worse": Rule(
        "joint",
        "error, lag and load compared with earlier, at the same places and in the same direction",
        "9 deg from its goal for a second; three times the error of before, and 4.6 deg; 2 deg more, or an "
        "eighth of its torque, and three times what any other joint shows",
        "Turn it by hand without torque, and compare gains and limits with the robot file "
        "(`dxlrun servo {port} {servo_id} get`).",
        _JOINT,
    ),
    # Loop
    "busy_machine": Rule(
        "machine",
        "seconds in which no core was idle, the host kept one back, or the loop waited for one; a sampler "
        "that was silent",
        "three seconds and a tenth of the run",
    ),
    "own_work": Rule(
        "loop, or the controller or bus that took the time",
        "what long cycles took beyond their planned exchanges",
        "half of that time, in three cycles; a single stall of a machine is not enough",
        "Make it faster, give it a lower rate (`{{rate: ...}}`), or lower the loop's.",
        Needs.MACHINE,
    ),
    "skipped": Rule("loop", "skipped periods", "more than `tolerated_skips` of the periods of two seconds"),
    # Sensors and devices
    "silent": Rule(
        "device or sensor",
        "the loop lost it",
        "once",
        "Check its cable, plugs and supply; until it is back, its states keep their last values.",
    ),
    "frozen": Rule(
        "device or sensor",
        "values that are the same to the bit, and trembled before",
        "a second, and ten times as long as ever before",
        "Its values are old: look at what it measures with, and switch it off and on.",
        Needs.LOG,
    ),
    # The run: these accuse no part
    "run_failed": Rule("", "a process of the run failed, or the loop never ran a cycle", "once"),
    "fell": Rule("", "the direction of gravity in the frame of the IMU", "60 deg from that at the start"),
    "goal_missed": Rule(
        "", "a goal of a played motion", "missed, aborted, or not reached before the run ended"
    ),
    "errors_logged": Rule("", "errors that no other rule is about", "one"),
    "log_not_whole": Rule("", "records that are missing or cannot be read", "one"),
    "invalid_states": Rule("", "states of a joint that were not valid", "1 % of the cycles, and three"),
    "kept_rate": Rule("", "skipped periods, and how late the loop woke", "always told"),
    "steered": Rule("", "requests of clients", "one"),
    "replies": Rule("", "servos that answered, and the worst three of those that did not", "always told"),
}
"""All rules by the code of their findings: buses first, then servos, supply, joints, the loop, sensors and
devices, and the run."""
