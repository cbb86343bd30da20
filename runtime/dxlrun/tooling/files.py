"""Files: forms of a package's own YAML files and of its section of the robot file; formats of other programs.

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
    from dxlrun.description.base_form import Mistakes as Mistakes
    from dxlrun.description.base_form import Name as Name
    from dxlrun.description.base_form import key as key
    from dxlrun.description.base_form import validation_error as validation_error
    from dxlrun.description.document import KeyPath as KeyPath
    from dxlrun.description.mistakes.ros_types import ros_type as ros_type
    from dxlrun.description.other_files import Conversion as Conversion
    from dxlrun.description.other_files import FileContent as FileContent
    from dxlrun.description.other_files import FileFormat as FileFormat
    from dxlrun.description.other_files import ImportOptions as ImportOptions
    from dxlrun.description.other_files import format_of as format_of
    from dxlrun.description.other_files import read_content as read_content
    from dxlrun.description.other_files import read_yaml as read_yaml
    from dxlrun.description.units import Acceleration as Acceleration
    from dxlrun.description.units import Position as Position
    from dxlrun.description.units import Speed as Speed
    from dxlrun.errors import Mark as Mark
    from dxlrun.errors import Problem as Problem
    from dxlrun.errors import suggestion as suggestion
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
