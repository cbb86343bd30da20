"""Inputs of the pictures: the texts that each picture is made from, and their hashes in inputs.json.

An input is what a reader would see change: a robot file, the output of a command on virtual time, the words
of a module whose output needs real time or hands, the page of `dxlrun view`. Code that leaves these texts
alone does not make a picture stale.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import inspect
import io
import json
import os
import re
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import chdir, redirect_stderr, redirect_stdout
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple, TypeAlias

ROOT = Path(__file__).parents[2]
HASHES = Path(__file__).with_name("inputs.json")
PLAY = ("robots/bioloid_torso.yaml", "--play", "robots/motions/three_parts.yaml")
"""Words of the README's first command."""
MISTAKES = """name: arm
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {kind: fdti}, return_delay_time: 0 us}
loop: {rate: 1000}
joints:
  base: {bus: main, id: "1", model: XL430-W250, reference: 180 deg, direction: 1}
  elbow: {bus: main, id: 2, model: XL430-W250, reference: 180, direction: 1, limit: {velocity: 60 deg/s}}
controllers:
  arm: {type: joint_trajectory_controller, joints: [base, elbow], active: on}
"""
FIRST = " ".join((*PLAY, "--virtual"))
VARYING = re.compile(r"_\d{8}_\d{6}|\(\d+ messages, [\d.]+ \w+\)|^.* s, .* x, .* skipped\n", re.MULTILINE)
"""Name and size of a log, and progress: they change from run to run, and with what else a log records."""
OMITTED = re.compile("(\x1b\\[[0-9;]*m)*(Controllers|Servos)\\b")
"""First table of `dxlrun analyze` that the README's terminal does not show."""
PAGE = ROOT / "plugins/dxlrun_view"
Inputs: TypeAlias = Mapping[str, Callable[[], str]]
"""Names of inputs, and functions that return their texts."""


class Shown(NamedTuple):
    """Robot on the page of `dxlrun view`, at a time of the log of a motion."""

    robot: str
    motion: str
    at_s: float
    arguments: tuple[str, ...] = ()
    size: tuple[int, int] = (1100, 680)
    turned: int = 0  # Distance by which the mouse turns the scene, px


ROBOTS = {
    "koch": Shown("koch", "koch_wave", 3.4, ("leader_arm:=true", "leader_torque:=on"), turned=60),
    "poppy_ergo_jr": Shown("poppy_ergo_jr", "poppy_ergo_jr_dance", 4.4),
    "open_manipulator_x": Shown("open_manipulator_x", "open_manipulator_x_wave", 3.0),
    "op3": Shown("op3", "op3_squat", 4.1),
    "wolfgang": Shown("wolfgang", "wolfgang_squat", 0.66, ("rate:=50",)),
    "humanoid_20": Shown("humanoid_20", "humanoid_20_squat", 2.0, ("rate:=200",)),
}


def prepare(place: Path) -> None:
    """Write the files of a new user into a folder: the robots, and the arm and motion of the tutorial."""
    (place / "robots").symlink_to(ROOT / "robots")
    page = (ROOT / "docs/tutorial/arm.md").read_text()
    for title, text in re.findall(r"^```yaml title=\"(.+?)\"\n(.*?)^```", page, re.MULTILINE | re.DOTALL):
        (place / title).write_text(text)  # The page has arm.yaml twice; the last one is the whole arm.


def first_tables(lines: Sequence[str]) -> Sequence[str]:
    """Return the lines of an analysis that the README's terminal shows."""
    return lines[: next(number for number, line in enumerate(lines) if OMITTED.match(line))]


def first_lines(lines: Sequence[str]) -> Sequence[str]:
    """Return the verdict of an analysis: the lines above the first empty one."""
    return lines[: next(number for number, line in enumerate(lines) if not line.strip())]


def file(name: str) -> str:
    """Return the text of a file of the repository."""
    return (ROOT / name).read_text()


