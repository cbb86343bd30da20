"""Robots file: `robots.yaml` of the user's settings, with the addresses of robots on other computers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from dxlrun.description.base_form import Form, key, validation_error
from dxlrun.description.other_files import read_yaml
from dxlrun.errors import InputError, what_and_fix
from dxlrun.remote.sockets import Address


def _address(text: str) -> str:
    try:
        Address.parse(text, "robot")
    except InputError as error:
        raise validation_error(*what_and_fix(error)) from error
    return text


ListedAddress = Annotated[str, AfterValidator(_address)]
"""Address as written in the file, `[NAME@]HOST:PORT`; the default NAME is the key of the mapping."""


class RobotsFile(Form):
    """Content of `robots.yaml`."""

    robots: dict[str, ListedAddress] = key("Addresses by the names of certificates.", "{torso: lab3:7660}")


def read_robots(path: Path) -> dict[str, Address]:
    """Return the addresses in a robots file by robot name; raises InputError with places of mistakes."""
    robots = read_yaml(path, RobotsFile).robots
    return {name: Address.parse(text, name) for name, text in robots.items()}
