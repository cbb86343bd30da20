"""The pages of the repository: their commands work, and the files, names and pages in them exist.

Each page with commands has a test that runs them; those of six are run here. Where a page names hardware,
the command gets a simulated line instead; a run gets virtual time.
"""

from __future__ import annotations

import ast
import json
import re
import shlex
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.examples import as_parameters

from dxlrun.channels.answers import Completion
from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.event_records import event_names
from dxlrun.cli import verb_registry
from dxlrun.cli.examples import schema_text
from dxlrun.cli.sim import sim
from dxlrun.cli.steering.written import WrittenEntry
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.description.joints.joint_forms import Joint
from dxlrun.description.reading import read_robot
from dxlrun.remote.preparation import Preparation
from dxlrun.run.run_summary import RunOptions, RunSummary
from dxlrun.run.simulation_front import SimulationResult
from dxlrun.testing import plan_of, read_log, simulated_robot
from dxlrun_view import dxlrun_commands
from dxlsim.faults.fault import parse_fault
from dxlsim.messages import SimulationJob, SimulationMessage
from dxlsim.simulation_plan import BusConfig, ServoConfig, SimulationConfig
from dxlwire.control_table import find_table
from dxlwire.exceptions import HELP

ROOT = Path(__file__).parents[2]
ROOTS = (ROOT, ROOT / "runtime", ROOT / "runtime/dxlrun", ROOT / "plugins")
"""Where a page's path to a file may begin."""
PATHS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "tests/CAMPAIGNS.md",
    *sorted({*ROOT.glob("docs/**/*.md")} - {*ROOT.glob("docs/changes/*")}),
]
PAGES = {path.name: path.read_text() for path in PATHS}
PROJECT = (ROOT / "pyproject.toml").read_text()
SOURCES = [
    path
    for folder in ("runtime", "plugins", "tests")
    for path in sorted((ROOT / folder).rglob("*"))
    if path.suffix in {".py", ".c", ".toml", ".md"} and "site-packages" not in path.parts
]
TESTS = {
    "README.md": ("tests/test_readme.py",),
    "add-a-section.md": ("plugins/lights/tests/test_lights.py",),
    "analyze.md": ("tests/cli/test_docs.py",),
    "architecture.md": ("tests/cli/test_docs.py",),
    "arm.md": ("tests/cli/test_tutorial.py",),
    "bench.md": ("tests/bench/test_bench_page.py", "tests/cli/test_docs.py"),
    "bus.md": ("tests/cli/test_docs.py",),
    "controller.md": ("tests/cli/test_tutorial.py",),
    "controllers.md": ("tests/plugins/test_docs.py",),
    "devices.md": ("tests/cli/test_device_tools.py",),
    "experiments.md": (
        "tests/cli/test_latency.py",
        "tests/lab/characterize/test_command.py",
        "tests/lab/tracking/test_command.py",
    ),
    "by-hand.md": ("tests/hand/test_terminal.py",),
    "from-lerobot-rustypot-sdk.md": ("tests/cli/test_coming_from.py",),
    "from-ros2-control.md": ("tests/cli/test_coming_from.py",),
    "frames.md": ("tests/cli/test_frames.py",),
    "gallery.md": ("tests/cli/test_docs.py",),
    "humanoid.md": ("tests/cli/test_tutorial.py",),
    "logs.md": (
        "tests/analysis/season/test_logs.py",
        "tests/analysis/export/test_tables.py",
    ),
    "mechanics.md": ("tests/cli/test_mechanics.py",),
    "models.md": ("tests/cli/test_models.py",),
    "raspberry-pi.md": ("tests/cli/test_docs.py", "tests/cli/test_latency.py"),
    "real-time.md": ("tests/cli/test_docs.py", "tests/cli/test_latency.py"),
    "results.md": ("tests/lab/tracking/test_command.py",),
    "recipes.md": ("tests/cli/test_recipes.py", "tests/robots/test_stand_up.py"),
    "replay.md": ("tests/analysis/replay/test_command_line.py",),
    "simulation.md": ("tests/cli/test_sim_page.py", "tests/cli/test_docs.py"),
    "sensors.md": ("tests/sensors/test_page.py",),
    "steering.md": ("tests/cli/test_steer.py",),
    "teleoperation.md": ("tests/teleop/test_page.py", "tests/teleop/test_terminal.py"),
    "tools.md": ("tests/cli/test_docs.py",),
    "network.md": ("tests/remote/test_network_run.py",),
    "fleet.md": ("tests/fleet/test_fleet.py",),
    "foxglove.md": ("tests/foxglove/test_live.py",),
    "view.md": ("tests/view/test_command.py",),
}
"""What runs the commands of a page."""
Dxlrun = Callable[..., Any]