def words(*modules: str) -> str:
    """Return the string constants of modules, without docstrings, sorted: renamed code has the same ones."""
    found: set[str] = set()
    for module in modules:
        tree = ast.parse(inspect.getsource(importlib.import_module(module)))
        statements = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        found |= {
            node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in statements
        }
    return "\n".join(sorted(found))


def page_of_view() -> str:
    """Return the markup, the style and the words of the page of `dxlrun view`."""
    scripts = "\n".join(path.read_text() for path in sorted((PAGE / "page").glob("*.js")))
    quoted = re.findall(r"\"[^\"\n]*\"|'[^'\n]*'|`[^`]*`", scripts)
    markup = (PAGE / "src/dxlrun_view/page/page.html").read_text()
    return "\n".join([markup, (PAGE / "page/page.css").read_text(), *sorted(set(quoted))])


class Reader:
    """Runs commands of the inputs in this process, in a folder prepared by `prepare`."""

    def __init__(self, place: Path) -> None:
        self.place = place
        self.output = cache(self._output)

    def _output(self, line: str) -> str:
        """Return what a command prints, without what varies."""
        from dxlrun.cli import main

        printed = io.StringIO()
        os.environ["COLUMNS"] = "130"
        with chdir(self.place), redirect_stdout(printed), redirect_stderr(printed):
            main(line.split())
        return VARYING.sub("", printed.getvalue())

    def analysis(self) -> str:
        """Return the first tables that `dxlrun analyze` prints after the README's first command."""
        self.output(FIRST)
        return "\n".join(first_tables(self.output("analyze").splitlines()))

    def mistakes(self) -> str:
        """Return what `dxlrun check` prints of a file with five mistakes."""
        (self.place / "mistakes.yaml").write_text(MISTAKES)
        return self.output("check mistakes.yaml")

    def lost(self) -> str:
        """Return what `dxlrun analyze` prints of a run in which a servo was silent for a second."""
        lose_servo(self.place, self.place / "lost.mcap")
        return "\n".join(first_lines(self.output("analyze lost.mcap").splitlines()))


def robot_and_motion(robot: str, motion: str) -> Inputs:
    """Return the robot file with the files that it includes, and a motion file."""
    named = [robot]
    for name in named:
        included = re.findall(r"^include: \[(.*)\]", file(f"robots/{name}.yaml"), re.MULTILINE)
        named += [one.strip().removesuffix(".yaml") for line in included for one in line.split(",")]
    paths = [*(f"robots/{name}.yaml" for name in named), f"robots/motions/{motion}.yaml"]
    return {path: partial(file, path) for path in paths}


