"""The number of functions and files that a cycle of the loop goes through is bounded."""

import pytest

import cycle_trace

pytestmark = pytest.mark.long

MOST_FUNCTIONS = 27
MOST_FILES = 17
"""24 and 16 were reached, 74 and 30 is where it began; a change that needs more has a reason. Outputs.merge,
with its file, is one way for a controller's commands into the robot's, in the cycle and for a lost joint."""
MOST_OF_COMMAND = 60
"""Of a cycle that takes a command; 50 were reached, 84 is where it began."""


def test_a_steady_cycle_goes_through_few_functions_and_files():
    calls = cycle_trace.steady_cycle()
    files = cycle_trace.by_file(calls)
    names = {name for functions in files.values() for name in functions}
    assert {f"DynamixelHardware.{name}" for name in ("idle", "read_states", "write_goals")} <= names
    assert not any("BusEngine." in name or "Receiver" in name for name in names)  # the kernel reads
    assert len(calls) <= MOST_FUNCTIONS
    assert len(files) <= MOST_FILES


def test_a_cycle_that_takes_a_command_goes_through_few_functions():
    calls = cycle_trace.command_cycle()
    names = {code.co_qualname for code in calls}
    assert {
        "Mailbox.drain_commands",
        "Steering.execute_commands",
        "Manager.dispatch_command",
        "_GroupController.on_command",
    } <= names
    assert len(calls) <= MOST_OF_COMMAND
