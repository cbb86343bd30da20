"""House: the reach of features, the imports of packages from inside the core, and the size of each room.

    python bench/house.py [COMMIT] [--names]

Measures a commit, or the working tree without one (its feature commits are those of HEAD). Every commit is
measured by the same rules, so that two of them can be compared. `--names` also lists what was counted: the
feature commits, the imported names, the files and the functions.

- **Product** is Python and C in `runtime/` and `plugins/`, docstrings and comments included, without folders
  `tests/`. **Tests** are `tests/` and the folders `tests/` of packages.
- **A room** is `dxlwire`, `dxlsim`, a package or a module of `dxlrun`, one feature of `dxlrun/features`, or a
  package in `plugins/`.
- **A feature commit** adds at least 40 product lines and removes at most a third of what it adds. Renamed
  files and commits of docstrings (`NO_FEATURES`) do not count. The last 40 of them are shown.
- **A name from inside** is imported by a package from a module of dxlrun, dxlwire or dxlsim that is not a
  face. The faces are `dxlrun` with `dxlrun.messages` and `dxlrun.testing`, the pages of `dxlrun.tooling`,
  and `dxlwire` and `dxlsim` themselves. A name is counted once a package (`in each file`: once a file),
  also inside functions and for type checking.
- **A mention** is a match of a feature's pattern (`MENTIONS`) in code: not in a docstring, a comment or a
  text with blanks, such as a message. A feature's own folder is not counted, nor are tests. "Sensor" is each
  identifier or key with this word, but for messages of ROS and controllers that publish states; drivers in
  packages count. It replaces a pattern of the general idea of a source, which is anything with states or
  commands that is not a joint, such as a device: the core has to know that.
- **A function without an object** is a public function or method whose name is one of `BARE_VERBS`.
- **A parameter** is one of a function or method, without `self` and those of protocols, or a field of
  a dataclass that its constructor takes. It is **only handed on** if each use is an argument of a call, or
  an assignment to an attribute of `self` of which each use in the class is an argument of a call.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import statistics
import subprocess
import tarfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
CODE = (".py", ".pyi", ".c", ".h")
LAST = 40
MOST_PARAMETERS = 8
"""Constructors with more of them are listed."""
NO_FEATURES = ("packages: describe what belongs in each folder and what does not",)
"""Subjects of commits that add as many lines as a feature, but only docstrings."""
LIBRARIES = ("dxlrun", "dxlwire", "dxlsim")
FACES = ("dxlrun", "dxlrun.messages", "dxlrun.testing", "dxlrun.tooling", "dxlwire", "dxlsim")


class Mention(NamedTuple):
    """A feature: the pattern of its identifiers and keys, and its folder below `runtime/dxlrun/features/`."""

    pattern: str
    folder: str = ""
    elsewhere: str = r"$^"
    """Pattern of paths in which these words have another meaning."""


MENTIONS = {
    "device command": Mention(r"(?i)device_?commands?", "devices"),
    "transmission, coupling": Mention(
        r"(?i)transmission|coupling",
        "mechanics",
        r"(dxlsim|simulation)/bus/",  # bytes on a line
    ),
    "sensor": Mention(r"(?i)sensor(?!_msgs|_?broadcaster)", "sensors"),
    "register declaration": Mention(
        r"\b(servo|joint|described|desired|own)\.registers\b(?! import)|registers: dict\[ItemName|'registers'"
        r"|compile_registers|declared_registers|declarable|steered_value|ComparedSetting",
        "registers",
        r"(dxlsim|simulation)/",  # the memory of a simulated servo
    ),
}
LINEAR = Mention(
    r"\.linear\b(?!\.)|\blinear: bool|\blinear: tuple\[bool|\blinear="
    r"|\b(is|is not|==|!=) (JointUnit\.)?(LINEAR|ROTARY)\b"
)
"""Asks whether a joint is linear. The linear part of a twist (`twist.linear.x`) does not."""
BARE_VERBS = frozenset(
    word
    for line in (
        "accept act adopt advance answer apply ask begin check clear collect commit compare decide",
        "describe draw drop emit end engage enter execute expire fail feed fill find finish follow forget",
        "get give hand hear hold inspect judge known learn leave listen look make measure mend merge move",
        "note of perform place play poll post prepare protect put reach read receive recount refuse",
        "release renew repeat require rest resume say see serve set settle show shown step take tell",
        "touch turn unload wait watch write written",
    )
    for word in line.split()
)
"""Verbs, and words in place of one, that say nothing without an object.