def inputs_of_pictures(reader: Reader) -> dict[str, Inputs]:
    """Return the inputs of each picture."""
    import by_hand
    import drawn

    def command(line: str) -> Inputs:
        return {f"dxlrun {line}": partial(reader.output, line)}

    def said_by(*modules: str) -> Inputs:
        return {f"words of {modules[0]}": partial(words, *modules)}

    names = ("arm.yaml", "wave.yaml")
    arm = {f"docs/tutorial/arm.md: {name}": (reader.place / name).read_text for name in names}
    torso = robot_and_motion("bioloid_torso_imu", "three_parts")
    view: Inputs = {"page of dxlrun view": page_of_view}
    analysis, lab = "dxlrun_analysis", "dxlrun_lab"
    page = said_by(
        *(f"{analysis}.page.{part}" for part in ("report_page", "loop_plots", "joint_plots", "wake_up_plots"))
    )
    analyzed = {**command(FIRST), "dxlrun analyze": reader.analysis}
    latency = (
        f"{lab}.commands.latency",
        f"{lab}.latency.latency_measurement",
        f"{analysis}.page.wake_up_plots",
    )
    return {
        "terminal": analyzed,
        "report": {**analyzed, **page},
        "check": command("check arm.yaml"),
        "mistakes": {"dxlrun check, of a file with five mistakes": reader.mistakes},
        "graph": command("check robots/bioloid_torso.yaml --graph"),
        "scan": said_by("dxlrun.cli.tools.scan"),
        "lost": {"dxlrun analyze, of a silent servo": reader.lost},
        "fall": robot_and_motion("fall_reflex", "fall_reflex_tip"),
        "cycle": robot_and_motion("bioloid_torso", "three_parts"),
        **{
            name: {
                **{
                    f"robots/{one}": partial(file, f"robots/{one}")
                    for one in (f"{arm}.yaml", f"urdf/{arm}.urdf")
                },
                **said_by("dxlrun_space.reach"),
            }
            for name, arm in (("reach", "open_manipulator_x"), ("reach_op3", "op3"))
        },
        "processes": {"drawing": drawn.processes},
        "motion": {"drawing": drawn.motion},
        "key": {"drawing": drawn.key},
        "setup_hands": {"drawing": by_hand.draw_setup},
        "calibrate_hands": {"drawing": by_hand.draw_calibrate},
        "teach_hands": {"drawing": by_hand.draw_teach},
        "setup": said_by(
            "dxlrun_hand.servo_setup", "dxlrun.dynamixel.tools.one_servo", "dxlrun.dynamixel.texts"
        ),
        "calibrate": said_by("dxlrun_hand.calibration", "dxlrun_hand.commands.calibrate"),
        "teach": said_by("dxlrun_hand.teaching", "dxlrun_hand.commands.teach", "dxlrun_hand.lines"),
        "characterize": {
            "robots/single_joint.yaml": partial(file, "robots/single_joint.yaml"),
            **said_by(
                f"{lab}.characterize.characterization_page", f"{lab}.characterize.characterization_tables"
            ),
        },
        "arm_report": {**arm, **page},
        "watch": {**arm, **said_by("dxlrun.cli.steering.watch")},
        "doctor": said_by("dxlrun.cli.doctor", "dxlrun.run.machine_checks"),
        "latency": said_by(*latency),
        "view": {**torso, **view},
        "view_phone": {**torso, **view},
        **{
            name: {
                "how it is shown": partial(repr, shown),
                **robot_and_motion(shown.robot, shown.motion),
                **view,
            }
            for name, shown in ROBOTS.items()
        },
    }


def hashes(names: Iterable[str] = ()) -> dict[str, dict[str, str]]:
    """Return the hashes of the inputs of pictures, of all by default."""
    with tempfile.TemporaryDirectory() as directory:
        place = Path(directory)
        prepare(place)
        table = inputs_of_pictures(Reader(place))
        return {
            name: {one: hashlib.sha256(text().encode()).hexdigest()[:12] for one, text in table[name].items()}
            for name in names or table
        }


def record(names: Iterable[str]) -> None:
    """Write the hashes of pictures that were made now."""
    kept = json.loads(HASHES.read_text()) if HASHES.exists() else {}
    HASHES.write_text(json.dumps({**kept, **hashes(names)}, indent=1, sort_keys=True) + "\n")


def stale(names: Iterable[str] = ()) -> list[str]:
    """Return a line for each picture, of all by default, whose inputs have changed since it was made."""
    kept, found = json.loads(HASHES.read_text()), hashes(names)
    lines = []
    for name in sorted(names or {*kept, *found}):
        before, now = kept.get(name, {}), found.get(name, {})
        changed = sorted(one for one in {*before, *now} if before.get(one) != now.get(one))
        if changed:
            lines.append(f"{name}: {', '.join(changed)} changed; run python docs/pictures/make.py {name}")
    return lines


def lose_servo(place: Path, log: Path) -> None:
    """Run the tutorial's motion on virtual time with a servo that is silent for a second."""
    from dxlrun.testing import simulated_robot
    from dxlsim.faults.fault import parse_fault
    from dxlsim.faults.script import FaultScript

    robot = simulated_robot(place / "arm.yaml", play=[place / "wave.yaml"], log=log)
    FaultScript([parse_fault("silence servo=3 at=3s for=1s")]).attach(robot.buses)
    robot.run()
