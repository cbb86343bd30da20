"""The tests themselves: each has a time limit, draws the same examples at each run, and is in the sdist."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
import pytest_timeout
import tests.kit
from hypothesis import settings
from tests.kit.awaited import until
from tests.kit.loaded import loaded
from tests.kit.nested import run_pytest

ROOT = Path(__file__).parents[1]
SHIPPED = ("docs", "plugins", "release", "robots", "runtime", "tests")


def run(*words: str, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run this interpreter without the options of the tests' own run."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTEST", "COV_"))}
    words = (sys.executable, *words)
    return subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_every_test_has_a_limit(pytestconfig: pytest.Config) -> None:
    assert 0 < float(pytestconfig.getini("timeout")) <= 120


def test_numpy_computes_in_one_thread() -> None:
    code = "import numpy, os; print(len(os.listdir('/proc/self/task')))"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        == "1\n"
    )


def test_limit_grows_with_the_load(pytestconfig: pytest.Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page is drawn without a graphics processor for 110 s beside 23 programs on two cores."""
    given: list[float] = []
    monkeypatch.setattr(
        pytest_timeout, "pytest_timeout_set_timer", lambda _, settings: not given.append(settings.timeout)
    )
    settings = pytest_timeout.Settings(*[None] * len(pytest_timeout.Settings._fields))._replace(timeout=120.0)
    for load in (0.1, 12.0):
        monkeypatch.setattr(os, "getloadavg", lambda load=load: (load * (os.cpu_count() or 1), 0.0, 0.0))
        pytestconfig.hook.pytest_timeout_set_timer(item=None, settings=settings)
    assert given == [120.0, 1440.0]


@pytest.mark.skipif(not (ROOT / ".ci").exists(), reason="an sdist has no .ci")
def test_no_job_of_ci_outlives_it(tmp_path: Path) -> None:
    _, jobs, rest = (ROOT / ".ci/run").read_text().partition("declare -A job")
    head = jobs + rest[: rest.index("trap 'exit 143'")]
    slow = """slow() { bash -c 'echo $$ > pid; exec sleep 1000'; }
        start slow; until [ -s pid ]; do sleep 0.01; done; false"""
    command = ["/bin/bash", "-c", f"set -euo pipefail; work=$PWD/work\n{head}\n{slow}"]
    assert subprocess.run(command, cwd=tmp_path, check=False).returncode == 1
    process = Path("/proc", (tmp_path / "pid").read_text().strip())
    until(lambda: not process.exists(), "end of a job that was killed")  # else it sleeps on


CLOCKS = {"monotonic", "monotonic_ns", "perf_counter", "time", "time_ns"}
DURATIONS = {
    "tests/kit/awaited.py": "the deadline",
    "tests/kit/hands.py": "a hand turns a servo for so long",
    "tests/ros2/foreign.py": "runs in a ROS environment, without the kit",
    "tests/run/test_pairs.py": "a pause that ends early; what is left is then ended by `dxlrun stop`",
}
"""Files with a loop that looks at a clock, and why."""


def reads_clock(node: ast.AST) -> bool:
    """Check for a call such as `time.monotonic()`."""
    return any(
        isinstance(call, ast.Call)
        and isinstance(call.func, ast.Attribute)
        and call.func.attr in CLOCKS
        and getattr(call.func.value, "id", "") == "time"
        for call in ast.walk(node)
    )


GIVING_UP = {"communicate", "run", "check_output", "create_connection", "HTTPConnection", "HTTPSConnection"}
"""Calls with a `timeout`."""