def commands(page: str) -> list[str]:
    """Return the lines that a reader types, without the remarks behind them."""
    lines = re.findall(r"^    (dxlrun .+)$", PAGES[page], re.MULTILINE)
    return [line.partition("  #")[0].strip() for line in lines]


def spans(text: str) -> list[str]:
    """Return the commands inside sentences, without `dxlrun`."""
    return re.findall(r"`dxlrun ([^`]+)`", " ".join(text.split()))


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory of the reader, with the robots and motions of the clone."""
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[SimulationConfig]:
    """What `dxlrun sim` was about to serve."""
    configs: list[SimulationConfig] = []

    def serve(job: SimulationJob, *_: object, **__: object) -> SimulationResult:
        configs.append(job.config)
        return SimulationResult(1.0, SimulationMessage(), ())

    monkeypatch.setattr(sim, "_serve", serve)
    return configs


def test_every_page_with_commands_has_a_test_that_runs_them() -> None:
    assert {page for page in PAGES if commands(page)} == set(TESTS)
    for page, paths in TESTS.items():
        for path in paths:
            assert page in (ROOT / path).read_text(), (page, path)


@pytest.mark.parametrize("page", PAGES)
def test_commands_inside_sentences_exist_with_their_options(
    dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch, page: str
) -> None:
    # the page's package is installed by itself
    found = dict(verb_registry.packaged()) | {command.name: command for command in dxlrun_commands()}
    monkeypatch.setattr(verb_registry, "packaged", lambda: found)
    general = dxlrun("--help").out
    known = set(verb_registry.names())
    for span in spans(PAGES[page]):
        verb, *rest = span.split()
        if verb.startswith("--") or verb.endswith((".yaml", "FILE", "ROBOT", "VERB")):
            helped = general
        else:
            assert verb in known, span
            family = [verb, rest[0]] if verb in {"bench", "experiment"} else [verb]
            helped = dxlrun(*family, "--help").out
            assert f"dxlrun {' '.join(family)}" in helped, span
        for option in re.findall(r"--[a-z][a-z-]*", span):
            assert option in helped, span


def test_bus_md_its_checks_print_what_the_page_has(dxlrun: Dxlrun, clone: Path) -> None:
    (ftdi,) = [line for line in commands("bus.md") if " check " in line]
    refused = dxlrun(*shlex.split(ftdi)[1:])
    assert refused.code == 2
    (highest,) = re.findall(r"highest rate that is left, (\d+ Hz)", PAGES["bus.md"])
    assert highest in refused.err + refused.out


def test_raspberry_pi_md_its_run_needs_no_hardware(dxlrun: Dxlrun, clone: Path) -> None:
    run, doctor, _ = commands("raspberry-pi.md")
    assert doctor == "dxlrun doctor"
    found = dxlrun(*shlex.split(run)[1:-1], "0.2")
    assert (found.code, "bioloid_torso: done" in found.out) == (0, True)


def test_bus_md_the_simulation_and_the_robot_meet_at_the_link(
    dxlrun: Dxlrun, clone: Path, served: list[SimulationConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both as processes: tests/cli/test_sim.py; the fault, too: tests/run/test_unplugs.py."""
    simulate, run = [line for line in commands("bus.md") if " check " not in line]
    (robot,) = re.findall(r"```yaml\n(name: pan_tilt.*?)```", PAGES["README.md"], re.DOTALL)
    (clone / "robot.yaml").write_text(robot)
    assert dxlrun(*shlex.split(simulate)[1:]).code == 0
    ((bus,),) = (config.buses for config in served)
    assert len(bus.servos) == 2
    ports: list[str] = []

    def run_robot(plan: Any, options: RunOptions, out: object) -> RunSummary:
        ports.extend(one.port for one in plan.buses)
        return RunSummary(0, "ended", 1, 0, 0.1, ())

    monkeypatch.setattr("dxlrun.run.supervisor.run_robot", run_robot)
    assert dxlrun(*shlex.split(run)[1:]).code == 0
    assert ports == [shlex.split(simulate)[-1]]
    (fault,) = re.findall(r"then type: (.+)$", PAGES["bus.md"], re.MULTILINE)
    assert str(parse_fault(fault)) == fault


