"""Other files: reads a package's own YAML files, and recognizes files of other programs.

A format of another program is one entry, which a package registers by the hook `dxlrun_formats`. The entries
are loaded only after a file was refused, or when it is imported.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from dxlrun.description.arguments import refuse_arguments
from dxlrun.description.document import PlainDocument, grow, literal, parse, read_start, read_text, refusal
from dxlrun.description.form_problems import Form, read_form
from dxlrun.errors import InputError, Mark
from dxlrun.installed_plugins import installed_plugins

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

LARGEST_FOREIGN = 16 * 1024 * 1024
"""Most bytes of a file of another program that are read; a recording is recognized by its first ones."""


def read_yaml(path: Path, model: type[Form]) -> Form:
    """Read a YAML file and validate it with a model.

    Args:
        path: The file. It may have neither arguments `${NAME}` nor tags.
        model: A `dxlrun.tooling.files.Form`, or another pydantic model.

    Raises:
        InputError: All problems of the file, each with its line and column.
    """
    file = str(path)
    with foreign_named(path):
        return read_form(grow(parse(read_text(path), file), file, refuse_arguments), model)


class FileContent:
    """Content of a file of another program: bytes, text and parsed values, each parsed on first use.

    Nothing in the file is executed: YAML tags and the entities of XML are refused.
    """

    def __init__(self, path: Path, data: bytes) -> None:
        self.path = path
        self.data = data
        """Its bytes, cut off after 16 MiB"""
        self._marks: dict[Element, Mark] = {}

    @cached_property
    def text(self) -> str:
        """Text of the file; empty if it is not UTF-8, or too large."""
        with suppress(UnicodeDecodeError):
            return self.data.decode("utf-8-sig") if len(self.data) <= LARGEST_FOREIGN else ""
        return ""

    @cached_property
    def document(self) -> PlainDocument:
        """Values of a YAML or JSON file with their places. Raises InputError if it is neither."""
        text = self.text.rstrip().removesuffix("\n---")  # `ros2 topic echo` ends each message so
        # ROS 2 accepts more than one block for all nodes: the second one continues the first.
        head, *blocks = re.split(r"^/\*\*:[ \t]*$", text, flags=re.MULTILINE)
        text = head + "/**:" * bool(blocks) + "".join(blocks)
        return grow(parse(text, str(self.path)), str(self.path), literal)

    @cached_property
    def values(self) -> dict[str, object]:
        """Values of a YAML or JSON file; empty if it is neither, or its top level is not a mapping."""
        looks_marked_up = self.text.lstrip()[:1] == "<"
        with suppress(InputError):
            return {} if looks_marked_up or not self.text else self.document.data
        return {}

    @cached_property
    def xml(self) -> Element:
        """Top element of an XML file. Raises InputError if it is not XML, or has a DOCTYPE."""
        # Imported here because most files are not XML.
        from xml.etree.ElementTree import TreeBuilder
        from xml.parsers import expat

        builder, parser = TreeBuilder(), expat.ParserCreate()

        def refuse_doctype(*_: object) -> None:
            raise refusal(self.mark(), "DOCTYPE is not allowed", "remove it")

        def start(tag: str, attributes: dict[str, str]) -> None:
            element = builder.start(tag, attributes)
            self._marks[element] = Mark(
                str(self.path), parser.CurrentLineNumber, parser.CurrentColumnNumber + 1
            )

        parser.StartElementHandler, parser.EndElementHandler = start, builder.end
        parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = builder.data, refuse_doctype
        try:
            parser.Parse(self.text, True)
        except expat.ExpatError as error:
            place = Mark(str(self.path), error.lineno, error.offset + 1)
            raise refusal(place, f"this is not XML ({expat.ErrorString(error.code)})", "correct it") from None
        return builder.close()

    @cached_property
    def top(self) -> str:
        """Name of the top element of an XML file; empty if it is not XML."""
        with suppress(InputError):
            return self.xml.tag if self.text.lstrip()[:1] == "<" else ""
        return ""

    def mark(self, *path: str | int) -> Mark:
        """Return the place of a value of a YAML or JSON file; without a path that of the file."""
        return self.document.marks.value(*path) if path else Mark(str(self.path))

    def mark_of(self, element: Element) -> Mark:
        """Return the place of an element of an XML file."""
        return self._marks.get(element, Mark(str(self.path)))

    def refusal(self, what: str, fix: str, *path: str | int) -> InputError:
        """Return an InputError about the value at a path, or about the whole file."""
        return refusal(self.mark(*path), what, fix)


class ImportOptions(NamedTuple):
    """Options of `dxlrun import` for converters; an option that was not given is empty."""

    name: str
    """Name of the robot or of the motion"""
    type: str = ""
    """Type of the robot, for files that do not name it"""
    controller: str = ""
    """Controller that plays a motion"""
    unit: str = ""
    """Unit of positions, for files without units"""
    modes: FileContent | None = None
    """Second file, with the modes of the servos"""
    folder: Path = Path()
    """Folder of the new file"""


class Conversion(NamedTuple):
    """Result of a converter."""

    text: str
    """Text of the robot file or motion file"""
    remarks: tuple[str, ...] = ()
    """Sentences about each fact that the text does not have, and why"""
    urdf: str | None = None
    """Text of the URDF that the robot file names"""


class FileFormat(NamedTuple):
    """A format of files of another program."""

    name: str
    """Name with its article: `a configuration of pypot`"""
    matches: Callable[[FileContent], bool]
    """Return True for content of this format; quick, because it is called for files of any kind"""
    advice: str = ""
    """One sentence with the next step; `{path}`, `{stem}` and `{name}` are those of the file"""
    convert: str = ""
    """Import path `module:function` of the converter, imported when it is used; empty without one. It is
    called with a `FileContent` and `ImportOptions`, and returns a `Conversion`"""
    makes: str = "robot"
    """Kind of the converter's file: `robot` or `motion`"""

    def sentence(self, path: Path) -> tuple[str, str]:
        """Return what a file is, and the next step."""
        made = f"`dxlrun import {{path}} --output {self.makes}.yaml` converts it to a {self.makes} file"
        advice = self.advice or made
        for key, value in (
            ("path", str(path)),
            ("stem", path.stem.removesuffix(".urdf")),
            ("name", path.name),
        ):
            advice = advice.replace(f"{{{key}}}", value)
        return f"this is {self.name}", advice