def deadlines(source: str) -> list[int]:
    """Return the lines of loops that compare a clock, and of waits for a process or peer for some seconds."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.While):
            found += [
                node.lineno for one in ast.walk(node) if isinstance(one, ast.Compare) and reads_clock(one)
            ]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            given = {one.arg: one.value for one in node.keywords}
            timeout = given.get("timeout") if node.func.attr in GIVING_UP else None
            place = ast.unparse(node.func.value)
            awaited = node.func.attr == "wait" and re.search(r"process|child|ran\b", place)
            if awaited or node.func.attr == "settimeout":
                timeout = node.args[0] if node.args else given.get("timeout")
            if isinstance(timeout, ast.Constant) and timeout.value:
                found.append(node.lineno)
    return found


def test_deadlines_are_in_the_kit() -> None:
    """A deadline of its own makes a test fail on a busy machine: `until` and DEADLINE_S of kit/awaited.py."""
    texts = {str(path.relative_to(ROOT)): path.read_text() for path in ROOT.glob("tests/**/*.py")}
    found = {path: lines for path, text in texts.items() if (lines := deadlines(text))}
    assert {path: lines for path, lines in found.items() if path not in DURATIONS} == {}
    assert set(found) == set(DURATIONS)


@pytest.mark.parametrize(
    "source",
    [
        "while not ready() and time.monotonic() < end:\n    pass",
        "while True:\n    assert time.time() < give_up",
        "process.communicate(timeout=60)",
        "run.process.wait(20)",
        "subprocess.run(words, timeout=5.0)",
        "http.client.HTTPConnection(host, timeout=20)",
        "end.settimeout(10)",
    ],
)
def test_deadline_is_found(source: str) -> None:
    assert deadlines(source) == [1]


CHECKING = re.compile(r"(?:^|_)(?:assert|check|require|judge|raises|warns|fail|until|replayed)(?:_|$)")
FILLED = {"range", "np.linspace", "itertools.count", "count"}
"""Calls whose result always has something in it."""


def is_full(node: ast.AST, known: set[str]) -> bool:
    """Check whether an expression surely has something in it: a literal, a constant, or what is known."""
    full = False
    match node:
        case ast.Name() | ast.Attribute():
            name = ast.unparse(node)
            full = name in known or name.rpartition(".")[2][0].isupper()
        case ast.Constant():
            full = bool(node.value)
        case ast.Dict():
            full = bool(node.keys)
        case ast.Starred() | ast.Subscript():
            full = is_full(node.value, known)
        case ast.BinOp():
            full = is_full(node.left, known) or is_full(node.right, known)
        case ast.Tuple() | ast.List() | ast.Set():
            full = any(not isinstance(one, ast.Starred) or is_full(one, known) for one in node.elts)
        case ast.ListComp() | ast.GeneratorExp() | ast.SetComp() | ast.DictComp():
            full = all(not one.ifs and is_full(one.iter, known) for one in node.generators)
        case ast.Call():
            parts = [*node.args, *ast.iter_child_nodes(node.func)]  # `items` of what?
            full = ast.unparse(node.func) in FILLED or any(is_full(one, known) for one in parts)
    return full


def unseen_loops(source: str) -> Iterator[str]:
    """Yield the tests that check only in loops over what may be empty, with the line of the first loop."""
    for test in ast.walk(ast.parse(source)):
        if not isinstance(test, ast.FunctionDef) or not test.name.startswith("test"):
            continue
        known = {one.arg for one in test.args.args}
        loops: list[ast.For | None] = []

        def visit(nodes: Iterable[ast.AST], unseen: ast.For | None, known: set[str], loops: list) -> None:
            for node in nodes:
                if isinstance(node, ast.Assign | ast.AnnAssign) and node.value and is_full(node.value, known):
                    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                    known.update(map(ast.unparse, targets))
                called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
                if isinstance(node, ast.Assert) or CHECKING.search(called.rpartition(".")[2]):
                    loops.append(unseen)
                    named = [one for one in ast.walk(node) if isinstance(one, ast.Name | ast.Attribute)]
                    known.update(map(ast.unparse, named))
                empty = isinstance(node, ast.For) and not is_full(node.iter, known)
                visit(ast.iter_child_nodes(node), unseen or (node if empty else None), known, loops)

        visit(test.body, None, known, loops)
        if loops and all(loops):
            yield f"{loops[0].lineno} {test.name}"


def test_index_of_the_kit_has_each_module() -> None:
    modules = {path.stem for path in (ROOT / "tests/kit").glob("[a-z]*.py")}
    assert modules <= {*re.findall(r"\w+", tests.kit.__doc__ or "")}


def test_loops_with_assertions_show_that_they_ran() -> None:
    """Write `assert found` before `for one in found`: a loop over nothing checks nothing."""
    texts = {path: path.read_text() for path in ROOT.glob("tests/**/test_*.py")}
    found = [
        f"{path.relative_to(ROOT)}:{loop}" for path, text in texts.items() for loop in unseen_loops(text)
    ]
    assert found == []


@pytest.mark.parametrize(
    ("body", "found"),
    [
        ("for one in found():\n        assert one", ["2 test_made_up"]),
        ("rows = found()\n    for one in rows:\n        assert one", ["3 test_made_up"]),
        ("rows = found()\n    assert rows\n    for one in rows:\n        assert one", []),
        ("for one in (1, 2):\n        assert one", []),
        ("for one in found():\n        assert one\n    assert two", []),
        ("for one in given:\n        assert one", []),
    ],
)
def test_loop_that_may_be_empty_is_found(body: str, found: list[str]) -> None:
    assert [*unseen_loops(f"def test_made_up(given):\n    {body}\n")] == found


def test_packages_that_the_import_linter_does_not_see_import_only_the_faces() -> None:
    """They are distributions of their own, with a folder `src`, and need not be installed here."""
    house = loaded(ROOT / "bench/house.py")
    names = list(house.imported_names(house.read_sources("")))
    own = {path.split("/")[1] for path, _, _ in names if "/src/" in path}
    assert own >= {"dxlrun_ros2", "dxlrun_view"}
    inside = [f"{path}: {name}" for path, name, of_face in names if "/src/" in path and not of_face]
    assert inside == []
    for path in ROOT.glob("plugins/*/src/**/*.py"):
        others = re.findall(r"from (dxlrun_(?:analysis|controllers)\S*) import", path.read_text("utf-8"))
        assert [name for name in others if not name.startswith("dxlrun_controllers.laws.")] == []


SKIPS = {
    "import": "import not_there",
    "part": "from not_there.part import thing",
    "marked": "raise RuntimeError('it is marked with its extra')",
}
FAILURES = {
    "other_module": "import not_there_either",
    "message": "raise RuntimeError('Arrow needs pyarrow: pip install dxlrun[table]')",
    "output": "print(\"No module named 'not_there'; dxlrun[table]\")\n    assert 1 == 2",
    "own_error": "raise ImportError('not_there')",
    "called": "call()",
}
CALLED = """
import pytest

