"""The pages of the documentation; their names are unique, so a test names a page and not its folder."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PATHS = {path.name: path for path in sorted(DOCS.rglob("*.md")) if path.parent.name != "changes"}


def page_text(name: str) -> str:
    return PATHS[name].read_text()


def page_commands(name: str, section: str = "") -> list[list[str]]:
    """Return the words of each command in a line of its own on a page, or in a section, without `dxlrun`."""
    text = page_text(name)
    if section:
        text = text.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    lines = re.findall(r"^    dxlrun (.+)$", text, re.MULTILINE)
    return [shlex.split(line.partition("  #")[0]) for line in lines]


def page_blocks(name: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page_text(name), re.MULTILINE | re.DOTALL)


def shows(block: str, printed: str) -> bool:
    """Return whether a block of a page is what was printed; the number of spaces does not count."""
    pattern = ""
    for line in block.splitlines():
        words = re.escape(" ".join(line.split())).replace(r"\.\.\.", ".*")
        pattern += r"(.*\n)*" if line.strip() == "..." else f"{words} ?\\n"
    return bool(re.fullmatch(pattern, "".join(f"{' '.join(one.split())}\n" for one in printed.splitlines())))
