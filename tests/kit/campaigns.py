"""Campaigns: tests with a count and a random generator, marked where they are.

    @campaign(ci=4, night=50, release=500)
    def test_storm_breaks_no_promise(number: int, chance: random.Random) -> None:

A test with the argument `number` is one test for each number below the count. `amount` is the count itself,
for a test that loops, or the length of a run. A property of hypothesis has so many examples, drawn from the
seed; `@settings` may have anything but their number. `chance` is a random generator that depends on the seed,
the test and its parameters.

    pytest --campaign=night --seed 7 tests/simulation    # ci, night or release
    pytest --campaigns                                   # the table of all campaigns

A count of 0 leaves the test out at that level.
"""

import random
from collections.abc import Callable, Iterator
from enum import StrEnum
from typing import TypeVar

import pytest
from hypothesis import is_hypothesis_test, seed, settings


class Level(StrEnum):
    """Level of a run, which decides the counts of its campaigns."""

    CI = "ci"  # at each landing: seconds
    NIGHT = "night"  # some hours for all of them
    RELEASE = "release"  # in full


Test = TypeVar("Test", bound=Callable[..., object])
_LEVEL = [Level.CI]
_SEED = [1]
"""Level and seed of this run, which are known before the tests are imported."""


def campaign(*, ci: float, night: float, release: float) -> Callable[[Test], Test]:
    """Mark a test as a campaign, with its count at each level."""
    counts = {Level.CI: ci, Level.NIGHT: night, Level.RELEASE: release}

    def decorate(test: Test) -> Test:
        if is_hypothesis_test(test):
            # `settings` refuses a test that has some, so its attribute is set
            others = getattr(test, "_hypothesis_internal_use_settings", None)
            examples = settings(others, max_examples=max(1, int(counts[_LEVEL[0]])))
            vars(test)["_hypothesis_internal_use_settings"] = examples
            test = seed(_SEED[0])(test)
        return pytest.mark.campaign(ci=ci, night=night, release=release)(test)

    return decorate


def add_options(parser: pytest.Parser) -> None:
    group = parser.getgroup("campaigns")
    levels = [level.value for level in Level]
    group.addoption("--campaign", choices=levels, default="ci", help="how long campaigns run (default: ci)")
    group.addoption("--seed", type=int, default=1, help="seed of what campaigns draw (default: 1)")
    group.addoption(
        "--campaigns", action="store_true", help="print the table of all campaigns, and run nothing"
    )


def count_of(node: pytest.Item | pytest.Metafunc, level: Level) -> float | None:
    """Return the count of a campaign at a level; None for a test that is not a campaign."""
    owner = node if isinstance(node, pytest.Item) else node.definition
    mark = owner.get_closest_marker("campaign")
    return mark.kwargs[level.value] if mark and mark.kwargs else None


class Campaigns:
    """Plugin: gives campaigns their count and their generator, and prints their table."""

    def __init__(self, config: pytest.Config) -> None:
        self._level = Level(config.getoption("--campaign"))
        self._seed: int = config.getoption("--seed")
        self._rows: dict[str, pytest.Item] = {}
        self._asked: bool = config.getoption("--campaigns")
        _LEVEL[0], _SEED[0] = self._level, self._seed
        if self._asked:
            config.option.dist, config.option.tx = "no", []  # this process collects all tests

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Make a test for each number."""
        count = count_of(metafunc, self._level)
        if count is not None and "number" in metafunc.fixturenames:
            metafunc.parametrize("number", range(int(count)))

    @pytest.hookimpl(tryfirst=True)  # the table also has what the change of a commit does not select
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Leave out what has a count of 0 at this level; beyond CI, campaigns have no time limit."""
        for item in items:
            if count_of(item, self._level) is not None:
                self._rows.setdefault(item.nodeid.partition("[")[0], item)
                if self._level is not Level.CI:
                    item.add_marker(pytest.mark.timeout(0), append=False)
        without = [item for item in items if count_of(item, self._level) == 0]
        if without:
            config.hook.pytest_deselected(items=without)
            items[:] = [item for item in items if item not in set(without)]

    @pytest.fixture
    def amount(self, request: pytest.FixtureRequest) -> float:
        """Count of the campaign at the level of this run."""
        count = count_of(request.node, self._level)
        assert count is not None, "not a campaign"
        return count

    @pytest.fixture
    def chance(self, request: pytest.FixtureRequest) -> random.Random:
        """Random generator of this test; the same at each run with the same `--seed`."""
        return random.Random(f"{self._seed} {request.node.name}")

    def table(self) -> Iterator[str]:
        """Yield the rows of the table: the counts of each campaign."""
        yield f"{'ci':>8} {'night':>8} {'release':>9}  test"
        for name, item in sorted(self._rows.items()):
            counts = [count_of(item, level) for level in Level]
            yield "{:>8} {:>8} {:>9}  {}".format(*(f"{count:g}" for count in counts), name)

    def pytest_runtestloop(self) -> bool | None:
        """Run nothing where only the table is asked for."""
        return True if self._asked else None

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print the table where it is asked for."""
        if self._asked:
            for row in self.table():
                terminalreporter.write_line(row)
