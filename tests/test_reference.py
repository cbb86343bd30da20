"""The generated reference is that of the code, and the pages beside it are short."""

import pkgutil
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from tests.kit.loaded import loaded
from tests.kit.pages import PATHS, page_text

import dxlrun
import dxlrun.tooling
from dxlrun.cli import verb_registry

ROOT = Path(__file__).parents[1]
GENERATE = ROOT / "docs/generate.py"
MOST_WORDS = 40_000


@pytest.mark.needs("logs")
def test_reference_is_up_to_date() -> None:
    """In a process of its own: installed packages that are not of this repository must not show."""
    checked = subprocess.run(
        [sys.executable, GENERATE, "--check"], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr


@pytest.mark.needs("report")
def test_pictures_are_up_to_date() -> None:
    """A picture is stale when a file, an output or a word that it shows has changed since it was made."""
    make = [sys.executable, ROOT / "docs/pictures/make.py", "--check"]
    checked = subprocess.run(make, capture_output=True, text=True, check=False, cwd=ROOT)
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_stale_page_is_reported_with_the_command(tmp_path: Path) -> None:
    generate = loaded(GENERATE)
    page = tmp_path / "page_of_keys.md"
    page.write_text("Before.\n\n<!-- keys: Adapter -->\n| old |\n<!-- end -->\n\nAfter.\n")
    assert generate.stale_pages(tmp_path) == [page]
    page.write_text(generate.generate(page.read_text()))
    assert generate.stale_pages(tmp_path) == []
    assert "| `latency` |" in page.read_text()
    assert generate.handwritten(page.read_text()) == "Before.\n\n\n\nAfter.\n"


def test_every_mark_has_its_end() -> None:
    for name in PATHS:
        text = page_text(name)
        marks = re.findall(
            r"^<!-- (keys|commands|api|page|requests|codes|events|rules|end)\b.*-->$", text, re.MULTILINE
        )
        assert all(mark == "end" for mark in marks[1::2]), name
        assert "end" not in marks[::2], name
        assert len(marks) % 2 == 0, name


def test_reference_has_no_path_of_a_machine() -> None:
    for name in ("api.md", "commands.md", "robot-file.md", "standard-controllers.md", "sensors.md"):
        assert str(ROOT) not in page_text(name), name
        assert not re.search(r"/home/|/root/|site-packages|\bat 0x[0-9a-f]{6}", page_text(name)), name


def test_reference_has_every_name_and_command() -> None:
    names = page_text("api.md")
    units = {one for one in dxlrun.__all__ if str(getattr(dxlrun, one)).startswith("typing.Annotated")}
    values = {"CONTRACT_VERSION", "Commands", "Floats", "States"}
    assert (
        set(re.findall(r"^### `(\w+)`", names, re.MULTILINE))
        == {*dxlrun.__all__, "simulated_robot", "installed"} - units - values
    )
    pages = {page.name for page in pkgutil.iter_modules(dxlrun.tooling.__path__)}
    tables = dict(re.findall(r"^### `dxlrun.tooling.(\w+)`\n(.*?)(?=^### |\Z)", names, re.M | re.S))
    assert {name: sorted(re.findall(r"^\| `(\w+)` ", text, re.M)) for name, text in tables.items()} == {
        name: sorted(import_module(f"dxlrun.tooling.{name}").__all__) for name in pages
    }
    client = names.partition("### `RemoteRobot`")[2].partition("\n### ")[0]
    methods = {one for one in dir(dxlrun.RemoteRobot) if not one.startswith("_")} - {"name"}
    assert methods == set(re.findall(r"^#### `(\w+)`", client, re.MULTILINE))
    listed = page_text("commands.md")
    sections = dict(re.findall(r"^### ([a-z -]+)\n(.*?)(?=^### |\Z)", listed, re.MULTILINE | re.DOTALL))
    assert {name.split()[0] for name in sections} == {*verb_registry.names(), "view"}
    assert {"bench rate", "experiment tracking"} <= set(sections)
    assert all(f"| `{option}" in sections["send"] for option in ("--wait", "--in STR", "--json", "TARGET"))


def test_pages_are_short() -> None:
    """Count the words of all pages, examples included, but not generated text and the list of changes."""
    generate = loaded(GENERATE)
    words = {
        name: sum(bool(re.search(r"\w", word)) for word in generate.handwritten(page_text(name)).split())
        for name in PATHS
    }
    assert sum(words.values()) <= MOST_WORDS, f"{sum(words.values())} words; cut some"
