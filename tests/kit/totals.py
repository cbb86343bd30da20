"""Totals: the counts that the analysis makes of a log, and the check of a line about its verdict."""

import re
from pathlib import Path
from typing import Any

from dxlrun import open_log
from dxlrun_analysis.tally import RunTotals, Tally


def totals_of(path: str | Path) -> RunTotals:
    """Count the log at a path, slice by slice. Raises LogError when it cannot be read."""
    tally, reader = Tally(), open_log(path)
    for part in reader.slices():
        tally.add_slice(part)
    return tally.totals(reader.about)


def holds(verdict: Any, text: str) -> bool:
    """Check whether a line of what is expected is true of a verdict."""
    word, _, rest = text.partition(": ")
    if text in ("good", "not good"):
        return bool(verdict.good == (text == "good"))
    if text.startswith("word "):
        return bool(verdict.word == text.removeprefix("word "))
    if word.isdigit():
        return bool(verdict.sentences[int(word)].startswith(rest))
    if word.endswith(" lacks"):
        return rest not in verdict.sentences[int(word.removesuffix(" lacks"))]
    if word in ("any", "none"):
        return any(rest in one.line for one in verdict.findings) == (word == "any")
    found = re.fullmatch(r"(has|no fix|no|says|fix) (\w+) ?(.*?)(?: as (\w+))?", word)
    assert found, f"{text!r} is not expected of a verdict"
    kind, code, subject, rank = found.groups()
    own = [one for one in verdict.findings if one.code == code and subject in ("", one.subject)]
    checks = {
        "has": lambda: any(rank in (None, one.rank.name.lower()) for one in own),
        "no": lambda: not own,
        "says": lambda: any(rest in one.sentence for one in own),
        "fix": lambda: any(rest in one.remedy for one in own),
        "no fix": lambda: own and not any(one.remedy and rest in one.remedy for one in own),
    }
    return bool(checks[kind]())