Not in the list: words with one meaning for every reader (`append`, `close`, `flush`, `main`, `open`, `parse`,
`run`, `scan`, `send`, `start`, `stop`, `update`), and nouns, such as `rows`.
"""


def git(*words: str) -> bytes:
    """Return the output of a git command in this repository."""
    command = ["git", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout


def read_sources(commit: str) -> dict[str, str]:
    """Return the text of each source file of a commit, or of the working tree, by its path."""
    folders = ("runtime", "plugins", "tests", "bench")
    if not commit:
        files = (path for folder in folders for path in sorted((ROOT / folder).rglob("*")))
        return {f"{path.relative_to(ROOT)}": path.read_text() for path in files if path.name.endswith(CODE)}
    folders = tuple(git("ls-tree", "--name-only", commit, *folders).decode().split())  # it may have fewer
    with tarfile.open(fileobj=io.BytesIO(git("archive", commit, *folders))) as tar:
        members = {member.name: tar.extractfile(member) for member in tar if member.name.endswith(CODE)}
        return {path: file.read().decode() for path, file in members.items() if file is not None}


def is_product(path: str) -> bool:
    """Return whether a source file is part of the product."""
    return path.startswith(("runtime/", "plugins/")) and path.endswith(CODE) and "/tests/" not in path


def room_of(path: str) -> str:
    """Return the room of a product file."""
    base, *parts = path.split("/")
    if base == "plugins" or parts[0] != "dxlrun":
        return parts[0]
    depth = 3 if parts[1] == "features" else 2
    return "/".join(parts[:depth] if len(parts) > depth else parts).removesuffix(".py")


class FeatureCommit(NamedTuple):
    """One commit that adds a feature."""

    subject: str
    added: int
    removed: int
    files: frozenset[str]

    @property
    def rooms(self) -> set[str]:
        """Rooms of its files."""
        return {room_of(path) for path in self.files}

    @property
    def folders(self) -> set[str]:
        """Folders of its files."""
        return {path.rpartition("/")[0] for path in self.files}


def feature_commits(commit: str) -> Iterator[FeatureCommit]:
    """Yield the feature commits up to a commit, newest first."""
    log = git("log", "--no-merges", "-M", "--numstat", "--format=@%h %s", commit or "HEAD").decode()
    for entry in re.split(r"^@", log, flags=re.MULTILINE)[1:]:
        subject, *lines = entry.splitlines()
        changes = [line.split("\t", 2) for line in lines if line.strip()]
        counted = [each for each in changes if is_product(each[2]) and "=>" not in each[2] and each[0] != "-"]
        added, removed = (sum(int(each[column]) for each in counted) for column in (0, 1))
        if added >= 40 and added >= 3 * removed and not subject.endswith(NO_FEATURES):
            yield FeatureCommit(subject, added, removed, frozenset(each[2] for each in counted))


def imported_names(texts: dict[str, str]) -> Iterator[tuple[str, str, bool]]:
    """Yield path, name and whether it is from a face, of each name that a package imports from a library."""
    modules = {re.sub(r"(/__init__)?\.pyi?$", "", path.removeprefix("runtime/")) for path in texts}
    for path, text in texts.items():
        if not path.startswith("plugins/") or not path.endswith(".py"):
            continue
        names: set[tuple[str, str]] = set()  # module and name
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Import):
                names |= {(alias.name, "") for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names |= {(str(node.module), alias.name) for alias in node.names}
        for module, name in names:
            whole = f"{module}.{name}".rstrip(".")
            page = module if whole.replace(".", "/") not in modules else whole
            of_face = page in FACES or page.startswith("dxlrun.tooling.")
            if module.split(".")[0] in LIBRARIES:
                yield path, whole, of_face


class _Code(ast.NodeTransformer):
    """Empties docstrings and all other texts with blanks."""

    def visit_Constant(self, node: ast.Constant) -> ast.Constant:
        prose = isinstance(node.value, str) and re.search(r"\s", node.value)
        return ast.copy_location(ast.Constant(""), node) if prose else node


def code_of(path: str, text: str) -> str:
    """Return a file's code without comments, docstrings and texts with blanks."""
    if path.endswith((".py", ".pyi")):
        return ast.unparse(_Code().visit(ast.parse(text)))
    return re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.DOTALL)


