"""The pages of the repository: the commands, files, names and pages in them exist."""

import ast
import json
import re
import tomllib
from pathlib import Path

import pytest
from tests.kit.commands import Dxlrun
from tests.kit.pages import PATHS as DOCS

from dxlrun.channels.event_records import event_names
from dxlrun.cli import verb_registry
from dxlrun.cli.examples import schema_text
from dxlrun_view import dxlrun_commands
from dxlwire.exceptions import HELP

ROOT = Path(__file__).parents[2]
ROOTS = (ROOT, ROOT / "runtime", ROOT / "runtime/dxlrun", ROOT / "plugins")
"""Where a page's path to a file may begin."""
PATHS = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "tests/CAMPAIGNS.md")), *DOCS.values()]
PAGES = {path.name: path.read_text() for path in PATHS}
PROJECT = (ROOT / "pyproject.toml").read_text()
SOURCES = {
    path: path.read_text()
    for folder in ("runtime", "plugins", "tests")
    for path in sorted((ROOT / folder).rglob("*"))
    if path.suffix in {".py", ".c", ".toml", ".md"} and "site-packages" not in path.parts
}
HERE = "tests/cli/test_pages.py"
TESTS = {
    "README.md": ("tests/test_readme.py",),
    "add-a-section.md": ("plugins/lights/tests/test_lights.py",),
    **dict.fromkeys(("analyze.md", "architecture.md", "bus.md", "devices.md", "frames.md"), (HERE,)),
    **dict.fromkeys(
        ("mechanics.md", "models.md", "simulation.md", "tools.md", "from-ros2-control.md"), (HERE,)
    ),
    **dict.fromkeys(("raspberry-pi.md", "real-time.md"), (HERE, "tests/cli/test_latency.py")),
    **dict.fromkeys(("arm.md", "controller.md", "humanoid.md"), ("tests/cli/test_tutorial.py",)),
    "bench.md": ("tests/bench/test_bench_page.py", "tests/cli/test_docs.py"),
    "controllers.md": ("tests/plugins/test_docs.py",),
    "experiments.md": (
        "tests/cli/test_latency.py",
        "tests/lab/characterize/test_command.py",
        "tests/lab/tracking/test_command.py",
    ),
    "by-hand.md": ("tests/hand/test_terminal.py",),
    "from-lerobot-rustypot-sdk.md": (HERE,),
    "import.md": ("tests/import/test_import.py",),
    "gallery.md": ("tests/cli/test_examples.py",),
    "logs.md": ("tests/analysis/season/test_logs.py", "tests/analysis/export/test_export.py"),
    "results.md": ("tests/lab/tracking/test_command.py",),
    "recipes.md": ("tests/cli/test_recipes.py", "tests/robots/test_stand_up.py"),
    "sensors.md": ("tests/sensors/test_serial_imu.py",),
    "replay.md": ("tests/analysis/replay/test_same.py",),
    "standard-controllers.md": ("tests/space/test_page.py",),
    "space.md": ("tests/space/test_tutorial.py",),
    "steering.md": ("tests/cli/test_steer.py",),
    "teleoperation.md": ("tests/teleop/test_page.py", "tests/teleop/test_terminal.py"),
    "network.md": ("tests/remote/test_network_run.py",),
    "fleet.md": ("tests/fleet/test_fleet.py",),
    "foxglove.md": ("tests/foxglove/test_live.py",),
    "view.md": ("tests/view/test_command.py",),
}
"""What runs the commands of a page."""


def test_every_page_with_commands_has_a_test_that_runs_them() -> None:
    assert {page for page, text in PAGES.items() if re.search(r"^    dxlrun ", text, re.MULTILINE)} == set(
        TESTS
    )
    for page, paths in TESTS.items():
        for path in paths:
            assert page in (ROOT / path).read_text(), (page, path)


@pytest.fixture(scope="module")
def helped() -> dict[str, str]:
    """Texts of the help that were asked for."""
    return {}


@pytest.mark.parametrize("page", PAGES)
def test_commands_inside_sentences_exist_with_their_options(
    dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch, page: str, helped: dict[str, str]
) -> None:
    # the page's package is installed by itself
    found = dict(verb_registry.packaged()) | {command.name: command for command in dxlrun_commands()}
    monkeypatch.setattr(verb_registry, "packaged", lambda: found)
    known = set(verb_registry.names())
    for span in re.findall(r"`dxlrun ([^`]+)`", " ".join(PAGES[page].split())):
        verb, *rest = span.split()
        family: list[str] = []
        if not (verb.startswith("--") or verb.endswith((".yaml", "FILE", "ROBOT", "VERB"))):
            assert verb in known, span
            family = [verb, rest[0]] if verb in {"bench", "experiment"} else [verb]
        command = " ".join(["dxlrun", *family])
        if command not in helped:
            helped[command] = dxlrun(*family, "--help").out
        assert command in helped[command], span
        for option in re.findall(r"--[a-z][a-z-]*", span):
            assert option in helped[command], span


