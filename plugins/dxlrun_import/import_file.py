"""`dxlrun import FILE`: makes a robot file or a motion file of another program's file."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun import InputError
from dxlrun.tooling.output import check_target, print_warning, show_json, show_parts, write_target
from dxlrun.tooling.verbs import DebugFlag, JsonFlag

if TYPE_CHECKING:
    from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions

PAGE = "docs/how-to/import.md"
_NEXT = {
    "robot": "dxlrun check {output}",
    "motion": "dxlrun check ROBOT.yaml --play {output}",
    "fragment": "write `include: [{output}]` in a robot file",
}
_YAML = (".yaml", ".yml")


def import_file(
    file: Annotated[Path, Parameter(name="file")],
    /,
    *,
    output: Path | None = None,
    type_name: Annotated[str, Parameter(name="--type")] = "",
    modes: Path | None = None,
    controller: str = "",
    unit: str = "",
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Make a robot file or a motion file of another program's file.

    The format is recognized by the content. Facts that the new file does not have are listed, with the
    reason. An existing file is not overwritten. Nothing in the file is executed.

    Parameters
    ----------
    file
        File of another program, such as a configuration of pypot or a motion of RoboPlus.
    output
        Output file: the new robot file or motion file. Default: print its text.
    type_name
        Type of the arm, for a calibration of LeRobot: koch_follower, for example.
    modes
        File with the modes of the servos, for a motor configuration of Interbotix.
    controller
        Controller that plays the motion, such as arm. Default: arm, as in imported robot files.
    unit
        Unit of positions in files without units, rad or deg. Default: rad.
    """
    if unit not in ("", "rad", "deg"):
        raise InputError(f"--unit {unit}: this unit is not known; give rad or deg")
    if output is not None:
        if output.suffix not in _YAML:
            raise InputError(f"{output} does not end in .yaml; give the name of a YAML file")
        check_target(output)
    from dxlrun.tooling.files import ImportOptions
    from dxlrun_import.checked_values import valid_name

    content = opened(file)
    found = recognized(content)
    options = ImportOptions(
        valid_name((output or file).stem),
        type=type_name,
        controller=controller,
        unit=unit,
        modes=None if modes is None else opened(modes),
        folder=(output or file).parent,
    )
    conversion = converted(content, found, options)
    if output is not None:
        write_target(output, conversion.text)
    if as_json:
        result = {
            "format": found.name,
            "makes": found.makes,
            "output": None if output is None else str(output),
            "text": conversion.text,
        }
        show_json(result, warnings=[f"{file}: not taken over: {remark}" for remark in conversion.remarks])
        return 0
    if output is None:
        show_parts(conversion.text.rstrip("\n"))
    else:
        show_parts(f"{output}: a {found.makes} file, made of {found.name}")
    for remark in conversion.remarks:
        print_warning(f"{file}: not taken over: {remark}")
    if output is not None:
        show_parts(f"next: {_NEXT[found.makes].format(output=output)}")
    return 0


def opened(file: Path) -> FileContent:
    """Read a file of another program. Raises InputError if it cannot be read."""
    from dxlrun.tooling.files import read_content

    try:
        return read_content(file)
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror or error}); check the path") from None


def recognized(content: FileContent) -> FileFormat:
    """Return the format of a file that can be converted. Raises InputError for any other file."""
    from dxlrun.tooling.files import format_of

    found = format_of(content)
    if found is not None and found.convert:
        return found
    if found is not None:
        raise content.refusal(*found.sentence(content.path))
    own = content.values.keys()
    if {"buses", "joints"} <= own:
        fix = f"`dxlrun check {content.path}` checks it, and `dxlrun {content.path}` runs it"
        raise content.refusal("this is a robot file of dxlrun already", fix)
    if "motions" in own:
        fix = f"`dxlrun check ROBOT.yaml --play {content.path}` checks it with its robot"
        raise content.refusal("this is a motion file of dxlrun already", fix)
    if content.text.lstrip()[:1] == "<":
        _ = content.xml  # raises InputError with the place of the first mistake
    if content.text.strip() and _has_structure(content.text):
        _ = content.document
    raise content.refusal(
        "the format of this file is not known", f"give a file of one of the formats in {PAGE}"
    )


def _has_structure(text: str) -> bool:
    return text.lstrip()[:1] in "{[" or ": " in text or ":\n" in text


def converted(content: FileContent, found: FileFormat, options: ImportOptions) -> Conversion:
    """Convert a file, and check the result like any robot file or motion file. Raises InputError."""
    from dxlrun.tooling.robots import compile_texts, parse_motion

    if content.values and content.document.problems:
        raise InputError(content.document.problems)
    module, _, name = found.convert.partition(":")
    conversion: Conversion = getattr(import_module(module), name)(content, options)
    if found.makes == "motion":
        parse_motion(conversion.text, Path("motion.yaml"))
    elif found.makes == "robot":
        compile_texts({"robot.yaml": conversion.text}, {}, conversion.urdf)
    return conversion