code = compile("def call():\\n    import not_there\\n", "/elsewhere/product.py", "exec")
exec(code)
"""


def test_only_an_own_import_or_a_mark_skips_what_lacks_an_extra(tmp_path: Path) -> None:
    """A failure stays one, whatever it says: of a module that a command lacks, too."""
    tests = [f"def test_{name}():\n    {body}\n" for name, body in (SKIPS | FAILURES).items()]
    marked = "def test_marked", '@pytest.mark.needs("table")\ndef test_marked'
    source = "\n".join([CALLED, *tests]).replace(*marked)
    conftest = (ROOT / "tests/conftest.py").read_text()
    table = re.sub(r"(EXTRAS: .*?= )\{.*?\n\}", r'\1{"table": ("not_there",)}', conftest, flags=re.DOTALL)
    files = {"test_import.py": "import not_there\n", "test_made_up.py": source, "conftest.py": table}
    ran = run_pytest(tmp_path, files, "-n", "0", "-rfE")
    assert f"{len(FAILURES)} failed, {len(SKIPS) + 1} skipped" in ran.out, ran.out
    assert "not run: import, made_up needs dxlrun[table]\n" in ran.out
    failed = re.findall(r"^FAILED .*::test_(\w+)", ran.out, re.MULTILINE)
    assert sorted(failed) == sorted(FAILURES)


def test_a_property_draws_the_same_examples_again() -> None:
    assert settings().derandomize


def built(target: str, folder: Path) -> Path:
    """Return the sdist or the wheel."""
    ran = run("-m", "hatchling", "build", "--target", target, "--directory", str(folder))
    assert ran.returncode == 0, ran.stdout + ran.stderr
    (archive,) = folder.iterdir()
    return archive


def test_sdist_has_every_file_of_its_folders(tmp_path: Path) -> None:
    archive = built("sdist", tmp_path)
    with tarfile.open(archive) as tar:
        packed = {name.partition("/")[2] for name in tar.getnames()}
    found = (path for folder in SHIPPED for path in (ROOT / folder).rglob("*") if path.is_file())
    made = {"__pycache__", "build", "logs"}
    # the kernel is compiled where the package is installed
    files = {path.relative_to(ROOT) for path in found if path.suffix != ".so" and not made & set(path.parts)}
    assert {str(path) for path in files} - packed == set()


def test_sdist_has_nothing_of_an_environment_in_its_folder(tmp_path: Path) -> None:
    for name in ("pyproject.toml", "README.md", "LICENSE", "hatch_build.py"):
        shutil.copy(ROOT / name, tmp_path)
    for name in ("ros/lib/runtime/module.py", "ros/lib/LICENSE", "docs/explanation/architecture.md"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    ran = run("-m", "hatchling", "build", "--target", "sdist", folder=tmp_path)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    (archive,) = tmp_path.glob("dist/*.tar.gz")
    with tarfile.open(archive) as tar:
        packed = {name.partition("/")[2] for name in tar.getnames()}
    assert "docs/explanation/architecture.md" in packed
    assert not any(name.startswith("ros/") for name in packed)


def test_variables_only_name_what_is_elsewhere() -> None:
    """Options and marks select tests; a variable has the place of something that is not in the repository."""
    texts = [path.read_text() for path in ROOT.glob("tests/**/*.py")]
    read = (
        r"(?:getenv\(|environ\.get\(|environ\[)\s*\"(DXLRUN_\w+)\"|\"(DXLRUN_\w+)\" (?:not )?in os\.environ"
    )
    names = {name for text in texts for pair in re.findall(read, text) for name in pair if name}
    assert names == {"DXLRUN_BAM_RECORDINGS", "DXLRUN_LEROBOT_PYTHON", "DXLRUN_ROS2_PYTHON"}


def test_each_fragment_of_the_changelog_is_one_that_towncrier_takes() -> None:
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["towncrier"]
    kinds = {one["directory"] for one in config["type"]}
    fragments = [path.name for path in (ROOT / config["directory"]).iterdir()]
    assert [name for name in fragments if not re.fullmatch(rf"\+[\w-]+\.({'|'.join(kinds)})\.md", name)] == []
    assert config["start_string"] in (ROOT / config["filename"]).read_text()


def test_wheel_has_every_object_robot_and_motion(tmp_path: Path) -> None:
    """For `dxlrun examples`; the top level of the repository stays their only source."""
    with zipfile.ZipFile(built("wheel", tmp_path)) as archive:
        compiled = {
            one.filename for one in archive.filelist if one.filename.endswith(".so") and one.file_size
        }
        # The yardstick of `dxlrun latency` is compiled when it is used.
        folders = (ROOT / "runtime", ROOT / "plugins/dxlrun_analysis")
        found = (path.relative_to(ROOT) for folder in folders for path in folder.rglob("*.c"))
        sources = (Path(*path.parts[1:]) for path in found)
        assert compiled == {str(one.with_name(f"lib{one.stem}.so")) for one in sources}
        names = [name for name in archive.namelist() if name.startswith("dxlrun/examples/")]
        shipped = {Path(name).relative_to("dxlrun/examples"): archive.read(name) for name in names}
    tracked = [
        path for path in (ROOT / "robots").rglob("*") if path.suffix in {".yaml", ".urdf", ".json", ".py"}
    ]
    assert shipped == {path.relative_to(ROOT / "robots"): path.read_bytes() for path in tracked}


RUNTIME = ROOT / "runtime"
MOST_ENTRIES = 16
MOST_ROOMS = 19
"""In the package itself, whose rooms docs/explanation/architecture.md lists."""


def entries(folder: Path) -> list[Path]:
    """Return what a reader finds in a folder: its modules, with what they have in C, and rooms."""
    made = {"__init__.py", "__init__.pyi", "__main__.py", "py.typed", "__pycache__"}
    found = [path for path in folder.iterdir() if path.name not in made and path.suffix != ".so"]
    return [path for path in found if path.suffix != ".c" or not path.with_suffix(".py").exists()]


def test_no_folder_of_the_package_is_crowded() -> None:
    """A reader takes in a dozen entries or so at a glance; more of them need a room of their own."""
    found = [path.parent for base in ("runtime", "plugins") for path in (ROOT / base).rglob("__init__.py")]
    rooms = [
        room for room in found if "build" not in room.relative_to(ROOT).parts
    ]  # what an installation made
    most = {RUNTIME / "dxlrun": MOST_ROOMS, ROOT / "plugins/dxlrun_analysis": 25}
    crowded = [room for room in rooms if len(entries(room)) > most.get(room, MOST_ENTRIES)]
    assert [str(room.relative_to(ROOT)) for room in crowded] == []
    assert len(rooms) > 20


def described_by(folder: Path) -> str:
    """Return the docstring of a package; of another folder its README, or the nearest one above it."""
    if (folder / "__init__.py").exists():
        return ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or ""
    above = [folder, *folder.parents[: len(folder.relative_to(ROOT).parts) - 2]]
    return next((path.read_text() for one in above if (path := one / "README.md").exists()), "")


def test_each_folder_says_what_belongs_there_and_what_does_not() -> None:
    """The first sentence says what belongs there, and the second what does not, or where it is."""
    made = {"__pycache__", "build", "node_modules", "logs"}
    files = [path.relative_to(ROOT) for base in ("runtime", "plugins") for path in (ROOT / base).rglob("*.*")]
    files = [path for path in files if path.suffix != ".so" and not made & set(path.parts)]
    folders = {
        folder for path in files for folder in path.parents if folder.parts and (ROOT / path).is_file()
    }
    texts = {folder: described_by(ROOT / folder) for folder in sorted(folders)}
    sentences = {str(folder): len(re.findall(r"\.(?=\s|$)", text)) for folder, text in texts.items()}
    assert [name for name, count in sentences.items() if count < 2] == []
    assert len(sentences) > 70


def test_the_readmes_of_both_levels_name_every_package() -> None:
    for base in (RUNTIME, ROOT / "plugins"):
        named = set(re.findall(r"`(\w+)`", (base / "README.md").read_text()))
        packages = {one.name for one in base.iterdir() if one.is_dir() and any(one.rglob("*.py"))}
        assert packages - named == set()


def imports() -> dict[str, set[str]]:
    """Return which of our modules each module imports: also in functions, and for type checking only."""
    modules: dict[str, Path] = {}
    for path in (RUNTIME / "dxlrun").rglob("*.py*"):
        if path.suffix not in {".py", ".pyi"}:
            continue
        modules[".".join(path.relative_to(RUNTIME).with_suffix("").parts).removesuffix(".__init__")] = path
    found: dict[str, set[str]] = {name: set() for name in modules}
    for name, path in modules.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found[name] |= {alias.name for alias in node.names} & set(modules)
            elif isinstance(node, ast.ImportFrom):
                for alias in node.names:  # a module, or a name in one
                    inner = f"{node.module}.{alias.name}"
                    found[name] |= {inner if inner in modules else str(node.module)} & set(modules)
    return found


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Imports for type checking included: what needs each other to be understood is one module."""
    found = imports()
    assert len(found) > 150
    assert (
        "dxlrun.compile.check_report" in found["dxlrun.compile.robot_compiler"]
    )  # for type checking, and in a function
    try:
        tuple(TopologicalSorter(found).static_order())
    except CycleError as circle:
        pytest.fail(" <- ".join(circle.args[1]))


def missing_tests(text: str) -> list[str]:
    """Return the test files that a text names, as `tests/log/test_{log,recorder}.py`, and that are gone."""
    named = []
    for start, names, end in re.findall(r"(tests/[\w/]*)(?:\{([\w,]+)\})?(\w*\.py)", text):
        named += [f"{start}{name}{end}" for name in names.split(",")]
    return [name for name in named if not (ROOT / name).is_file()]


def test_programs_of_bench_name_tests_that_there_are() -> None:
    """Nothing else runs these programs."""
    assert missing_tests("tests/log/test_{log,gone}.py tests/gone.py") == [
        "tests/log/test_gone.py",
        "tests/gone.py",
    ]
    found = {path.name: missing_tests(path.read_text("utf-8")) for path in ROOT.glob("bench/*.py")}
    assert {name: gone for name, gone in found.items() if gone} == {}
