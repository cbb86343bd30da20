"""Size of the house: lines, files, functions, classes and data classes, and rooms that import each other.

    python tests/bench/house.py [COMMIT]

of the working tree, or of a commit. Lines are all lines of Python and C, docstrings and comments included.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PARTS = {
    "product": ("runtime/", "plugins/"),
    "core": ("runtime/dxlrun/",),
    "tests": ("tests/",),
}
DATA = ("dataclass", "Struct", "BaseModel", "NamedTuple", "Form")
"""Words by which a class is one that carries data: its decorator or one of its bases."""


def sources(commit: str) -> Iterator[tuple[str, str]]:
    """Yield path and text of each source file."""

    def git(*words: str) -> str:
        command = ["git", *words]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout

    tracked = git("ls-tree", "-r", "--name-only", commit) if commit else git("ls-files")
    for path in tracked.splitlines():
        if path.endswith((".py", ".pyi", ".c")) and path.startswith(("runtime/", "plugins/", "tests/")):
            yield path, git("show", f"{commit}:{path}") if commit else (ROOT / path).read_text()


def is_data(node: ast.ClassDef) -> bool:
    """Return whether a class carries data."""
    made_of = (*node.decorator_list, *node.bases)
    return any(word in ast.unparse(one) for one in made_of for word in DATA)


def circle(imports: dict[str, set[str]]) -> set[str]:
    """Return the rooms that can be reached from themselves."""

    def reached(room: str) -> set[str]:
        found: set[str] = set()
        left = [*imports[room]]
        while left:
            one = left.pop()
            if one not in found:
                found.add(one)
                left += imports[one]
        return found

    return {room for room in [*imports] if room in reached(room)}


def main(commit: str = "") -> None:
    """Print a row for each part of the house, and the rooms that import each other."""
    counts: dict[str, Counter[str]] = {part: Counter() for part in PARTS}
    imports: dict[str, set[str]] = defaultdict(set)
    for path, text in sources(commit):
        found = Counter(lines=text.count("\n"), files=1)
        nodes = list(ast.walk(ast.parse(text))) if path.endswith(".py") else []
        classes = [node for node in nodes if isinstance(node, ast.ClassDef)]
        found["functions"] = sum(isinstance(node, ast.FunctionDef) for node in nodes)
        found["classes"], found["data classes"] = len(classes), sum(map(is_data, classes))
        for part, folders in PARTS.items():
            if path.startswith(folders):
                counts[part] += found
        room = path.removeprefix("runtime/dxlrun/").split("/")[0]
        if path.startswith("runtime/dxlrun/"):
            named = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
            of = {name.split(".")[1] for name in named if name.startswith("dxlrun.")}
            imports[room.removesuffix(".py")] |= of - {room.removesuffix(".py")}
    columns = ("lines", "files", "functions", "classes", "data classes")
    print(f"{'':8}" + "".join(f"{name:>14}" for name in columns))
    for part, count in counts.items():
        print(f"{part:8}" + "".join(f"{count[name]:14,}" for name in columns))
    around = sorted(circle(imports))
    print(f"rooms that import each other: {len(around)} of {len(imports)}: {', '.join(around) or '-'}")


if __name__ == "__main__":
    main(*sys.argv[1:])
