"""Selection: the long tests that a run takes, which are first.

A file with `pytestmark = pytest.mark.long` has runs through all processes, experiments, or commands of pages.
Whatever is named on the command line runs as a whole. Of the whole suite everything short runs, and the long
tests that a change can break:

    git diff --name-only main > changed.txt
    pytest --changed=changed.txt    # and the long tests of rooms that changed, or import what changed,
                                    # and those that have the name of a page that changed
    pytest --all                    # everything
    pytest --all --passed=FILE      # and not the tests in FILE; those that pass are added to it

How a run ends, and what the network is refused, is never marked as long: tests of safety always run.
"""

import re
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import pytest
from xdist.workermanage import WorkerController

ROOT = Path(__file__).parents[2]
LIBRARIES = ("dxlrun", "dxlsim", "dxlwire")
TESTED = {
    "analysis": ("dxlrun_analysis",),
    "bench": ("bench", "dxlwire"),
    "cli": ("dxlrun.cli", "dxlrun.output", "dxlrun.tooling", "robots"),
    "compile": ("dxlrun.compile", "dxlrun.plan"),
    "control": ("dxlrun.control", "dxlrun.contract", "dxlrun.plan"),
    "description": ("dxlrun.description",),
    "dxlsim": ("dxlsim",),
    "dxlwire": ("dxlwire",),
    "dynamixel": ("dxlrun.dynamixel", "dxlrun.features.registers", "dxlrun.features.devices", "dxlwire"),
    "features": ("dxlrun.features",),
    "fleet": ("dxlrun_fleet",),
    "foreign": ("dxlsim",),
    "foxglove": ("dxlrun_foxglove",),
    "hand": ("dxlrun_hand",),
    "import": ("dxlrun_import",),
    "lab": ("dxlrun_lab",),
    "lights": ("lights",),
    "log": ("dxlrun.log", "dxlrun.messages"),
    "mechanics": ("dxlrun.features.mechanics",),
    "phidget": ("phidget",),
    "plugins": ("dxlrun_controllers", "dxlrun_space", "dxlrun.contract", "dxlrun.testing", "example"),
    "remote": ("dxlrun.remote", "dxlrun.channels"),
    "robots": ("robots", "dxlrun_controllers", "dxlrun.control", "dxlrun.run", "dxlrun.features.mechanics"),
    "ros2": ("dxlrun_ros2",),
    "run": ("dxlrun.run", "dxlrun.channels", "dxlrun.control"),
    "sensors": ("dxlrun.features.sensors",),
    "simulation": ("dxlsim",),
    "space": ("dxlrun_space",),
    "steering": ("dxlrun.control", "dxlrun.run", "dxlrun.dynamixel"),
    "teleop": ("dxlrun_teleop",),
    "view": ("dxlrun_view",),
}
"""Rooms that a folder of tests is about; `dxlrun.features` is each feature."""

CHECKED_LESS = "checked less"
"""Property (`record_property`) of a test that checks more with some extra: `--passed` does not omit it."""


def room_of(module: str) -> str:
    """Return the room of a module: `dxlwire`, `dxlrun.control`, `dxlrun.features.sensors`, `dxlrun_lab`."""
    parts = module.split(".")
    if parts[0] != "dxlrun":
        return parts[0]
    return ".".join(parts[: 3 if parts[1:2] == ["features"] else 2])


def module_of(path: str) -> str:
    """Return the module of a product file, or the package of another file next to modules."""
    parts = list(Path(path).with_suffix("").parts[1:])
    if "src" in parts:  # a distribution of its own
        parts = parts[parts.index("src") + 1 :]
    return ".".join(part for part in parts if part != "__init__")


def is_face(module: str) -> bool:
    """Return True for a module that only re-exports names of other modules."""
    return module in LIBRARIES or room_of(module) in {"dxlrun.tooling", "dxlrun.testing"}


def tests_of(room: str) -> list[str]:
    """Return the folders of tests that are about a room, the one with its name first."""
    above = room.rpartition(".")[0]
    names = {room, above} if above == "dxlrun.features" else {room}
    found = [folder for folder, rooms in TESTED.items() if not names.isdisjoint(rooms)]
    return sorted(found, key=lambda folder: folder != room.rpartition(".")[2].removeprefix("dxlrun_"))


def affected_rooms(paths: Iterable[str]) -> set[str]:
    """Return the rooms that changed, and those that import what changed directly or through a face."""
    import grimp

    changed = [path for path in paths if path.startswith(("runtime/", "plugins/"))]
    # short tests alone read the schemas
    rooms = {"robots" for path in paths if path.startswith("robots/") and not path.endswith(".schema.json")}
    rooms |= {"bench" for path in paths if path.startswith("bench/")}
    modules = {module_of(path) for path in changed}
    rooms |= {room_of(module) for module in modules if module}
    packages = {one.parent.name for one in (ROOT / "plugins").glob("*/__init__.py")}
    graph = grimp.build_graph(*LIBRARIES, *sorted(packages))
    for module in modules & graph.modules:
        importers = set(graph.find_modules_that_directly_import(module))
        for face in filter(is_face, tuple(importers)):
            importers |= graph.find_modules_that_directly_import(face)
        rooms |= set(map(room_of, importers))
    return rooms


def affected_files(paths: Collection[str]) -> Iterator[str]:
    """Yield the long test files that a change can break; `paths` are relative to the repository."""
    rooms = affected_rooms(paths)
    named = [module_of(f"x/{path}") for path in paths if path.startswith("tests/kit/")]
    # a test has the names of the pages and examples that it reads
    named += [Path(path).name for path in paths if path.startswith(("docs/", "README.md"))]
    for path, text in long_files():
        names = path in paths or any(one in text for one in named)
        if names or not rooms.isdisjoint(TESTED[folder_of(path)]):
            yield path


