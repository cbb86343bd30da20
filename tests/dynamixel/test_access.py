"""Access to a servo's items: what is read and written, and what is said where that fails."""

import pytest
from tests.kit.rigs import make_x

from dxlrun.dynamixel.servo.item_access import access_servo
from dxlwire.control_table import decoded, find_table
from dxlwire.transaction import Reply, TransactionOutcome

PLAN = make_x((11,))
ONE = access_servo(PLAN, PLAN.servos[0])
READ, WRITE = 2, 3


def played(program, *answers):
    """Run a program on answers, the last one again and again: data, or an outcome without; return its result,
    and of each packet its instruction and address."""
    sent, left = [], list(answers)
    try:
        request = next(program)
        while True:
            sent.append((request.packet[7], int.from_bytes(request.packet[8:10], "little")))
            answer = left.pop(0) if len(left) > 1 else left[0]
            failed = isinstance(answer, TransactionOutcome)
            reply = Reply(
                answer if failed else TransactionOutcome.OK, 7, b"" if failed else answer, 0, 0, False
            )
            request = program.send(reply)
    except StopIteration as end:
        return end.value, sent


@pytest.mark.parametrize(
    ("answers", "problem"),
    [
        ((b"", b"\x10"), ""),
        (
            (b"", b"\x03", b"", b"\x03", b"", b"\x03", b"\0"),
            "has Operating Mode (11) = 3 after 16 was written",
        ),
        ((b"", TransactionOutcome.TIMEOUT), "did not answer when Operating Mode (11) was read back"),
        (
            (b"", b"\x03", b"", b"\x03", b"", b"\x03", b"\1"),
            "holds torque, so Operating Mode (11) = 16 in its EEPROM was not written: switch its torque off "
            "first",
        ),
    ],
)
def test_an_item_counts_as_written_when_it_is_read_back(answers, problem):
    found, sent = played(ONE.write_item("operating_mode", 16), *answers)
    assert found == problem
    assert sent[:2] == [(WRITE, 11), (READ, 11)]


def test_a_refused_write_is_not_read_back():
    problem, sent = played(ONE.write_item("operating_mode", 16), TransactionOutcome.REFUSED)
    assert problem.startswith("refuses Operating Mode (11) = 16: access error")
    assert (READ, 11) not in sent


def test_a_refused_goal_names_the_register_that_bounds_it():
    hundred, more = (100).to_bytes(2, "little"), (900).to_bytes(2, "little")
    problem, sent = played(ONE.write_item("goal_pwm", -885), TransactionOutcome.REFUSED, hundred)
    assert problem.startswith("refuses Goal PWM (100) = -885: ")
    assert problem.endswith("; raise its PWM Limit (36) from 100 to 885 or more")
    assert sent == [(WRITE, 100), (READ, 36)]
    problem, _ = played(ONE.write_item("goal_pwm", 885), TransactionOutcome.REFUSED, more)
    assert "PWM Limit" not in problem


def test_items_are_read_side_by_side_and_none_counts_where_one_does_not_come():
    names = ("position_d_gain", "position_i_gain", "torque_enable")
    found, sent = played(ONE.read_items(names), b"\1\0", b"\1\0\2\0")
    assert found == {"torque_enable": 1, "position_d_gain": 1, "position_i_gain": 2}
    assert sent == [(READ, 64), (READ, 80)]
    found, _ = played(ONE.read_items(names), b"\1\0", TransactionOutcome.TIMEOUT)
    assert found is None


def test_only_items_that_lie_whole_in_the_bytes_are_decoded():
    items = find_table("XM430-W350", 2.0).items
    assert decoded(items.values(), 80, b"\1\0\2\0\3") == {"position_d_gain": 1, "position_i_gain": 2}
    assert decoded([items["position_d_gain"]], 81, b"\0\0\0") == {}
