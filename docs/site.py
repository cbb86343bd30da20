"""Build the documentation site: `python docs/site.py` writes it to `site/`, and fails on any warning.

The pages are those of this folder, in the order of index.md. Where a page has a line `<!-- keys: NAME -->`,
`<!-- commands -->`, `<!-- api: NAME ... -->` or `<!-- page: NAME -->`, the site has what the program says of
itself there: tables of keys from the JSON Schema, every command with its options, docstrings. What a page
links to outside of this folder is taken along. Needs `pip install 'zensical>=0.0.73'`; `--into DIRECTORY`
builds elsewhere.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import inspect
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
ROOT = DOCS.parent
LINK = re.compile(r"\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")
MARK = re.compile(r"^<!-- (keys|commands|api|page):? ?(.*?) ?-->$", re.MULTILINE)


def place_of(path: Path) -> Path:
    """Return where the site has a file: as in this folder; from outside, a page below `files`."""
    if path.is_relative_to(DOCS) and path.suffix in {".md", ".png", ".svg"}:
        return path.relative_to(DOCS)
    path = (path / "README.md" if path.is_dir() else path).relative_to(ROOT)
    return Path("files", path if path.suffix == ".md" else f"{path}.md")


def rewritten(text: str, page: Path, wanted: set[Path]) -> str:
    """Return a page with its links as on the site; `wanted` gets the files that they lead to."""

    def link(match: re.Match[str]) -> str:
        shown, linked, anchor = match.groups()
        if linked.startswith(("http:", "https:")):
            return match[0]
        path = Path(os.path.normpath(page.parent / linked))
        if path.suffix not in {".png", ".svg"}:
            wanted.add(path)
        if shown == path.name and path.suffix == ".md" and not anchor:  # a page is named by its title
            shown = path.read_text().partition("\n")[0].removeprefix("# ")
        return f"[{shown}]({os.path.relpath(place_of(path), place_of(page).parent)}{anchor or ''})"

    return LINK.sub(link, text)


# What the program says of itself


@cache
def said(*words: str) -> str:
    """Return what `dxlrun WORDS` prints."""
    from dxlrun.cli import main

    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main(list(words))
    return out.getvalue()


def values(entry: dict[str, Any]) -> Iterator[str]:
    """Yield what a key may be, in a few words each."""
    for one in entry.get("anyOf", ()) or entry.get("oneOf", ()):
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
    schemas = {kind: json.loads(said("schema", kind)) for kind in ("robot", "motion", "motor")}
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
    for heading, table in re.findall(rf"^([A-Z][^\n]*)\n((?:{row})+)", said("--help"), re.MULTILINE):
        names = [name for name, _ in help_rows(table) if re.fullmatch("[a-z]+(-[a-z]+)*", name)]
        parts += [f"## {heading}", *(command(name) for name in names)] if names else []
    return "\n\n".join(parts)


def command(*words: str) -> str:
    """Return the section of a command: usage, what it does, arguments and options."""
    text = said(*words, "--help").partition("\nExit codes:")[0]
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
    return "\n\n".join(parts)


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
        documented = inspect.isclass(thing) or inspect.isroutine(thing)
        about = (inspect.getdoc(thing) or "").partition("\n\n")[0] if documented else ""
        rows.append(f"| `{own}` | {' '.join(about.split())} |")
    return "\n\n".join([f"### `dxlrun.tooling.{name}`", inspect.getdoc(page) or "", "\n".join(rows)])


MAKERS = {"keys": keys, "commands": commands, "api": api, "page": tooling_page}


def generated(text: str) -> str:
    """Return a page with what the program says in place of its marks."""
    return MARK.sub(lambda match: MAKERS[match[1]](match[2]), text)


def settings(index: str) -> str:
    """Return zensical.toml with the order of index.md: its sections, and their pages by their own titles."""
    parts = [{"Documentation": "index.md"}]
    for heading, body in re.findall(r"^## ([^\n]+)\n(.*?)(?=^## |\Z)", index, re.MULTILINE | re.DOTALL):
        parts.append({heading: [link for _, link, _ in LINK.findall(body)]})
    return re.sub(
        r"nav = \[\]",
        f"nav = {json.dumps(parts)}".replace('": ', '" = '),
        (DOCS / "zensical.toml").read_text(),
    )


def gather(source: Path) -> None:
    """Write all pages, pictures and what they link to below `source`."""
    shutil.copytree(DOCS / "pictures", source / "pictures", ignore=shutil.ignore_patterns("*.py"))
    shutil.copy(DOCS / "site.css", source)
    rest = {path for path in DOCS.rglob("*.md") if path.parent.name != "changes"}
    done: set[Path] = set()
    while rest:
        path = rest.pop()
        done.add(path)
        file, target = path / "README.md" if path.is_dir() else path, source / place_of(path)
        if file.suffix == ".md":
            text = rewritten(generated(file.read_text()), file, rest)
            rest -= done
        else:
            text = f"# {file.name}\n\n````{file.suffix[1:]}\n{file.read_text()}````\n"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text)


def build(into: Path) -> int:
    """Build the site in a directory; return the exit code of zensical."""
    if importlib.util.find_spec("zensical") is None:
        sys.exit("the site needs zensical: pip install 'zensical>=0.0.73'")
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        gather(place / "docs")
        (place / "zensical.toml").write_text(settings((place / "docs/index.md").read_text()))
        ran = subprocess.run([sys.executable, "-m", "zensical", "build", "--strict"], cwd=place, check=False)
        if ran.returncode == 0:
            shutil.rmtree(into, ignore_errors=True)
            shutil.move(place / "site", into)
    return ran.returncode


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--into", type=Path, default=ROOT / "site")
    sys.exit(build(parser.parse_args().into))
