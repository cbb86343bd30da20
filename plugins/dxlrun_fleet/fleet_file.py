"""Fleet file, the argument of `dxlrun fleet`: addresses of robots, and the agents that start them.

The Form classes describe the YAML file for validation; Agent and Fleet are its parsed content.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import AfterValidator

from dxlrun import InputError
from dxlrun.tooling.files import Form, key, read_yaml, suggestion, validation_error
from dxlrun.tooling.live import Address, ListedAddress


def _line(text: str) -> str:
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise validation_error(
            f"{text!r} is not a command line: {error}", "write arguments of `dxlrun`"
        ) from error
    if not words or not words[0].endswith((".yaml", ".yml")):
        raise validation_error(f"{text!r} does not begin with a robot file", "write ROBOT.yaml first")
    return text


class AgentForm(Form):
    """Entry of an agent in the file: a computer where `dxlrun fleet FILE --serve NAME` starts robots."""

    address: ListedAddress = key("Address of the agent.", "lab3:7659")
    starts: dict[str, Annotated[str, AfterValidator(_line)]] = key(
        "Arguments of `dxlrun` for each robot; paths are relative to this file's directory.",
        "{torso: robots/bioloid_torso.yaml port:=/dev/ttyUSB0 --listen 0.0.0.0:7660}",
    )


class FleetForm(Form):
    """Top level of the file: robots, and the agents that start them."""

    robots: dict[str, ListedAddress] = key(
        "Address of each robot, by the name in its certificate.", "{torso: lab3:7660}"
    )
    agents: dict[str, AgentForm] = key("Agents, by the names in their certificates.", "{lab3: {}}", {})


class Agent(NamedTuple):
    """Agent of a fleet file: the address where it listens, and the robots that it starts."""

    address: Address
    starts: dict[str, tuple[str, ...]]
    """Arguments of `dxlrun` that start each robot, by its name: the robot file and what follows it."""


class Fleet(NamedTuple):
    """Content of a fleet file: robots and agents by name."""

    robots: dict[str, Address]
    agents: dict[str, Agent]
    directory: Path
    """Directory of the fleet file, to which the paths of robot files are relative."""

    def agent_of(self, robot: str) -> Agent:
        """Return the agent that starts a robot.

        Raises:
            InputError: None of the agents starts it.
        """
        for agent in self.agents.values():
            if robot in agent.starts:
                return agent
        raise InputError(f"no agent starts {robot}; add it to `starts` of an agent in the fleet file")

    def require_robots(self, names: tuple[str, ...]) -> None:
        """Raise InputError for the first name that is not a robot of the fleet file."""
        for name in names:
            if name not in self.robots:
                raise InputError(
                    f"the fleet file has no robot {name}; {suggestion(name, tuple(self.robots))}"
                )


def read_fleet(path: Path) -> Fleet:
    """Read and validate a fleet file.

    Raises:
        InputError: The file has mistakes; the message has the line and column of each.
    """
    form = read_yaml(path, FleetForm)
    return Fleet(
        {name: Address.parse(text, name) for name, text in form.robots.items()},
        {
            name: Agent(
                Address.parse(agent.address, name),
                {robot: tuple(shlex.split(line)) for robot, line in agent.starts.items()},
            )
            for name, agent in form.agents.items()
        },
        path.resolve().parent,
    )