def folder_of(path: str) -> str:
    """Return the folder of a test file: `control`, or the package of one in `plugins/`."""
    return Path(path).parts[1]


def long_files() -> Iterator[tuple[str, str]]:
    """Yield the files whose tests are long, with their text."""
    for base in ("tests", "plugins"):
        for path in sorted((ROOT / base).rglob("test_*.py")):
            if re.search(
                r"^pytestmark = .*pytest\.mark\.long\b", text := path.read_text("utf-8"), re.MULTILINE
            ):
                yield str(path.relative_to(ROOT)), text


def deal_tests(items: Sequence[pytest.Item], workers: int) -> list[pytest.Item]:
    """Return the tests in an order in which every worker begins with slow files and ends with short tests.

    `--dist worksteal` cuts the tests into one stretch a worker, and moves the end of a stretch to an idle
    worker. Where that has slow files, the others wait for the last one. Files of a folder share fixtures, so
    they stay together; those with the longest time limits come first.
    """
    slow: dict[Path, float] = {}
    for item in items:
        limit = item.get_closest_marker("timeout")
        if limit or item.get_closest_marker("long"):
            slow[item.path] = max(slow.get(item.path, 0.0), limit.args[0] if limit else 0.0)
    folders: dict[Path, list[pytest.Item]] = {}
    for item in sorted((one for one in items if one.path in slow), key=lambda one: -slow[one.path]):
        folders.setdefault(item.path.parent, []).append(item)
    stretches: list[list[pytest.Item]] = [[] for _ in range(workers)]
    # A file is a better measure of time than a test: some have hundreds of short ones.
    for tests in folders.values():
        min(stretches, key=lambda stretch: len({item.path for item in stretch})).extend(tests)
    short = (item for item in items if item.path not in slow)
    left = len(items)
    for number, stretch in enumerate(stretches):
        stretch.extend(islice(short, max(0, left // (workers - number) - len(stretch))))
        left -= len(stretch)
    return [*(item for stretch in stretches for item in stretch), *short]


def add_options(parser: pytest.Parser) -> None:
    group = parser.getgroup("selection")
    group.addoption(
        "--all", action="store_true", help="run the long tests as well, as campaigns beyond CI do"
    )
    group.addoption(
        "--changed", metavar="FILE", help="file with the paths that changed: run their long tests"
    )
    group.addoption("--passed", metavar="FILE", help="omit the tests in FILE, and add those that pass")


class Selection:
    """Plugin: leaves out long tests, and reports last how many tests were left out and why."""

    def __init__(self, config: pytest.Config) -> None:
        named = config.args_source is pytest.Config.ArgsSource.ARGS
        campaigns = config.getoption("--campaigns") or config.getoption("--campaign") != "ci"
        self._everything = named or campaigns or config.getoption("--all")
        self._left_out: Counter[str] = Counter()
        given = getattr(config, "workerinput", {}).get("affected")  # by the main process, in a worker
        if given is None and (changed := config.getoption("--changed")):
            given = [*affected_files(Path(changed).read_text("utf-8").split())]
        self._affected = set(given or ())
        file = config.getoption("--passed")
        self._record = Path(file) if file else None
        self._passed: set[str] = set()
        if self._record and self._record.exists():
            self._passed.update(self._record.read_text("utf-8").splitlines())
        self._passing: set[str] = set()

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: WorkerController) -> None:
        """Hand the affected files to a worker."""
        node.workerinput["affected"] = sorted(self._affected)

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Leave out what has passed and the long tests that no change can break, and deal out the others."""
        left_out = {item for item in items if item.nodeid in self._passed or self._is_needless(item)}
        config.hook.pytest_deselected(items=[*left_out])
        workers = getattr(config, "workerinput", {}).get("workercount", 1)
        items[:] = deal_tests([item for item in items if item not in left_out], workers)

    def _is_needless(self, item: pytest.Item) -> bool:
        if self._everything or not item.get_closest_marker("long"):
            return False
        return str(item.path.relative_to(item.config.rootpath)) not in self._affected

    def pytest_deselected(self, items: list[pytest.Item]) -> None:
        """Count what is left out."""
        for item in items:
            passed = item.nodeid in self._passed
            long = item.get_closest_marker("long") and not self._everything
            campaign = item.get_closest_marker("campaign")
            self._left_out["passed" if passed else "long" if long else "campaign" if campaign else ""] += 1

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note a test that passes and has checked all, until its teardown fails."""
        if report.failed:
            self._passing.discard(report.nodeid)
        elif report.when == "call" and report.passed and CHECKED_LESS not in dict(report.user_properties):
            self._passing.add(report.nodeid)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: WorkerController) -> None:
        """Take the counts of a worker: each has collected all tests."""
        self._left_out |= Counter(getattr(node, "workeroutput", {}).get("left_out", {}))

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> Generator[None, None, None]:
        """Report what was left out in the last line."""
        if (output := getattr(session.config, "workeroutput", None)) is not None:
            output["left_out"] = dict(self._left_out)
        yield
        if output is not None:
            return
        if self._record:
            self._record.write_text(
                "".join(f"{one}\n" for one in sorted(self._passed | self._passing)), "utf-8"
            )
        reasons = {
            "passed": "tests that have passed (--passed)",
            "long": "long tests that no given change needs (--all runs them)",
            "campaign": "campaigns that run at night or for a release (--campaigns lists them)",
        }
        parts = [f"{self._left_out[key]} {text}" for key, text in reasons.items() if self._left_out[key]]
        reporter = session.config.pluginmanager.get_plugin("terminalreporter")
        if parts and reporter is not None:
            reporter.write_line(f"left out: {', '.join(parts)}")
