"""Prose: docstrings, comments, messages and pages contain none of the phrases below."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
START = re.compile(r"(What|Whether|That|Of|So|Where|How|By)\b(?!-)")
"""First words of docstrings that stand in place of a noun."""
PHRASES = {
    "anew": r"\banew\b",
    "is no": r"(?<!there )\b(is|are|was|were) no\b(?! (longer|more|less|later|other|better|faster|slower)\b)",
    "behind it": r"\bbehind (it|them)\b",
    "at its end": r"\bat (its|their) end\b",
    "meanwhile": r"\bmeanwhile\b",
    "tell": r"\b(tells?|told)\b(?! (\w+ )?apart)",
    "give way": r"\b(gives?|gave) way\b",
    "many a": r"\bmany an?\b",
    "such a": r"\bsuch an?\b",
    "has to have": r"\b(has|have) to have\b",
    "goes on": r"\b(goes|go|went|gone|going) on\b",
    "beside": r"\bbeside\b",
    "of it": r"\bof it\b",
    "by itself": r"\bby (itself|themselves)\b",
    "in order": r"\bin order\b(?! (to|of|from)\b)",
    "let be": r"\blets? \w+ be\b",
    "leave out": r"\b(left|leaves?|leaving) (\w+ )?out\b",
    "mend": r"\bmend(s|ed|ing)?\b",
}
"""Phrases of a private dialect, with the pattern that finds each."""
MESSAGES = {
    "take out": r"\btake (\w+ )?out\b",
    "started anew": r"\bstart(s|ed)? anew\b",
    "is none of": r"\bis none of\b",
    "what stands": r"\bwhat stands\b",
    "limp": r"\bjoints? without torque\b|\b(has|have|holds) no torque\b(?! (limit|or current mode))",
}
"""Phrases that messages avoid as well."""
UNCHANGED = {
    "runtime/dxlrun/log/schemas.py": "comments of message definitions, whose bytes are the format of logs",
}
"""Files whose texts keep their wording, with the reason."""
_PATTERNS = {name: re.compile(pattern, re.I) for name, pattern in PHRASES.items()}
_IN_MESSAGES = {name: re.compile(pattern, re.I) for name, pattern in MESSAGES.items()}
_CODE = re.compile(r"`[^`]*`")


class Text(NamedTuple):
    """One docstring, comment, description of a key or message."""

    line: int
    text: str
    kind: str
    """`docstring`, `attribute`, `comment`, `description` or `message`."""


def descriptions_of(call: ast.Call) -> Iterator[Text]:
    """Yield the descriptions of keys in a call: `key("...")`, and the argument `description`."""
    found = [one.value for one in call.keywords if one.arg == "description"]
    if isinstance(call.func, ast.Name) and call.func.id == "key":
        found += call.args[:1]
    for value in found:
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            yield Text(value.lineno, value.value, "description")


@lru_cache(1)
def nodes_of(source: str) -> list[ast.AST]:
    return [*ast.walk(ast.parse(source))]


def texts_of(source: str) -> Iterator[Text]:
    """Yield the docstrings, attribute docstrings, descriptions of keys and comments of a Python source."""
    for node in nodes_of(source):
        if isinstance(node, ast.Call):
            yield from descriptions_of(node)
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if text := ast.get_docstring(node):
            # the docstring of a module is `Name: description`
            about = text.partition(": ")[2] if isinstance(node, ast.Module) else text
            yield Text(node.body[0].lineno, about or text, "docstring")
        for before, after in zip(node.body, node.body[1:], strict=False):
            if isinstance(before, ast.Assign | ast.AnnAssign) and isinstance(after, ast.Expr):
                value = after.value
                if isinstance(value, ast.Constant) and isinstance(value.value, str):
                    yield Text(after.lineno, value.value, "attribute")
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not token.string.startswith(("# noqa", "# type:", "#!")):
            yield Text(token.start[0], token.string.lstrip("# "), "comment")


def messages_of(source: str) -> Iterator[Text]:
    """Yield the literals of several words that are not docstrings: messages, help, headings of tables.

    A field of an f-string is `{}`.
    """
    nodes = nodes_of(source)
    skipped = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if isinstance(node, ast.JoinedStr):
            skipped |= {id(part) for part in node.values}
            parts = [part.value if isinstance(part, ast.Constant) else "{}" for part in node.values]
            text = "".join(map(str, parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in skipped:
            text = node.value
        else:
            continue
        if len(re.findall(r"[A-Za-z]{2,}", text)) > 2 and " " in text.strip():
            yield Text(node.lineno, text, "message")


def find_phrases(text: Text) -> Iterator[str]:
    if text.kind not in {"comment", "message"} and (start := START.match(text.text)):
        yield f"begins with {start[1]}"
    plain = _CODE.sub("", " ".join(text.text.split()))
    for name, pattern in (_PATTERNS | (_IN_MESSAGES if text.kind == "message" else {})).items():
        if pattern.search(plain):
            yield name


def product_files() -> list[Path]:
    files = [*(ROOT / "runtime").rglob("*.py"), *(ROOT / "plugins").rglob("*.py")]
    return sorted(path for path in files if "tests" not in path.parts and ".venv" not in path.parts)


def room_of(path: Path) -> str:
    """Return the room of a product file: `dxlwire`, `dxlrun/control`, `dxlrun_lab`."""
    parts = path.relative_to(ROOT).parts[1:]
    return "/".join(parts[:2]) if parts[0] == "dxlrun" else parts[0]


ROOMS = sorted({room_of(path) for path in product_files()})


@pytest.mark.parametrize("room", ROOMS)
def test_code_has_plain_words(room: str) -> None:
    files = [path for path in product_files() if room_of(path) == room]
    assert files
    found = [
        f"{path.relative_to(ROOT)}:{text.line}: {name}: {' '.join(text.text.split())[:90]}"
        for path in files
        for text in (*texts_of(path.read_text()), *messages_of(path.read_text()))
        for name in find_phrases(text)
        if text.kind != "message" or str(path.relative_to(ROOT)) not in UNCHANGED
    ]
    assert not found, "\n" + "\n".join(found)


def hand_written(page: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of a page that are not code and not generated, with their numbers."""

    def blank(part: re.Match[str]) -> str:
        return "\n" * part[0].count("\n")

    text = re.sub(r"```.*?```", blank, page, flags=re.S)
    text = re.sub(r"<!-- (?!end)[^>]*-->.*?<!-- end -->", blank, text, flags=re.S)
    yield from enumerate((_CODE.sub("", line) for line in text.splitlines()), 1)


