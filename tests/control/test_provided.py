"""States that a controller provides: what reads them, and how old and how valid they are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.kit.loops import PERIOD_NS, on_update

NAN = math.nan


@pytest.fixture
def seen(robot):
    """Run a controller that provides these pairs, one a cycle, beside one that reads them.

    Returns what that one read of both and of the age, and what the record had: values, validity and age.
    """

    def run(*pairs):
        read, shown = [], []

        def provide(context, time_ns, _):
            context.provided[:] = pairs[min(round(time_ns / PERIOD_NS), len(pairs) - 1)]

        def look(context, *_):
            read.append(context.reads.tolist())
            sources = robot.record.sources
            shown.append((sources.values.tolist(), bool(sources.valid[0]), int(sources.age_ns[0])))

        names, none = ("imu/a", "imu/b", "imu/age"), {"joints": (), "command": ()}
        robot.script("reader", on_update(look), reads=names, **none)  # in the file before the other one
        robot.script("imu", on_update(provide), provides=("a", "b"), **none)
        assert robot.run(len(pairs)).reason == "stopped"
        return read, shown

    return run


def test_what_is_provided_is_read_in_the_same_cycle(seen):
    read, shown = seen((1.0, 2.0), (3.0, 4.0))
    assert read == [[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]]
    assert shown == [([1.0, 2.0], True, 0), ([3.0, 4.0], True, 0)]


def test_before_the_first_values_there_are_none_and_no_age(seen):
    read, shown = seen((NAN, NAN), (1.0, 2.0))
    np.testing.assert_array_equal(read, [[NAN, NAN, NAN], [1.0, 2.0, 0.0]])
    assert shown[0][1:] == (False, -1)


def test_nothing_new_keeps_the_values_which_grow_older(seen):
    read, shown = seen((1.0, 2.0), (NAN, NAN), (NAN, NAN), (5.0, 6.0))
    assert read == [[1.0, 2.0, 0.0], [1.0, 2.0, 0.02], [1.0, 2.0, 0.04], [5.0, 6.0, 0.0]]
    assert [valid for _, valid, _ in shown] == [True, False, False, True]


@pytest.mark.parametrize("wrong", [NAN, math.inf])
def test_one_that_is_not_known_makes_all_of_them_invalid(seen, wrong):
    read, shown = seen((1.0, 2.0), (3.0, wrong), (math.inf, NAN))
    np.testing.assert_array_equal(read[1:], [[3.0, wrong, 0.02], [math.inf, NAN, 0.04]])
    assert [valid for _, valid, _ in shown] == [True, False, False]
