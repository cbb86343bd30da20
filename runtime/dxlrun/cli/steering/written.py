"""Written: a command as `key=value` words or a YAML file, read for the gateway.

Values are YAML, and quantities are texts with units. The gateway, which knows the command's fields, converts
them to numbers, because `positions=[60]` may be meant in deg or in rad.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from dxlrun.cli.inputs import parse_pair
from dxlrun.description.document import PlainDocument, grow, literal, parse, read_text
from dxlrun.errors import DxlrunError, InputError, Problem, Refused

_WORDS = "command line"
_EXAMPLE = "elbow=20deg, or 'positions=[30 deg, 0 deg]'"
_NEXT_KEY = re.compile(r"\s+(?=[^\W\d][\w.]*=)")
"""Space before the next pair of a word with several, such as "x=20cm y=0cm"."""
_UNIT = re.compile(r"[A-Za-z°µ]{1,4}(?:/s(?:\^2)?)?|%")
"""Unit that was written as a word of its own, after its number."""


@dataclass(frozen=True, slots=True)
class WrittenEntry:
    """Keys and values of a command, or of a controller's entry, as the user wrote them."""

    grown: PlainDocument
    in_words: bool
    name: str = ""
    """First word, if it is a name without its key."""

    @classmethod
    def from_words(
        cls, words: Sequence[str], file: Path | None, *, named: bool = False, example: str = _EXAMPLE
    ) -> WrittenEntry:
        """Read `key=value` words, each with one pair or several, or a file.

        Args:
            words: The words.
            file: The file.
            named: The first word may begin with a name without its key.
            example: A pair, for a word that is none.

        Raises:
            InputError: Words and a file are given, a word is not a pair, or the YAML is invalid.
        """
        if file is not None and words:
            raise InputError(f"{words[0]!r} and --file exclude each other; give the words, or the file")
        first = ""
        if file is not None:
            text, name = read_text(file), str(file)
        else:
            for word, after in pairwise(words):
                if (word[-1:] == "=" and "=" not in after) or (after[:1] == "=" and "=" not in word):
                    spaced = word if word[-1:] == "=" else after
                    pair = re.sub(r"\s*=\s*", "=", " ".join(words))
                    raise InputError(f"{spaced!r} is not key=value; write {pair} without spaces at =")
                if "=" in word and word[-1:].isdigit() and _UNIT.fullmatch(after):
                    raise InputError(f"{after!r} is not key=value; write {word}{after} without the space")
            pairs = [pair for word in words for pair in _NEXT_KEY.split(word)]
            if named and pairs and "=" not in pairs[0]:
                first = pairs.pop(0)
            _refuse_repeated(pairs)
            text, name = "\n".join(_line(pair, example) for pair in pairs) or "{}", _WORDS
        try:
            written = cls(grow(parse(text, name), name, literal), in_words=file is None, name=first)
        except InputError as error:
            raise _input_error(error.problems, file is None) from None
        if written.grown.problems:
            raise _input_error(written.grown.problems, file is None)
        return written

    @property
    def data(self) -> dict[str, object]:
        """Values by key, without `name`; quantities are still texts with units."""
        return self.grown.data

    def with_key(self, key: str) -> dict[str, object]:
        """Return the values by key, with `name` under its key; raise InputError if it has none or has two.

        Args:
            key: Key that accepts a name; empty: the command has none.
        """
        if not key:
            _line(self.name)
        if key in self.data:
            raise InputError(
                f"{self.name!r} and {key}={self.data[key]} exclude each other; remove one of them"
            )
        return {key: self.name} | self.data

    def located(self, refused: Refused) -> DxlrunError:
        """Return a refusal with one line for each wrong quantity, or as InputError with places in the YAML
        file.

        A refusal for another reason is returned unchanged.
        """
        from dxlrun.channels.answers import Code

        paths, problems, fixes = (refused.fields.get(name) for name in ("paths", "problems", "fixes"))
        if refused.code != Code.WRONG_QUANTITY:
            return refused
        if not (isinstance(paths, list) and isinstance(problems, list) and isinstance(fixes, list)):
            return refused
        if self.in_words:
            lines = [f"{what}; {fix}" for what, fix in zip(problems, fixes, strict=True)]
            return Refused("\n".join(lines), code=refused.code, fields=refused.fields, wrong_input=True)
        found = []
        for path, what, fix in zip(paths, problems, fixes, strict=True):
            steps = [int(step) if step.isdecimal() else step for step in path.split("/")[1:]]
            found.append(Problem(self.grown.marks.value(*steps), what, fix))
        return InputError(found)


def _refuse_repeated(pairs: Sequence[str]) -> None:
    first: dict[str, str] = {}
    for pair in pairs:
        key = pair.partition("=")[0]
        if key in first:
            raise InputError(f"{key} is given twice, {first[key]} and {pair}; remove one of them")
        first[key] = pair


def _line(word: str, example: str = _EXAMPLE) -> str:
    key, value = parse_pair(word, example)
    if "\n" in value:
        raise InputError(f"the value of {key} has a line break; write it on one line, or give a --file")
    return f"{key}: {value}"


def _input_error(problems: Sequence[Problem], in_words: bool) -> InputError:
    """Return the problems as an error; those of words have no places, because words have no lines and
    columns.
    """
    if not in_words:
        return InputError(problems)
    return InputError("\n".join(f"{problem.what}; {problem.fix}" for problem in problems))