@cache
def file_formats() -> tuple[FileFormat, ...]:
    """Return the formats of all installed packages; a package that fails adds none."""
    found: list[FileFormat] = []
    for plugin in installed_plugins():
        # Foreign code may raise any exception on import.
        with suppress(Exception, SystemExit):
            hook = getattr(plugin.point.load(), "dxlrun_formats", None)
            found += hook() if hook is not None else ()
    return tuple(found)


def read_content(path: Path) -> FileContent:
    """Read a file of another program; of a directory, the file that describes it. Raises OSError."""
    described = (path / name for name in ("metadata.yaml", os.path.join("meta", "info.json")))
    file = next((one for one in described if one.is_file()), path) if path.is_dir() else path
    return FileContent(path, read_start(file, LARGEST_FOREIGN + 1))


def format_of(content: FileContent) -> FileFormat | None:
    """Return the format of a file of another program; None if no package knows it."""
    for one in file_formats():
        # A predicate of a package may raise any exception.
        with suppress(Exception):
            if one.matches(content):
                return one
    return None


def foreign_sentence(path: Path, text: str | None = None) -> tuple[str, str] | None:
    """Return what a file of another program is, and the next step; None if it is not known.

    `text`: content of the file, if it was read already.
    """
    with suppress(OSError, ValueError):
        found = format_of(read_content(path) if text is None else FileContent(path, text.encode()))
        return None if found is None else found.sentence(path)
    return None


@contextmanager
def foreign_named(path: Path, text: str | None = None) -> Iterator[None]:
    """Context manager that refuses a file of another program by its name, if reading it fails."""
    try:
        yield
    except InputError:
        if found := foreign_sentence(path, text):
            raise refusal(Mark(str(path)), *found) from None
        raise