def anchors(text: str) -> set[str]:
    """Return the names by which the headings of a page are linked to, as GitHub makes them."""
    headings = re.findall(
        r"^#+ (.+)$", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", [*PATHS, ROOT / "CHANGELOG.md"], ids=lambda path: path.name)
def test_links_and_files_of_a_page_exist(path: Path) -> None:
    text = path.read_text()
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("https://"):
            continue
        target, _, anchor = link.partition("#")
        linked = path.parent / target if target else path
        assert linked.exists(), link
        if anchor:
            assert anchor in anchors(linked.read_text()), link
    others = {"logs", ".venv", "dxlrun", "lights", "ros"}  # beginnings of other names, or of .ci/run
    folders = {one.name for root in ROOTS for one in root.iterdir() if one.is_dir()} - others
    typed = [word for line in re.findall(r"^    (.+)$", text, re.MULTILINE) for word in line.split()]
    for token in [*re.findall(r"`([\w.+-]+(?:/[\w.+-]+)*/?)`", text), *typed]:
        if token.split("/")[0] in folders and "/" in token:
            assert any((root / token).exists() for root in ROOTS), token


def test_every_page_has_a_name_of_its_own_and_is_in_the_index() -> None:
    paths = [path for path in (ROOT / "docs").rglob("*.md") if path.parent.name != "changes"]
    assert len(paths) == len(DOCS)
    pages = {str(path.relative_to(ROOT / "docs")) for path in paths} - {"index.md"}
    assert pages <= set(re.findall(r"\]\(((?:[\w-]+/)?[\w-]+\.md)\)", PAGES["index.md"]))


def test_what_the_code_cites_is_in_the_repository() -> None:
    pages = {*PAGES, "CHANGELOG.md"}
    cited = {
        (name, path.name)
        for path, text in SOURCES.items()
        for name in re.findall(r"(?<![\w/*.{}-])((?:docs/(?:[\w-]+/)?)?[a-zA-Z-]+\.md)\b", text)
    }
    assert ("protocol.md", "line.py") in cited
    lost = {
        (name, where)
        for name, where in cited
        if not ((ROOT / name).exists() if "/" in name else name in pages)
    }
    assert lost == set()
    headings = anchors(PAGES["protocol.md"])
    sections = re.findall(r"\(protocol\.md, ([A-Z]\w+)", "\n".join(SOURCES.values()))
    assert sections
    for section in sections:
        assert any(heading.startswith(section.lower()) for heading in headings), section


@pytest.mark.parametrize("page", PAGES)
def test_the_names_that_a_page_gives_with_their_file_exist(page: str) -> None:
    found = re.findall(r"`([\w/.-]+\.(?:py|c))::([\w.]+)`", PAGES[page])
    assert found or page != "architecture.md"
    for file, name in found:
        paths = [root / file for root in ROOTS if (root / file).exists()]
        assert paths, file
        text = paths[0].read_text()
        for word in name.split("."):  # a method is `Class.method`
            assert re.search(rf"(?:def|class) {word}\b|^{word}\b|^\w.*\b{word}\(", text, re.MULTILINE), name


def test_architecture_md_has_every_room() -> None:
    page = PAGES["architecture.md"]
    rooms = set(re.findall(r"`([\w/]+(?:/|\.py))`", page[page.index("## Rooms") :]))
    for root, folder in (("", "dxlsim/"), ("", "dxlwire/"), ("dxlrun", ""), ("dxlrun", "dynamixel/")):
        entries = [one for one in (ROOT / "runtime" / root / folder).iterdir() if "__" not in one.name]
        entries = [one for one in entries if one.is_file() or any(one.rglob("*.py"))]
        names = {f"{folder}{one.name}" + "/" * one.is_dir() for one in entries}
        assert {name for name in names if name.endswith((".py", "/"))} - rooms == set()


def test_architecture_md_names_what_the_code_has() -> None:
    code = "\n".join(text for path, text in SOURCES.items() if path.relative_to(ROOT).parts[0] != "tests")
    names = re.findall(r"`([A-Za-z_]\w+(?:\.[a-z_]\w+)?)(?:\(\))?`", PAGES["architecture.md"])
    names = [name for name in names if not name.endswith((".py", ".so", ".toml"))]
    assert {"Plan", "commands"} <= set(names)
    for name in names:
        for word in name.split("."):
            assert re.search(rf"\b{word}\b", code), name


def test_failures_md_names_events_and_keys_that_exist() -> None:
    events = {*event_names().values()}
    names = set(re.findall(r"`([a-z]+_[a-z_]+)`", PAGES["failures.md"]))
    assert {"servo_lost", "on_exit"} <= names
    schema = schema_text("robot")
    for name in names - events - {"clamped"}:
        assert f'"{name}": {{' in schema or name in ("on_configure", "on_restart"), name


def test_it_does_not_work_md_quotes_messages_of_the_program() -> None:
    page = PAGES["it-does-not-work.md"]
    symptoms = re.split(r"^### ", page, flags=re.MULTILINE)[1:]
    assert len(symptoms) >= 25
    assert [text.partition("\n")[0] for text in symptoms if "`dxlrun " not in text] == []
    written = "\n".join(
        text for path, text in SOURCES.items() if path.relative_to(ROOT).parts[0] == "runtime"
    )
    written = re.sub(r'" *\n\s+f?"', "", written)  # a sentence in several lines
    for quoted in re.findall(r"^> (.+)$", page, re.MULTILINE):
        if quoted != "dxlrun: command not found":  # the shell's
            for part in filter(None, map(str.strip, quoted.split("…"))):
                assert part in written, quoted


def test_messages_name_the_symptom_that_quotes_them() -> None:
    page = PAGES["it-does-not-work.md"]
    symptoms = re.split(r"^### ", page, flags=re.MULTILINE)[1:]
    quotes = {
        anchor: "\n> " in text for text in symptoms for anchor in anchors("### " + text.partition("\n")[0])
    }
    product = [path for path in SOURCES if path.suffix == ".py" and "tests" not in path.parts]
    named = {
        node.args[0].value
        for path in product
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "help_link" and len(node.args) == 1
        if isinstance(node.args[0], ast.Constant)
    }
    assert named <= set(quotes)
    # the first is the shell's message; the other is the refusal of a request, which has its own remedy
    assert {anchor for anchor, quoted in quotes.items() if quoted} - named == {
        "the-command-is-not-found",
        "one-joint-is-limp",
    }


def test_addresses_are_in_one_place() -> None:
    address = tomllib.loads(PROJECT)["project"]["urls"]["Issues"]
    assert [path.name for path in PATHS if address in path.read_text()] == []
    assert [path.name for path in (*PATHS, *SOURCES) if HELP in path.read_text()] == ["exceptions.py"]
    for page in ("README.md", "CONTRIBUTING.md", "it-does-not-work.md"):
        assert re.search(r"`Issues`\s+in\s+\[pyproject.toml\]", PAGES[page]), page


def test_contributing_md_is_short_and_has_what_ci_runs() -> None:
    page = PAGES["CONTRIBUTING.md"]
    assert len(page.encode()) <= 8192
    linters = {"ruff format", "ruff check", "mypy", "lint-imports"}
    assert set(re.findall(r"^    .*\.venv/bin/(ruff \w+|mypy|lint-imports)", page, re.MULTILINE)) == linters
    ci = (ROOT / ".ci/run").read_text().replace('"', "")
    assert set(re.findall(r"\.lint/bin/(ruff \w+|mypy|lint-imports)", ci)) == linters
    quick = re.findall(r"tests/[\w/.]+", ci)
    assert len(quick) >= 5
    assert [folder for folder in quick if not (ROOT / folder).exists()] == []
    (extras,) = re.findall(r"^    .*install -e '\.\[(.+)\]'$", page, re.MULTILINE)
    every = set(tomllib.loads(PROJECT)["project"]["optional-dependencies"])
    assert set(extras.split(",")) == every - {"release", "full"}  # of 101 and 380 MB


PICTURES = ROOT / "docs" / "pictures"
NAMES = tuple(json.loads((PICTURES / "inputs.json").read_text()))


def test_check_names_the_picture_and_the_command_when_an_input_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(PICTURES))
    import inputs  # a script of docs/pictures

    texts = {"pan": {"robots/pan.yaml": "rate: 50", "drawing": "<svg/>"}, "tilt": {"drawing": "<svg/>"}}
    monkeypatch.setattr(inputs, "HASHES", tmp_path / "inputs.json")
    monkeypatch.setattr(
        inputs,
        "inputs_of_pictures",
        lambda _: {
            name: {one: lambda text=text: text for one, text in found.items()}
            for name, found in texts.items()
        },
    )
    inputs.record(["pan", "tilt"])
    assert inputs.stale() == []
    texts["pan"]["robots/pan.yaml"] = "rate: 100"
    assert inputs.stale() == ["pan: robots/pan.yaml changed; run python docs/pictures/make.py pan"]
    inputs.record(["pan"])
    assert inputs.stale() == []


def test_the_pages_show_them_and_they_are_small() -> None:
    shown = {
        (path.parent / target).resolve()
        for path in (ROOT / "README.md", *DOCS.values())
        for target in re.findall(r"!\[[^\]]+\]\(([^)\s]+)\)", path.read_text())
    }
    assert shown == {path for path in PICTURES.iterdir() if path.suffix in {".png", ".svg"}}
    assert {path.stem for path in shown} == set(NAMES)
    assert len(shown) >= 20
    assert sum(one.stat().st_size for one in shown) < 3_000_000
    for one in shown:
        assert one.stat().st_size < 200_000, one
        if one.suffix == ".svg":
            text = one.read_text()
            assert not re.search(r"(href|src)=\"(?!#|data:)|url\((?!#)|@import|<script", text), one