def test_tools_md_its_commands_do_what_the_page_has(
    dxlrun: Dxlrun, clone: Path, simulated_line: Callable[..., Any]
) -> None:
    path, finish = simulated_line(BusConfig("main", 1_000_000, (ServoConfig(1, "XM430-W350", 2.0),), 2.0))
    scan, synopsis, *servo = commands("tools.md")
    assert synopsis == "dxlrun servo PORT ID VERB"
    assert len(servo) == 3
    found = dxlrun(*scan.replace("/dev/ttyUSB0", path).split()[1:], "--baud", "1000000", "--ids", "1-9")
    assert (found.code, found.err) == (0, "")
    assert "XM430-W350" in found.out
    for line in servo:  # EEPROM is written without a question here; the rate is given, to be quick
        result = dxlrun(*shlex.split(line.replace("/dev/ttyUSB0", path))[1:], "--yes", "--baud", "1000000")
        assert (result.code, result.err) == (0, ""), line
    assert '"id":7' in (clone / "elbow.json").read_text().replace(" ", "")
    sent = [entry.data for entry in finish() if entry.direction == "in"]
    writes = {(data[4], data[8], data[10:-2]) for data in sent if data[2:3] == b"\xfd" and data[7] == 3}
    items = find_table("XM430-W350").items
    assert (1, items["return_delay_time"].address, b"\x00") in writes
    assert (1, items["id"].address, b"\x07") in writes


@pytest.mark.parametrize("page", ["tools.md", "simulation.md"])
def test_simulations_inside_sentences_are_understood(
    dxlrun: Dxlrun, clone: Path, served: list[SimulationConfig], page: str
) -> None:
    lines = [span for span in spans(PAGES[page]) if span.startswith("sim --")]
    for line in lines:
        assert dxlrun(*shlex.split(line)).code == 0, line
    assert len(served) == len(lines)
    assert lines or page != "tools.md"


@pytest.mark.needs("report")
def test_analyze_md_its_commands_read_logs(dxlrun: Dxlrun, clone: Path) -> None:
    lines = list(commands("analyze.md"))
    assert len(lines) == 4
    for _ in range(2):
        assert dxlrun("robots/single_joint.yaml", "--virtual", "--duration", "0.5").code == 0
    logs = sorted(str(path) for path in (clone / "logs").glob("*.mcap"))
    for line in lines:
        words = shlex.split(line)[1:]
        given = [one for word in words for one in {"LOG": logs[:1], "logs/*.mcap": logs}.get(word, [word])]
        assert dxlrun(*given).code == 0, line
    assert (clone / "run.html").exists()


