"""Write the reference into the pages: run `python docs/generate.py` after a change of a key or a docstring.

A page has marks, and the text between them is generated:

    <!-- keys: NAME -->      table of the keys of a section, from the JSON Schema
    <!-- commands -->        every command with its options, from its help
    <!-- api: NAME ... -->   signatures and docstrings of names of `dxlrun` and `dxlrun.testing`
    <!-- page: NAME -->      table of the names of a module of `dxlrun.tooling`
    <!-- requests -->        every HTTP request of a running robot
    <!-- codes -->           every code of a refusal with its sentence
    <!-- events -->          every event of the log with its texts
    <!-- rules -->           every rule of the verdict
    <!-- end -->

`--check` writes nothing and exits with 1 when a page is out of date. The text depends on this repository
only: installed packages that PACKAGES does not list are ignored.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.metadata
import inspect
import io
import json
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import Distribution
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dxlrun.channels.event_records import EventText

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
PACKAGES = (ROOT, ROOT / "plugins/dxlrun_view")
"""Folders of the distributions whose commands and keys belong to the reference."""
SOURCES = ("runtime", "plugins", "plugins/dxlrun_view/src")
MARK = re.compile(
    r"^(<!-- (keys|commands|api|page|requests|codes|events|rules):? ?(.*?) ?-->)\n.*?^<!-- end -->$",
    re.MULTILINE | re.DOTALL,
)


class Package(Distribution):
    """A distribution as its pyproject.toml describes it, installed or not."""

    def __init__(self, folder: Path) -> None:
        self.project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]

    def read_text(self, filename: str) -> str | None:
        """Return the text of a metadata file."""
        if filename == "METADATA":
            return f"Name: {self.project['name']}\nVersion: {self.project.get('version', '0')}\n"
        if filename != "entry_points.txt":
            return None
        groups = self.project.get("entry-points", {})
        lines = [
            [f"[{group}]", *(f"{name} = {place}" for name, place in found.items())]
            for group, found in groups.items()
        ]
        return "\n".join(line for group in lines for line in group)

    def locate_file(self, path: str | PathLike[str]) -> Path:
        """Return where a file of the distribution is."""
        return ROOT / path


def use_only_this_repository() -> None:
    """Import from this tree, and find plug-ins of PACKAGES only; call it before importing dxlrun."""
    packages = [Package(folder) for folder in PACKAGES]
    groups = {point.group for package in packages for point in package.entry_points}
    installed = importlib.metadata.distributions

    def distributions(name: str = "") -> Iterator[Distribution]:
        others = (each for each in installed() if groups.isdisjoint(each.entry_points.groups))
        return (each for each in chain(packages, others) if name in ("", each.metadata["Name"]))

    importlib.metadata.distributions = distributions  # type: ignore[assignment]  # this process only generates
    sys.path[:0] = [str(ROOT / source) for source in SOURCES]


@cache
def printed_by(*words: str) -> str:
    """Return the output of `dxlrun WORDS`."""
    from dxlrun.cli import main

    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main(list(words))
    return out.getvalue()


def values(entry: dict[str, Any]) -> Iterator[str]:
    """Yield what a key may be, in a few words each."""
    branches = (one["then"] for one in entry.get("allOf", ()) if "then" in one)
    for one in entry.get("anyOf", ()) or entry.get("oneOf", ()) or branches:
        yield from values(one)
    kind, inner = entry.get("type"), entry.get("additionalProperties")
    if "$ref" in entry and not entry["$ref"].endswith(("/argument", "/grouped")):
        yield f"keys of `{re.split('[./]', entry['$ref'])[-1]}`"
    elif "enum" in entry or "const" in entry:
        yield " or ".join(f"`{one}`" for one in entry.get("enum") or [entry["const"]])
    elif units := re.search(r"\(([\w|/^\\%]+)\)\\s\*\$$", entry.get("pattern", "")):
        yield "quantity in " + units[1].replace("\\", "").replace("|", ", ")
    elif kind == "array":
        items = dict.fromkeys(values(entry.get("items") or entry["prefixItems"][0]))
        yield f"list of {' or '.join(items)}"
    elif kind == "object" and isinstance(inner, dict):
        yield f"by name: {' or '.join(dict.fromkeys(values(inner)))}"
    elif isinstance(kind, str) and kind not in {"null", "object"}:
        limits = [entry.get("minimum", entry.get("exclusiveMinimum")), entry.get("maximum")]
        words = [
            f"{word} {limit:g}"
            for word, limit in zip(("from", "to"), limits, strict=True)
            if limit is not None
        ]
        yield " ".join([{"string": "text", "boolean": "`true` or `false`"}.get(kind, kind), *words])


def keys(name: str) -> str:
    """Return the table of the keys of one part of a robot file."""
    schemas = {kind: json.loads(printed_by("schema", kind)) for kind in ("robot", "motion", "motor")}
    parts = {**schemas, **{own: part for each in schemas.values() for own, part in each["$defs"].items()}}
    entries = parts[name]["properties"]
    common = {"type", "active", "rate", "fallback", "into"} if "fallback" in entries else set()
    rows = ["| key | value | default | |", "|---|---|---|---|"]
    for key, entry in entries.items():
        if key in common and name != "ControllerEntry":
            continue
        given, example = entry.get("default"), (entry.get("examples") or [None])[0]
        default = "" if given is None else f"`{json.dumps(given)}`"
        about = entry.get("description") or parts.get(entry.get("$ref", "")[8:], entry).get("description", "")
        words = [
            *about.partition("\n\n")[0].split(),
            *([] if example is None else [f"Example: `{example}`."]),
        ]
        cells = (f"`{key}`", " or ".join(dict.fromkeys(values(entry))), default, " ".join(words))
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows)


def help_rows(text: str) -> list[tuple[str, str]]:
    """Return the rows of a table in a help, those of one line each."""
    return re.findall(r"^(\S+(?: \S+)*?) {2,}(\S.*)$", re.sub(r"\n {3,}", " ", text), re.MULTILINE)


def commands(_: str = "") -> str:
    """Return a section for each command, in the groups of `dxlrun --help`."""
    row = r"[a-z-][^\n]*\n(?: {3,}[^\n]*\n)*"
    parts: list[str] = []
    for heading, table in re.findall(rf"^([A-Z][^\n]*)\n((?:{row})+)", printed_by("--help"), re.MULTILINE):
        names = [name for name, _ in help_rows(table) if re.fullmatch("[a-z]+(-[a-z]+)*", name)]
        parts += [f"## {heading}", *(command(name) for name in names)] if names else []
    return "\n\n".join(parts)


def command(*words: str) -> str:
    """Return the section of a command: usage, what it does, arguments and options."""
    text = printed_by(*words, "--help").partition("\nExit codes:")[0]
    usage, _, rest = text.partition("\n\n")
    about, *tables = re.split(r"^(Arguments|Parameters|Commands)\n", rest, flags=re.MULTILINE)
    lines = [f"### {' '.join(words)}", about.strip(), "```\n" + usage.removeprefix("Usage: ") + "\n```"]
    for heading, table in zip(tables[::2], tables[1::2], strict=True):
        rows = [(name, what) for name, what in help_rows(table) if name not in {"--debug", "--help -h"}]
        if heading == "Commands":
            lines += [command(*words, name) for name, _ in rows if re.fullmatch("[a-z-]+", name)]
        elif rows:
            cells = [f"| `{name}` | {what} |".replace("\\", "\\\\") for name, what in rows]
            lines.append("\n".join(["| | |", "|---|---|", *cells]))
    return "\n\n".join(lines)


def api(names: str) -> str:
    """Return the docstrings of names of `dxlrun` and `dxlrun.testing`, with those of their methods."""
    import dxlrun
    from dxlrun import testing

    parts: list[str] = []
    for name in names.split():
        thing = getattr(dxlrun, name, None) or getattr(testing, name)
        parts += [f"### `{name}`", signature(name, thing), inspect.getdoc(thing) or ""]
        for own, member in [*vars(thing).items()] if inspect.isclass(thing) else ():
            function = inspect.unwrap(getattr(member, "__func__", getattr(member, "fget", member)))
            if not own.startswith("_") and inspect.isfunction(function) and function.__doc__:
                parts += [f"#### `{own}`", signature(own, member), inspect.getdoc(function) or ""]
    return "\n\n".join(filter(None, parts))


def signature(name: str, thing: object) -> str:
    """Return how a function is called; nothing for a class or a property."""
    function = getattr(thing, "__func__", thing)
    if not inspect.isfunction(function):
        return ""
    text = re.sub(r"'([\w\[\], .|]+)'", r"\1", str(inspect.signature(function)))
    return f"```python\n{name}{re.sub(r'^.(self|cls)(, )?', '(', text)}\n```"


def tooling_page(name: str) -> str:
    """Return a page of `dxlrun.tooling`: its docstring, and the first line about each of its names."""
    page = importlib.import_module(f"dxlrun.tooling.{name}")
    rows = ["| name | |", "|---|---|"]
    for own in sorted(page.__all__, key=str.lower):
        thing = getattr(page, own)
        documented = inspect.isclass(thing) or inspect.isroutine(thing) or inspect.ismodule(thing)
        about = (inspect.getdoc(thing) or "").partition("\n\n")[0] if documented else ""
        rows.append(f"| `{own}` | {' '.join(about.split())} |")
    return "\n\n".join([f"### `dxlrun.tooling.{name}`", inspect.getdoc(page) or "", "\n".join(rows)])


def requests(_: str = "") -> str:
    """Return the table of HTTP requests: their fields, and the first line about their handlers."""
    from dxlrun.remote.gateway import _HANDLERS
    from dxlrun.remote.requests.request_table import REQUESTS

    rows = ["| request | fields of the body | about |", "|---|---|---|"]
    for each in REQUESTS:
        query = "?" + "&".join(f"{name}=..." for name in each.query) if each.query else ""
        path = re.sub(
            r"\{(\w+)(:path)?\}", lambda name: "N" if name[1] == "number" else name[1].upper(), each.path
        )
        fields = ", ".join(f"`{name}`" for name in getattr(each.body, "__struct_fields__", ()))
        about = (inspect.getdoc(_HANDLERS[each]) or "").partition("\n\n")[0]
        rows.append(f"| `{each.method} {path}{query}` | {fields} | {' '.join(about.split())} |")
    return "\n".join(rows)


def codes(_: str = "") -> str:
    """Return the table of codes of refusals; words in braces are fields."""
    from dxlrun.channels.answers import Code

    return "\n".join(["| code | sentence |", "|---|---|", *(f"| `{code}` | {code.text} |" for code in Code)])


class Field(str):
    """Field of an event in a generated text: any format or arithmetic leaves its name in braces."""

    def __format__(self, spec: str) -> str:
        """Return the name; digits and units are up to the value."""
        return str(self)

    def __mul__(self, other: object) -> Field:  # type: ignore[override]
        """Return the field in another unit than ns."""
        return Field(self.replace("_ns}", "}"))

    def __iter__(self) -> Iterator[str]:
        """Iterate as a list of this one field."""
        return iter([str(self)])

    __truediv__ = __rtruediv__ = __mul__


def event_rows() -> list[tuple[str, str, EventText[...]]]:
    """Return all rows of the tables of texts: file below `runtime/`, name, row."""
    import dxlrun.log.log_writer
    from dxlrun.channels.event_records import EventText

    names = [".".join(path.relative_to(ROOT / "runtime").with_suffix("").parts) for path in text_tables()]
    modules = [*map(importlib.import_module, names), dxlrun.log.log_writer]
    return [
        (module.__name__.replace(".", "/") + ".py", name, row)
        for module in modules
        for name, row in vars(module).items()
        if isinstance(row, EventText)
    ]


def text_tables() -> list[Path]:
    """Return the tables of texts of the runtime's rooms, and the features of one module."""
    runtime = ROOT / "runtime/dxlrun"
    modules = (path for path in (runtime / "features").glob("*.py") if path.stem != "__init__")
    return sorted([*runtime.rglob("texts.py"), *modules])


