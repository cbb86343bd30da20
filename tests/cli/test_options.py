"""Options have one name and one meaning in all commands: those of options.txt."""

import re
from collections.abc import Callable, Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, NamedTuple, get_args

import pytest
from cyclopts import App

from dxlrun.cli import verb_registry
from dxlrun.cli.app import build

ROOT = Path(__file__).parents[2]
TABLE = Path(__file__).with_name("options.txt")
VIEW = ROOT / "plugins" / "dxlrun_view" / "src" / "dxlrun_view" / "view.py"
VALUES = {bool: "", int: "NUMBER", float: "NUMBER", Path: "PATH", str: "TEXT"}
PAGE = dict[str, tuple[str, str]]


class Option(NamedTuple):
    verb: str
    names: tuple[str, ...]
    value: str
    meaning: str


def options(app: App, *verb: str) -> Iterator[Option]:
    """Yield every option of every command, with the sentence of its help."""
    for name in app.resolved_commands():
        if not name.startswith("-"):
            yield from options(app[name], *verb, name)
    if app.default_command is None or verb == ("help",):
        return
    for argument in app.assemble_argument_collection(parse_docstring=True):
        if argument.parameter.parse is not False and any(name[:2] == "--" for name in argument.names):
            names = tuple(name for name in argument.names if name[:2] == "--")
            if names != ("--*",):
                about = " ".join((argument.parameter.help or "").split())
                yield Option(" ".join(verb) or "ROBOT.yaml", names, value_of(argument.hint), about)


def value_of(hint: Any) -> str:
    """Return which value a type takes: `tuple[Path, ...] | None` is a PATH."""
    if (found := VALUES.get(hint)) is not None:
        return found
    kinds = [one for one in get_args(hint) if one not in (type(None), Ellipsis)]
    return "TEXT" if isinstance(kinds[0], str) else value_of(kinds[0])


@pytest.fixture(scope="module")
def every_option() -> list[Option]:
    app = build(listed=True)
    if "view" not in app.resolved_commands():  # its package is not installed
        spec = spec_from_file_location("viewed", VIEW)
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        app.command(module.view, name="view")
    return [*options(app)]


@pytest.fixture(scope="module")
def page() -> PAGE:
    """Value and meaning of each option that several commands have."""
    rows = re.findall(
        r"^(--[a-z-]+)(?:, --no-[a-z-]+)?(?: ([A-Z]+))?: (.+)$", TABLE.read_text(), re.MULTILINE
    )
    return {name: (value, meaning.removesuffix(" …")) for name, value, meaning in rows}


def test_table_lists_the_options_that_several_commands_have(every_option: list[Option], page: PAGE) -> None:
    found: dict[str, set[str]] = {}
    for option in every_option:
        found.setdefault(option.names[0], set()).add(option.verb)
    assert [*page] == sorted(name for name, of in found.items() if len(of) > 1)


def test_option_has_one_meaning_and_one_value_in_all_commands(every_option: list[Option], page: PAGE) -> None:
    wrong = [
        option
        for option in every_option
        if option.names[0] in page
        and (option.value, option.meaning[: len(page[option.names[0]][1])]) != page[option.names[0]]
    ]
    assert not wrong


def test_option_that_can_be_switched_off_has_both_names(every_option: list[Option]) -> None:
    for option in every_option:
        assert not option.names[0].startswith("--no-"), option
        assert option.names[1:] in ((), (f"--no-{option.names[0][2:]}",)), option


def test_renamed_option_names_the_new_one(every_option: list[Option], dxlrun: Callable[..., Any]) -> None:
    known = {(option.verb, name) for option in every_option for name in option.names}
    places = {"servo": ["/dev/none", "1", "get"], "teach": ["new.yaml"], "frames": ["robot.yaml"]}
    for verb, words in verb_registry.RENAMED.items():
        assert words
        for old, new in words.items():
            assert (verb, old) not in known
            assert (verb, new.split()[0]) in known
            if verb == "view":  # may not be installed
                continue
            refused = dxlrun(verb, *places.get(verb, []), old, "7")
            assert (refused.code, refused.errors) == (
                2,
                [f"dxlrun: {old} is {new} now; `dxlrun {verb} --help` shows the usage"],
            )