@pytest.mark.parametrize("robot", as_parameters(sorted((ROOT / "robots").glob("*.yaml"))))
def test_every_robot_of_the_clone_is_checked_and_runs(
    dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert dxlrun("check", robot).code == 0
    ran = dxlrun(robot, "--virtual", "--duration", "0.1")
    assert ran.code == 0, ran.err
    cycles = -(-100_000_000 // compile_files(robot, {}, []).plan.loop.period_ns)  # one at 0 s
    assert f": 0 of {cycles} periods skipped" in ran.out


def test_gallery_md_each_robot_has_a_picture_and_runs(dxlrun: Dxlrun, clone: Path) -> None:
    robots = re.split(r"^## ", PAGES["gallery.md"], flags=re.MULTILINE)[1:]
    assert len(robots) == len(commands("gallery.md")) > 5
    assert all("](pictures/" in robot for robot in robots)
    for line in commands("gallery.md"):
        short = [] if "--play" in line else ["--duration", "0.2"]  # a motion that is cut is not reached
        ran = dxlrun(*shlex.split(line)[1:], *short)
        assert ran.code == 0, line + ran.out + ran.err


def anchors(text: str) -> set[str]:
    """Return the names by which the headings of a page are linked to, as GitHub makes them."""
    headings = re.findall(
        r"^#+ (.+)$", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", [*PATHS, ROOT / "CHANGELOG.md"], ids=lambda path: path.name)
def test_the_links_of_a_page_lead_somewhere(path: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", path.read_text()):
        if link.startswith("https://"):
            continue
        target, _, anchor = link.partition("#")
        linked = path.parent / target if target else path
        assert linked.exists(), link
        if anchor:
            assert anchor in anchors(linked.read_text()), link


@pytest.mark.parametrize("path", [*PATHS, ROOT / "CHANGELOG.md"], ids=lambda path: path.name)
def test_the_files_that_a_page_names_exist(path: Path) -> None:
    roots = ROOTS
    others = {"logs", ".venv", "dxlrun", "lights"}  # beginnings of other names, too
    folders = {one.name for root in roots for one in root.iterdir() if one.is_dir()} - others
    text = path.read_text()
    typed = [word for line in re.findall(r"^    (.+)$", text, re.MULTILINE) for word in line.split()]
    for token in [*re.findall(r"`([\w.+-]+(?:/[\w.+-]+)*/?)`", text), *typed]:
        if token.split("/")[0] in folders and "/" in token:
            assert any((root / token).exists() for root in roots), token


def test_every_page_is_in_the_index() -> None:
    pages = {str(path.relative_to(ROOT / "docs")) for path in PATHS[3:]} - {"index.md"}
    assert pages <= set(re.findall(r"\]\(((?:[\w-]+/)?[\w-]+\.md)\)", PAGES["index.md"]))


def test_the_name_of_a_page_is_unique() -> None:
    assert len(PAGES) == len(PATHS)


def test_what_the_code_cites_is_in_the_repository() -> None:
    pages = {*PAGES, "CHANGELOG.md"}
    cited = {
        (name, path.name)
        for path in SOURCES
        for name in re.findall(r"(?<![\w/*.{}-])((?:docs/(?:[\w-]+/)?)?[a-zA-Z-]+\.md)\b", path.read_text())
    }
    assert ("protocol.md", "line.py") in cited
    lost = {
        (name, where)
        for name, where in cited
        if not ((ROOT / name).exists() if "/" in name else name in pages)
    }
    assert lost == set()
    headings = anchors(PAGES["protocol.md"])
    sections = [
        one for path in SOURCES for one in re.findall(r"\(protocol\.md, ([A-Z]\w+)", path.read_text())
    ]
    assert sections
    for section in sections:
        assert any(heading.startswith(section.lower()) for heading in headings), section


def defined(path: Path) -> set[str]:
    """Return the names that a file defines; a method as `Class.method`, in C every word."""
    if path.suffix != ".py":
        return set(re.findall(r"\w+", path.read_text()))
    names: set[str] = set()
    functions = ast.FunctionDef | ast.AsyncFunctionDef
    for node in ast.parse(path.read_text()).body:
        names |= {
            name.id for name in ast.walk(node) if isinstance(name, ast.Name) and not hasattr(node, "name")
        }
        if isinstance(node, functions | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{one.name}" for one in node.body if isinstance(one, functions)}
    return names


@pytest.mark.parametrize("page", PAGES)
def test_the_names_that_a_page_gives_with_their_file_exist(page: str) -> None:
    found = re.findall(r"`([\w/.-]+\.(?:py|c))::([\w.]+)`", PAGES[page])
    assert found or page != "architecture.md"
    for file, name in found:
        paths = [root / file for root in ROOTS if (root / file).exists()]
        assert paths, file
        assert name in defined(paths[0]), f"{file}::{name}"


def test_a_name_that_a_file_lacks_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "line.py"
    methods = "    def send(self):\n        width = LIMIT\n\n    async def ask(self): ...\n"
    path.write_text(f"LIMIT = 3\n\n\nclass Line:\n{methods}")
    assert defined(path) == {"LIMIT", "Line", "Line.send", "Line.ask"}


def test_architecture_md_has_every_room() -> None:
    page = PAGES["architecture.md"]
    rooms = set(re.findall(r"`([\w/]+(?:/|\.py))`", page[page.index("## Rooms") :]))
    for root, folder in (("", "dxlsim/"), ("", "dxlwire/"), ("dxlrun", ""), ("dxlrun", "dynamixel/")):
        entries = [one for one in (ROOT / "runtime" / root / folder).iterdir() if "__" not in one.name]
        entries = [one for one in entries if one.is_file() or any(one.rglob("*.py"))]
        names = {f"{folder}{one.name}" + "/" * one.is_dir() for one in entries}
        assert {name for name in names if name.endswith((".py", "/"))} - rooms == set()


def test_architecture_md_names_what_the_code_has() -> None:
    code = "\n".join(path.read_text() for path in SOURCES if path.relative_to(ROOT).parts[0] != "tests")
    names = re.findall(r"`([A-Za-z_]\w+(?:\.[a-z_]\w+)?)(?:\(\))?`", PAGES["architecture.md"])
    names = [name for name in names if not name.endswith((".py", ".so", ".toml"))]
    assert {"Plan", "commands"} <= set(names)
    for name in names:
        for word in name.split("."):
            assert re.search(rf"\b{word}\b", code), name


def test_architecture_md_its_motion_has_these_bytes_and_this_row(dxlrun: Dxlrun, tmp_path: Path) -> None:
    """The command goes the page's way, without the sockets: tests/cli/test_steer.py has those."""
    page = PAGES["architecture.md"]
    (line,) = commands("architecture.md")
    _, _, controller, kind, *words = shlex.split(line)
    command, request, reply, _ = map(bytes.fromhex, re.findall(r"^(FF FF [\dA-F ]+)$", page, re.MULTILINE))
    plan = plan_of(ROOT / "robots/bioloid_torso.yaml")
    preparation = Preparation({joint.name: joint for joint in plan.loop.joints}, load_plugins())
    (head,) = (one for one in plan.loop.controllers if one.name == controller)
    body = json.dumps(WrittenEntry.from_words(words, None).data).encode()
    prepared = preparation.command(head, kind, body, units=True)
    assert (len(prepared.data), prepared.beyond) == (32, ())
    log = tmp_path / "torso.mcap"
    robot = simulated_robot(ROOT / "robots/bioloid_torso.yaml", duration_s=4.0, log=log)
    sent = CommandMessage(1, controller, kind, prepared.data, "a reader")
    robot.buses[0].at(2_000_000_000, lambda: robot.inbox.waiting.append(sent))
    robot.run()
    assert isinstance(robot.inbox.answers[1], Completion)
    entries = robot.ledger.entries
    moves = [one for one in entries if one.direction == "in" and one.t_ns > 2e9 and one.data[4] == 0x83]
    assert moves[3].data == command  # in the fourth cycle; what changed in it once more
    assert moves[4].data[7:12] == command[12:17]
    (at,) = (index for index, one in enumerate(entries) if one.data == reply)
    assert entries[at - 1].data == request
    recorded = read_log(log)
    assert [packet.data for packet in recorded.packets].count(reply) == 1
    cycle = recorded.cycles[np.searchsorted(recorded.cycles["read_ns"], entries[at].t_ns)]
    row = recorded.joints.index("head_yaw_joint")
    assert f"{np.degrees(cycle['position'][row]):.1f} deg of the joint" in page
    assert f"{cycle['velocity'][row]:.2f} rad/s" in page
    assert cycle["effort"][row] == -195 / 1023
    assert cycle["valid"][row]
    report = dxlrun("analyze", str(log)).out
    printed = [line.split() for line in report.splitlines()]
    shown = [line.split() for line in page.splitlines() if line.startswith(("joint  ", "head_yaw_joint  "))]
    assert len(shown) == 2
    assert all(row in printed for row in shown)


def test_architecture_md_its_key_becomes_these_bytes() -> None:
    page = PAGES["architecture.md"]
    packet = bytes.fromhex(re.findall(r"^(FF FF [\dA-F ]+)$", page, re.MULTILINE)[-1])
    (entry,) = re.findall(
        r"`elbow_flex: \{id: (\d+), model: \S+, registers: \{position_p_gain: (\d+)\}\}`", page
    )
    described = read_robot(ROOT / "robots/koch.yaml", {}).robot.joints["elbow_flex"]
    assert isinstance(described, Joint)
    assert (described.id, described.registers["position_p_gain"]) == tuple(map(int, entry))
    robot = simulated_robot(ROOT / "robots/koch.yaml", duration_s=0.1)
    robot.run()
    written = [one.data for one in robot.ledger.entries if one.direction == "in"]
    assert written.count(packet) == 1


def test_failures_md_names_events_and_keys_that_exist() -> None:
    events = {*event_names().values()}
    names = set(re.findall(r"`([a-z]+_[a-z_]+)`", PAGES["failures.md"]))
    assert {"servo_lost", "on_exit"} <= names
    schema = schema_text("robot")
    for name in names - events - {"clamped"}:
        assert f'"{name}": {{' in schema or name in ("on_configure", "on_restart"), name


def test_it_does_not_work_md_quotes_messages_of_the_program() -> None:
    page = PAGES["it-does-not-work.md"]
    symptoms = re.split(r"^### ", page, flags=re.MULTILINE)[1:]
    assert len(symptoms) >= 25
    assert [text.partition("\n")[0] for text in symptoms if "`dxlrun " not in text] == []
    written = "\n".join(path.read_text() for path in SOURCES if path.relative_to(ROOT).parts[0] == "runtime")
    written = re.sub(r'" *\n\s+f?"', "", written)  # a sentence in several lines
    for quoted in re.findall(r"^> (.+)$", page, re.MULTILINE):
        if quoted != "dxlrun: command not found":  # the shell's
            for part in filter(None, map(str.strip, quoted.split("…"))):
                assert part in written, quoted


def test_messages_name_the_symptom_that_quotes_them() -> None:
    page = PAGES["it-does-not-work.md"]
    symptoms = re.split(r"^### ", page, flags=re.MULTILINE)[1:]
    quotes = {
        anchor: "\n> " in text for text in symptoms for anchor in anchors("### " + text.partition("\n")[0])
    }
    product = [path for path in SOURCES if path.suffix == ".py" and "tests" not in path.parts]
    named = {
        node.args[0].value
        for path in product
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "help_link" and len(node.args) == 1
        if isinstance(node.args[0], ast.Constant)
    }
    assert named <= set(quotes)
    # the first is the shell's message; the other is the refusal of a request, which has its own remedy
    assert {anchor for anchor, quoted in quotes.items() if quoted} - named == {
        "the-command-is-not-found",
        "one-joint-is-limp",
    }


def test_addresses_are_in_one_place() -> None:
    address = tomllib.loads(PROJECT)["project"]["urls"]["Issues"]
    assert [path.name for path in PATHS if address in path.read_text()] == []
    assert [path.name for path in (*PATHS, *SOURCES) if HELP in path.read_text()] == ["exceptions.py"]
    for page in ("README.md", "CONTRIBUTING.md", "it-does-not-work.md"):
        assert re.search(r"`Issues`\s+in\s+\[pyproject.toml\]", PAGES[page]), page


def test_contributing_md_is_short_and_has_what_ci_runs() -> None:
    page = PAGES["CONTRIBUTING.md"]
    assert len(page.encode()) <= 8192
    linters = {"ruff format", "ruff check", "mypy", "lint-imports"}
    assert set(re.findall(r"^    .*\.venv/bin/(ruff \w+|mypy|lint-imports)", page, re.MULTILINE)) == linters
    ci = (ROOT / ".ci/run").read_text().replace('"', "")
    assert set(re.findall(r"\.lint/bin/(ruff \w+|mypy|lint-imports)", ci)) == linters
    quick = re.findall(r"tests/[\w/.]+", ci)
    assert len(quick) > 5
    assert [folder for folder in quick if not (ROOT / folder).exists()] == []
    (extras,) = re.findall(r"^    .*install -e '\.\[(.+)\]'$", page, re.MULTILINE)
    every = set(tomllib.loads(PROJECT)["project"]["optional-dependencies"])
    assert set(extras.split(",")) == every - {"release"}  # of 101 MB, to publish