def test_pages_have_plain_words() -> None:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    pages = [path for path in pages if "changes" not in path.parts]
    assert len(pages) > 20
    found = [
        f"{path.relative_to(ROOT)}:{number}: {name}: {line.strip()[:90]}"
        for path in pages
        for number, line in hand_written(path.read_text())
        for name, pattern in _PATTERNS.items()
        if pattern.search(line)
    ]
    assert not found, "\n" + "\n".join(found)


def test_phrases_in_messages_are_found() -> None:
    source = """
class Joint:
    \'\'\'Joint of a robot, which is no message.\'\'\'
    raise InputError(f"{self.name!r} is no name of a joint; " "take it out")
    refuse("a joint is", f"{left} {right}")
    mode = "is no"
"""
    found = [name for text in messages_of(source) for name in find_phrases(text)]
    assert sorted(found) == ["is no", "take out"]


def test_phrases_are_found() -> None:
    source = '''"""Motor: what it is."""
x = 1  # written anew
"""What was read."""
def read():
    """Return `of it`, which is no code."""
class Joint:
    limits = key("Where it may go.", "1")
    speed = Field(description="Speed at " "its end.")
'''
    found = [name for text in texts_of(source) for name in find_phrases(text)]
    assert sorted(found) == ["anew", "at its end", "begins with What", "begins with Where", "is no"]