def mentioning(codes: dict[str, str], mention: Mention) -> list[str]:
    """Return the files outside a feature's folder whose code mentions it."""
    own = f"runtime/dxlrun/features/{mention.folder}/" if mention.folder else "\n"
    found = (path for path, code in codes.items() if re.search(mention.pattern, code))
    return [path for path in found if not path.startswith(own) and not re.search(mention.elsewhere, path)]


def bare_functions(texts: dict[str, str]) -> Iterator[tuple[str, str]]:
    """Yield path and name of each public function or method whose name is a bare verb."""
    for path, text in texts.items():
        for holder in ast.walk(ast.parse(text if path.endswith(".py") else "")):
            for node in holder.body if isinstance(holder, ast.Module | ast.ClassDef) else ():
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name in BARE_VERBS:
                    yield path, node.name


class Parameter(NamedTuple):
    """One parameter of a function, a method or a constructor."""

    path: str
    owner: str
    """Name of the function; of a constructor that of the class."""
    is_built: bool
    """True for a constructor."""
    handed_on: bool


def parameters(texts: dict[str, str]) -> Iterator[Parameter]:
    """Yield each parameter of the functions and the dataclasses."""
    for path, text in texts.items():
        tree = ast.parse(text if path.endswith(".py") else "")
        parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
        for node in ast.walk(tree):
            holder = parents.get(node)
            owner = holder if isinstance(holder, ast.ClassDef) else None
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                if owner is not None and "Protocol" in "".join(map(ast.unparse, owner.bases)):
                    continue
                built = owner is not None and node.name == "__init__"
                for name in _names_of(node, method=owner is not None):
                    handed_on = _is_handed_on(node, name, owner, parents)
                    yield Parameter(path, owner.name if built and owner else node.name, built, handed_on)
            elif isinstance(node, ast.ClassDef):
                for name in _fields_of(node):
                    handed_on = name.startswith("_") and _is_attribute_handed_on(node, name, parents)
                    yield Parameter(path, node.name, True, handed_on)


