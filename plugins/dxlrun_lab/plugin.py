"""The verbs that measure robots, and those that run a log again, by the same hooks as any other package."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl

_PLACE = "dxlrun_lab.commands"


@hookimpl
def dxlrun_contract() -> int:
    """Return the contract that this package was written for: the one it is published with."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the verbs that run something: a log again, or a measurement."""
    return (
        Command(
            "replay",
            f"{_PLACE}.replay:replay",
            "Run the controllers of a log again: on its inputs; commands and goals are compared bit for bit.",
            "Logs",
        ),
        Command(
            "convert",
            f"{_PLACE}.convert:convert",
            "Write a recorded motion to a new motion file: of a log, a foreign MCAP file or a ROS 2 bag.",
            "Logs",
        ),
        Command(
            "bench",
            f"{_PLACE}.bench:bench",
            "Measure a robot on this machine.",
            "Experiments",
        ),
        Command(
            "latency",
            f"{_PLACE}.latency:latency",
            "Measure how late this machine wakes a loop up: one that waits as a run's; no robot is used.",
            "Experiments",
        ),
        Command(
            "characterize",
            f"{_PLACE}.characterize:characterize",
            "Measure what servos can do: response, speed, dead band, highest rate, longest gap of commands.",
            "Servos",
        ),
        Command(
            "experiment",
            f"{_PLACE}.tracking:experiment",
            "Repeat an experiment of the thesis on this machine.",
            "Experiments",
        ),
        Command(
            "sweep",
            f"{_PLACE}.sweep:sweep",
            "Run a motion at many values of the robot file: on virtual time; each run is scored.",
            "Experiments",
        ),
        Command(
            "identify",
            f"{_PLACE}.identify:identify",
            "Identify servos: torque constant, resistance, inertia, friction, gain, delay; 95 % intervals.",
            "Servos",
        ),
    )
