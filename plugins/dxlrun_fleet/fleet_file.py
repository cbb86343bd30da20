"""Fleet file: addresses of robots, and the agents that start them."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import AfterValidator

from dxlrun import InputError
from dxlrun.tooling.files import Form, key, read_yaml, refuse, suggestion
from dxlrun.tooling.live import Address, ListedAddress


def _line(text: str) -> str:
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise refuse(f"{text!r} is not a line of words: {error}", "write it as behind `dxlrun`") from error
    if not words or not words[0].endswith((".yaml", ".yml")):
        raise refuse(f"{text!r} begins with no robot file", "write ROBOT.yaml and what follows it")
    return text


class AgentForm(Form):
    """A computer where `dxlrun fleet FILE --serve NAME` starts robots."""

    address: ListedAddress = key("Address of the agent.", "lab3:7659")
    starts: dict[str, Annotated[str, AfterValidator(_line)]] = key(
        "Arguments of `dxlrun` for each robot; paths are relative to this file's directory.",
        "{torso: robots/bioloid_torso.yaml port:=/dev/ttyUSB0 --listen 0.0.0.0:7660}",
    )


class FleetForm(Form):
    """Robots, and the agents that start them."""

    robots: dict[str, ListedAddress] = key("Addresses by the names of certificates.", "{torso: lab3:7660}")
    agents: dict[str, AgentForm] = key("Agents by the names of their certificates.", "{lab3: {}}", {})


class Agent(NamedTuple):
    """Agent, with the arguments of `dxlrun` for each robot that it starts."""

    address: Address
    starts: dict[str, tuple[str, ...]]


class Fleet(NamedTuple):
    """Robots and agents by name."""

    robots: dict[str, Address]
    agents: dict[str, Agent]
    directory: Path

    def agent_of(self, robot: str) -> Agent:
        """Return the agent that starts a robot.

        Raises:
            InputError: None of the agents starts it.
        """
        for agent in self.agents.values():
            if robot in agent.starts:
                return agent
        raise InputError(f"no agent of the file starts {robot}; name it under agents: NAME: starts")

    def require(self, names: tuple[str, ...]) -> None:
        """Raise InputError for the first name that is not a robot."""
        for name in names:
            if name not in self.robots:
                raise InputError(f"the file has no robot {name}; {suggestion(name, tuple(self.robots))}")


def read_fleet(path: Path) -> Fleet:
    """Return the fleet of a file.

    Raises:
        InputError: The file has mistakes; the message has the place of each.
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