def text_of(row: EventText[...]) -> str:
    """Return the text of a row, with its fields in braces."""
    text = row.write(**{name: Field(f"{{{name}}}") for name in inspect.signature(row.write).parameters})
    return " ".join(text.split())


def events(_: str = "") -> str:
    """Return the table of events, in the order of their codes."""
    rows = sorted({(row.code, row.severity, text_of(row)) for _, _, row in event_rows()})
    lines = [f"| `{code.name.lower()}` | {severity.name.lower()} | {text} |" for code, severity, text in rows]
    return "\n".join(["| event | severity | text |", "|---|---|---|", *lines])


def rules(_: str = "") -> str:
    """Return the table of the rules of the verdict."""
    from dxlrun_analysis.finding import ROBOT
    from dxlrun_analysis.rules import RULES

    found = [(ROBOT, "", "the first line: what the robot did", "always")]
    found += [(code, rule.accuses, rule.signal, rule.bound) for code, rule in RULES.items()]
    rows = [f"| `{code}` | {' | '.join(cells)} |".replace("|  |", "| |") for code, *cells in found]
    return "\n".join(["| code | accuses | signal | bound |", "|---|---|---|---|", *rows])


MAKERS: dict[str, Callable[[str], str]] = {
    "keys": keys,
    "commands": commands,
    "api": api,
    "page": tooling_page,
    "requests": requests,
    "codes": codes,
    "events": events,
    "rules": rules,
}


def generate(text: str) -> str:
    """Return a page with the text between its marks made again."""
    return MARK.sub(lambda mark: f"{mark[1]}\n\n{MAKERS[mark[2]](mark[3])}\n\n<!-- end -->", text)


def handwritten(text: str) -> str:
    """Return a page without its generated text."""
    return MARK.sub("", text)


def stale_pages(folder: Path = DOCS) -> list[Path]:
    """Return the pages whose generated text is not that of the code."""
    return [path for path in sorted(folder.rglob("*.md")) if (text := path.read_text()) != generate(text)]


def main() -> int:
    """Write or check all pages; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--check", action="store_true", help="write nothing; exit with 1 when a page is out of date"
    )
    check = parser.parse_args().check
    use_only_this_repository()
    stale = stale_pages()
    outcome = "out of date; run python docs/generate.py" if check else "written"
    for path in stale:
        print(f"{path.relative_to(ROOT)}: {outcome}")
        if not check:
            path.write_text(generate(path.read_text()))
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
