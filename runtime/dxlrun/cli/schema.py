"""`dxlrun schema`: JSON Schema of robot and motion files, for editors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

from dxlrun.cli.output.flags import Flag
from dxlrun.cli.output.terminal import out
from dxlrun.errors import InputError


def schema(
    kind: Literal["robot", "motion", "fragment"] = "robot",
    /,
    *,
    output: Path | None = None,
    debug: Flag = False,
) -> int:
    """Print the JSON Schema of robot files, with the parameters of all installed controllers.

    Editors with a YAML language server use it when the file's first line is
    `# yaml-language-server: $schema=robot.schema.json`.

    Parameters
    ----------
    kind
        Which files: robot, motion, or fragment (what a robot file includes).
    output
        Write it into this file instead.
    debug
        Print the traceback of an error.
    """
    text = schema_text(kind)
    if output is None:
        out().file.write(text)
        return 0
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{output} cannot be written ({error.strerror}); choose another --output") from None
    return 0


def schema_text(kind: Literal["robot", "motion", "fragment"], *, only: str = "") -> str:
    """Return a schema as JSON; with `only`, of the controllers whose distribution's name begins so."""
    from dxlrun.description.json_schema import fragment_schema, motion_schema, robot_schema

    if kind == "motion":
        made = motion_schema()
    else:
        from dxlrun.control.controllers.plugins import load_plugins

        offers = load_plugins().controllers.items()
        parameters = {
            name: offer.controller.Parameters for name, offer in offers if offer.distribution.startswith(only)
        }
        made = robot_schema(parameters) if kind == "robot" else fragment_schema(parameters)
    return json.dumps(made, indent=2, ensure_ascii=False) + "\n"
