"""YAML file: reads a YAML file of any form into a pydantic model, with the place of each mistake."""

from __future__ import annotations

from pathlib import Path

from dxlrun.description.arguments import refuse_arguments
from dxlrun.description.document import grow, parse, read_text
from dxlrun.description.form_problems import Form, read_form


def read_yaml(path: Path, model: type[Form]) -> Form:
    """Read a YAML file and validate it with a model.

    Args:
        path: The file. It may have neither arguments `${NAME}` nor tags.
        model: A `dxlrun.tooling.files.Form`, or another pydantic model.

    Raises:
        InputError: All problems of the file, each with its line and column.
    """
    file = str(path)
    return read_form(grow(parse(read_text(path), file), file, refuse_arguments), model)
