"""Files: forms of a package's own YAML files and of its section of the robot file.

A model defines the keys. All mistakes in a file are reported at once, each with its place.

    from pathlib import Path

    from dxlrun.tooling.files import Form, key, read_yaml

    class Lights(Form):
        pin: int = key("Number of the output.", "4")

    Path("lights.yaml").write_text("pin: 7")
    lights = read_yaml(Path("lights.yaml"), Lights)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.description.base_form import Form as Form
    from dxlrun.description.base_form import Name as Name
    from dxlrun.description.base_form import key as key
    from dxlrun.description.base_form import validation_error as validation_error
    from dxlrun.description.document import KeyPath as KeyPath
    from dxlrun.description.units import Acceleration as Acceleration
    from dxlrun.description.units import Position as Position
    from dxlrun.description.units import Speed as Speed
    from dxlrun.description.yaml_file import read_yaml as read_yaml
    from dxlrun.errors import Mark as Mark
    from dxlrun.errors import Problem as Problem
    from dxlrun.errors import suggestion as suggestion
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