def _names_of(node: ast.FunctionDef | ast.AsyncFunctionDef, *, method: bool) -> list[str]:
    given = node.args
    names = [one.arg for one in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    is_static = any(ast.unparse(one) == "staticmethod" for one in node.decorator_list)
    return names[1:] if method and not is_static else names


def _fields_of(node: ast.ClassDef) -> Iterator[str]:
    """Yield the fields of a dataclass that its constructor takes."""
    if not any(ast.unparse(one).startswith("dataclass") for one in node.decorator_list):
        return
    for line in node.body:
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
            text = ast.unparse(line)
            if "ClassVar" not in text and "init=False" not in text:
                yield line.target.id


def _is_argument(node: ast.AST, parents: dict[ast.AST, ast.AST]) -> bool:
    while isinstance(parents[node], ast.keyword | ast.Starred):
        node = parents[node]
    call = parents[node]
    return isinstance(call, ast.Call) and node is not call.func


def _is_handed_on(
    function: ast.AST, name: str, owner: ast.ClassDef | None, parents: dict[ast.AST, ast.AST]
) -> bool:
    uses = [one for one in ast.walk(function) if isinstance(one, ast.Name) and one.id == name]
    return bool(uses) and all(
        _is_argument(one, parents) or _is_attribute_handed_on(owner, _kept_as(parents[one], one), parents)
        for one in uses
    )


def _kept_as(statement: ast.AST, value: ast.AST) -> str:
    """Return the attribute in `self.attribute = value`; empty: it is another statement."""
    if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is value:
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        holder, _, attribute = ast.unparse(targets[0]).partition(".")
        return attribute if holder == "self" and len(targets) == 1 else ""
    return ""


def _is_attribute_handed_on(owner: ast.ClassDef | None, name: str, parents: dict[ast.AST, ast.AST]) -> bool:
    nodes = ast.walk(owner) if owner is not None and name else ()
    uses = [
        one
        for one in nodes
        if isinstance(one, ast.Attribute)
        and isinstance(one.ctx, ast.Load)
        and ast.unparse(one) == f"self.{name}"
    ]
    return bool(uses) and all(_is_argument(one, parents) for one in uses)


def large_constructors(found: Iterable[Parameter]) -> list[tuple[int, str, str]]:
    """Return parameters, path and name of the constructors of more than MOST_PARAMETERS, largest first."""
    counts = Counter((one.path, one.owner) for one in found if one.is_built)
    large = [(count, path, owner) for (path, owner), count in counts.items() if count > MOST_PARAMETERS]
    return sorted(large, reverse=True)


def print_rows(title: str, heads: Iterable[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table: a title, the heads of its columns of numbers, and its rows."""
    print(f"\n{title:40}" + "".join(f"{head:>14}" for head in heads))
    for name, *values in rows:
        numbers = (f"{each:14,}" if isinstance(each, int) else f"{each:>14}" for each in values)
        print(f"{name:40}" + "".join(numbers))


def print_reach(features: list[FeatureCommit], *, names: bool) -> None:
    """Print files, rooms and folders of feature commits."""
    if names:
        for one in features:
            counts = f"{len(one.files):3} files {len(one.rooms):2} rooms {len(one.folders):2} folders"
            print(f"{counts}  +{one.added} -{one.removed}  {one.subject[:80]}")
    spans = {
        "files": [len(one.files) for one in features],
        "rooms": [len(one.rooms) for one in features],
        "folders": [len(one.folders) for one in features],
    }
    print_rows(
        f"Reach of the last {len(features)} feature commits",
        ("median", "mean", "most", "share of one"),
        [
            (
                name,
                f"{statistics.median(counts):g}",
                f"{statistics.mean(counts):.1f}",
                max(counts),
                f"{100 * counts.count(1) / len(counts):.0f} %",
            )
            for name, counts in spans.items()
        ],
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("commit", nargs="?", default="", metavar="COMMIT")
    parser.add_argument("--names", action="store_true", help="also list what was counted")
    options = parser.parse_args()
    texts = read_sources(options.commit)
    product = {path: text for path, text in texts.items() if is_product(path)}
    codes = {path: code_of(path, text) for path, text in product.items()}

    def listed(words: Iterable[str]) -> None:
        if options.names:
            print(*(f"    {word}" for word in sorted(words)), sep="\n")

    print_reach([*feature_commits(options.commit)][:LAST], names=options.names)

    imports = [*imported_names(product)]
    inside = [(path.split("/")[1], name) for path, name, of_face in imports if not of_face]
    faces = [(path.split("/")[1], name) for path, name, of_face in imports if of_face]
    counts = [Counter(package for package, _ in each) for each in (set(inside), inside, set(faces))]
    packages = sorted({path.split("/")[1] for path in product if path.startswith("plugins/")})
    rows: list[Sequence[object]] = [(package, *(count[package] for count in counts)) for package in packages]
    totals = ("in all", *(count.total() for count in counts))
    print_rows("Names that packages import", ("from inside", "in each file", "from faces"), [*rows, totals])
    listed(f"{package}: {name}" for package, name in set(inside))

    print_rows("Files that mention", ("files", "rooms"), [])
    for name, mention in {**MENTIONS, "whether a joint is linear": LINEAR}.items():
        files = mentioning(codes, mention)
        print(f"{name:40}{len(files):14}{len({room_of(path) for path in files}):14}")
        listed(files)

    bare = [*bare_functions(product)]
    often = Counter(name for _, name in bare).most_common(10)
    print_rows("Public functions without an object", ("functions",), [("in all", len(bare)), *often])
    listed(f"{path}: {name}" for path, name in bare)

    found = [*parameters(product)]
    large = large_constructors(found)
    handed_on = Counter(room_of(one.path) for one in found if one.handed_on)
    given = Counter(room_of(one.path) for one in found)
    share = f"{100 * handed_on.total() / given.total():.1f} %"
    whole_share = ("in all", given.total(), handed_on.total(), share)
    print_rows("Parameters", ("parameters", "handed on", "share"), [whole_share])
    print_rows("Constructors", (f"of over {MOST_PARAMETERS}",), [("in all", len(large))])
    listed(f"{path}: {owner} {count}" for count, path, owner in large)

    lines: Counter[str] = Counter()
    in_room = Counter(room_of(path) for path in product)
    for path, text in product.items():
        lines[room_of(path)] += text.count("\n")
    heads = ("lines", "files", "parameters", "handed on")
    rooms = [(room, lines[room], in_room[room], given[room], handed_on[room]) for room in sorted(in_room)]
    print_rows("Rooms", heads, rooms)
    tests = [text.count("\n") for path, text in texts.items() if path not in product]
    whole = [("product", lines.total(), len(product)), ("tests", sum(tests), len(tests))]
    print_rows("The whole", ("lines", "files"), whole)


if __name__ == "__main__":
    main()
