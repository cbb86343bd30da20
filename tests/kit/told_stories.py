"""Robots on virtual time by stories in text: what a client asks, what fails, and how goals and shafts end.

The texts have the form of `tests/kit/cases.py`. The head is a robot file, or a line with the name of one in
`robots`, and after `----` a motion for it:

    A jammed joint misses its goal
      run 3 s leader_torque:=off       duration, and arguments of the robot file
      id: 1, => id: 1, tolerance: 8 deg,
      play                             the motion of this text, one of `robots/motions`, or a name
      jam servo=2 at=500ms             a fault, as `dxlrun --fault` has it
      hand servo=2 by=-30 at=1300ms    a hand turns a shaft by degrees at once, against the servo
      stands servo=2 200               where a shaft is when its servo gets power, deg from raw 0
      poke servo=2 max_torque 500      a register before the run, or `... 500 at=1200ms` then
      mute servo=2 at=500ms for=60ms   replies are lost, while the servo executes its instructions
      busy at=500ms for=50ms           a cycle takes so much longer
      at 0.2 arm trajectory {points: [{time: 1, positions: [0.7, 0]}]}
      at 0.9 cancel {controller: arm}
      at 1 head positions {positions: [0.1]} for 0.2 s     a stream that ends so long after
      => goal arm missed joint grip is...
      => shaft 2 at 2.9: 10 to 20 deg

Expected are each goal that ends, events (`=> event arm turns...`, `=> no event ...`; `any` is each source;
`=> times 4 arm turns...` counts them), shafts, deg from the reference, and columns of the log: `=> position
elbow from 1.5 to 2: 0.29 to 0.31`, with `spread` before the numbers for the difference of the largest and
the smallest one, `step` for the largest one of neighbours, `bend` for that of two steps, `in 100 ms` for
the largest change in a time, `most` for the largest amount. Without a time it is the last cycle. `=> topic
/pid/state: 0 to 30` is about the ms between its messages, `=> cycles woken_ns: 20 to 100` between cycles,
`=> active arm at 1: 0` about a controller, `=> lasts 1.5 to 2 s` and `=> skips 4` about the whole run. `=>
wrote 1 led: 1 0` has the values that a servo was sent, by the ledger, `=> sent 1/goal_velocity from 1 to 2:
step 0 to 4` measures them, and `=> goals 1: 30 32` has the addresses of its goals in turn. `=> refused ...`
has each request that was. `=> verdict not good`, or another line of `tests/analysis/judged.py`, is about the
analysis, which counts the states of `=> invalid elbow: 0 to 2`. `...` stands for any text. Each run is equal
to its replay. `needs physics` names an extra. A case may have several runs: by `NAME = a | b` its `NAME`
stands for one text after the other, and two do by `NAME OTHER = a ; b | c ; d`, and by more lines of the
same names.
"""

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tests.kit.cases import Line, TextCase, fits, place_of, read_cases, read_form
from tests.kit.line_faults import lose_replies, turn_by_hand
from tests.kit.totals import holds, totals_of
from tests.kit.virtual_run import MS, VirtualRun, ask, source_states
from tests.kit.wire import SYNC_WRITE, taken_apart, writes

from dxlrun.channels.answers import Acceptance, Code, Refusal
from dxlrun.channels.event_records import EventCode
from dxlrun.compile.motion_names import is_name
from dxlrun.log.log_reader import Log, open_log, read_log
from dxlrun_analysis.joints.goal_tracking import tracking
from dxlrun_analysis.replay import replay_log
from dxlrun_analysis.verdict import judge_run
from dxlsim.faults.kinds import KINDS

ROBOTS = Path(__file__).parents[2] / "robots"
LOOK_MS = 10
WHERE = r"(?: at (?P<at>[\d.]+)| from (?P<begin>[\d.]+) to (?P<end>[\d.]+))?"
HOW = r"(?:(?P<measure>most|spread|step|bend|in (?P<ms>\d+) ms) )?"
NUMBERS = r"(?P<low>[-\d.]+|nan)(?: to (?P<high>[-\d.]+))?(?: deg)?"
MEASURED = re.compile(rf"(?P<column>\w+) (?P<name>[\w./]+){WHERE}: {HOW}{NUMBERS}$")


def request(run: VirtualRun, *words: str) -> None:
    at_s, controller, kind, values, lease_s = words
    fields, ms = yaml.safe_load(values), float(at_s) * 1000
    if controller:
        run.command(ms, controller, kind, fields, float(lease_s or 0))
    else:
        run.ask(ms, ask(kind, fields))


def turn(run: VirtualRun, servo_id: str, degrees: str, ms: str) -> None:
    servo = run.servo(int(servo_id))
    run.at(int(ms), lambda: turn_by_hand(servo, servo.shaft.angle + math.radians(float(degrees))))


def place(run: VirtualRun, servo_id: str, degrees: str) -> None:
    servo = run.servo(int(servo_id))
    turn_by_hand(servo, math.radians(float(degrees)))
    servo.power_cycle()  # it forgets its turn


def mute(run: VirtualRun, servo_id: str, ms: str, for_ms: str) -> None:
    lose_replies(run.buses[0], int(servo_id), int(ms) * MS, (int(ms) + int(for_ms)) * MS)


def delay(run: VirtualRun, ms: str, for_ms: str) -> None:
    hardware, left = run.robot.hardware, [int(for_ms) * MS]
    read = hardware.read_states

    def read_late() -> None:
        if left and run.now_ms >= int(ms):
            run.clock.wait_until(run.clock.now_ns() + left.pop())
        read()

    vars(hardware)["read_states"] = read_late


def poke(run: VirtualRun, servo_id: str, item: str, value: str, ms: str | None) -> None:
    write = partial(run.servo(int(servo_id)).poke, item, int(value))
    run.at(int(ms), write) if ms else write()


EVENTS: dict[str, Callable[..., None]] = {
    r"hand servo=(\d+) by=([-\d.]+) at=(\d+)ms": turn,
    r"stands servo=(\d+) ([-\d.]+)": place,
    r"mute servo=(\d+) at=(\d+)ms for=(\d+)ms": mute,
    r"busy at=(\d+)ms for=(\d+)ms": delay,
    r"poke servo=(\d+) (\w+) (-?\d+)(?: at=(\d+)ms)?": poke,
    r"at ([\d.]+) (?:(\w+) )?(\w+) (\{.*\})(?: for ([\d.]+) s)?": request,
}
"""Function that makes each event of a story, by the pattern of its line."""


class Story:
    """One case: what happens in the run, and what is expected after it."""

    def __init__(self, folder: Path, text: Path, robot: str, motion: str, shafts: Iterable[int]) -> None:
        self.folder, self.beside, self.robot, self.motion = folder, text.parent, robot, motion
        self.seconds, self.arguments, self.shafts = 0.0, dict[str, str](), shafts
        self.play, self.faults = list[Path | str](), list[str]()
        self.events: list[Callable[[VirtualRun], None]] = []
        self.goals: list[dict[str, Any]] = []

    def tell(self, line: str) -> None:
        """Take a line of what happens."""
        word, _, rest = line.partition(" ")
        if " => " in line:
            old, _, new = line.partition(" => ")
            new = new.replace("\\n", "\n")
            assert old in self.robot + self.motion, f"robot and motion lack {old!r}"
            self.robot, self.motion = self.robot.replace(old, new), self.motion.replace(old, new)
        elif word == "run":
            seconds, _, *arguments = rest.split()
            self.seconds, self.arguments = float(seconds), dict(one.split(":=") for one in arguments)
        elif word == "play":
            own = self.folder / "own_motion.yaml"
            own.write_text(self.motion)
            self.play.append(own if not rest else rest if is_name(rest) else ROBOTS / "motions" / rest)
        elif word in KINDS:
            self.faults.append(line)
        else:
            self.events.append(read_form(EVENTS, line))

    def perform(self) -> None:
        """Run, compare with the replay, and keep the log."""
        for beside in (*ROBOTS.iterdir(), *self.beside.iterdir()):
            (self.folder / beside.name).symlink_to(beside)
        file, path = self.folder / "own.yaml", self.folder / "run.mcap"
        file.write_text(self.robot)
        options: dict[str, Any] = {"arguments": self.arguments, "play": self.play}
        run = self.virtual = VirtualRun(file, path, duration_s=self.seconds or None, **options)
        run.fault(*self.faults)
        for happens in self.events:
            happens(run)
        run.sample(map(run.servo, self.shafts), LOOK_MS, end_ms=self.seconds * 1000)
        self.result = run.run()
        answers = [one for _, one in sorted(run.inbox.answers.items()) if not isinstance(one, Acceptance)]
        assert len(answers) == run.inbox.count, f"{len(answers)} of {run.inbox.count} requests were answered"
        self.refused = [one for one in answers if isinstance(one, Refusal) and one.code != Code.GOAL_REFUSED]
        assert replay_log(path).same
        self.log: Log = read_log(path)
        ended = [event for event in self.log.events if event.code == EventCode.GOAL_ENDED]
        self.goals = [json.loads(event.data) for event in ended]

    def expect(self, line: str) -> None:
        word, _, rest = line.partition(" ")
        if word == "goal":
            controller, status, *text = rest.split(" ", 2)
            goal = next(one for one in self.goals if one["controller"] == controller)
            self.goals.remove(goal)
            assert goal["status"] == status, goal
            assert not text or fits(goal["text"], text[0]), goal
        elif word in ("event", "no", "times"):
            count, rest = rest.split(" ", 1) if word == "times" else ("", rest.removeprefix("event "))
            source, _, text = rest.partition(" ")
            texts = [
                event.text
                for event in self.log.events
                if source == "any" or event.source in (source, "runtime")
            ]
            found = sum(fits(one, text) for one in texts)
            assert found == int(count) if count else bool(found) == (word == "event"), texts
        elif word == "refused":
            assert fits(self.refused[0].text, rest), self.refused
            self.refused.pop(0)
        elif word == "verdict":
            verdict = judge_run(totals_of(self.folder / "run.mcap"))
            assert holds(verdict, rest), (verdict.sentences, verdict.findings)
        elif word == "skips":
            assert self.result.skipped == int(rest), self.result
        elif word == "lasts":
            least, most = map(float, rest.removesuffix(" s").split(" to "))
            assert least <= (lasted := self.virtual.clock.now_ns() * 1e-9) <= most, lasted
        elif word == "wrote":
            servo, _, rest = rest.partition(" ")
            item, _, values = rest.partition(":")
            found = [value for _, value in self.virtual.sent(int(servo), item)]
            assert found == [int(value) for value in values.split()], found
        elif word == "goals":
            servo, _, addresses = rest.partition(": ")
            assert [*map(str, self._goal_addresses(int(servo)))] == addresses.split()
        elif word == "fails":
            assert fits(f"{self.result.reason}, then {self.result.last}: {self.result.detail}", rest)
            self.result = None
        else:
            match = MEASURED.match(line)
            assert match, "this is neither a goal, an event, a shaft nor a column of the log"
            found = self.values(match["column"], match["name"], match)
            low, high = float(match["low"]), float(match["high"] or match["low"])
            assert found.size
            inside = [
                low - 1e-9 <= one <= high + 1e-9 or (math.isnan(one) and math.isnan(low)) for one in found
            ]
            assert all(inside), (min(found), max(found))

    def _goal_addresses(self, number: int) -> list[int]:
        """Return the first address of each goal that a servo was sent, by the ledger; none twice in turn."""
        found = []
        for bus in self.virtual.plan.buses:
            entries = [one for one in self.virtual.ledger.entries if one.bus == bus.name]
            for sent in taken_apart(entries, bus.protocol):
                if sent.instruction == SYNC_WRITE:
                    written = writes(sent, bus.protocol)
                    found += [address for servo, address, _ in written if servo == number]
        return [address for address, _ in groupby(found)]

    def values(self, column: str, name: str, match: re.Match[str]) -> Any:
        """Return what a line is about: values, or what it measures of them."""
        period_s = self.virtual.plan.loop.period_ns * 1e-9
        if column == "invalid":
            counted = totals_of(self.folder / "run.mcap").invalid
            assert self.result.invalid == counted == tuple(joint.invalid for joint in tracking(self.log))
            return np.array([counted[self.log.joints.index(name)]])
        if column == "cycles":
            return np.diff(self.log.cycles[name].astype(np.int64)) / 1e6
        if column == "topic":
            return np.diff(open_log(self.folder / "run.mcap").columns(name)["t_ns"]) / 1e6
        if column == "sent":
            servo, _, item = name.partition("/")
            ms, written = np.array(self.virtual.sent(int(servo), item)).T
            begin = float(match["begin"]) * 1000 if match["begin"] else ms[-1]
            end = float(match["end"]) * 1000 if match["end"] else math.inf
            return measured(written[(begin <= ms) & (ms < end)], match, period_s)
        if column == "shaft":
            servo = self.virtual.servo(int(name))
            rows = np.degrees(self.virtual.shaft(servo) - self.middle(int(name)))
            period_s = LOOK_MS * 1e-3
        elif column == "source_state":
            rows = source_states(self.log)[name]
        elif column == "active":
            names = [one.name for one in self.virtual.plan.loop.controllers]
            rows = self.log.cycles["active"] >> names.index(name) & 1
        else:
            names = self.log.joints if "/" not in name else self.virtual.record.layout.references
            rows = self.log.cycles[column][:, list(names).index(name)]
        if match["begin"]:
            part = slice(*(round(float(match[end]) / period_s) for end in ("begin", "end")))
            return measured(rows[part], match, period_s)
        return rows[[round(float(match["at"]) / period_s) if match["at"] else -1]]

    def middle(self, number: int) -> float:
        """Return the middle of a servo's turn, rad."""
        plans = [servo for bus in self.virtual.plan.buses for servo in bus.servos]
        return float(next(servo.reference for servo in plans if servo.servo_id == number))

    def finish(self) -> None:
        """Check that nothing ended which the story does not expect."""
        assert not self.goals, self.goals
        assert not self.refused, self.refused
        if self.result is not None:
            assert (self.result.reason, self.result.detail) == ("ended", "")


def measured(values: Any, match: re.Match[str], period_s: float) -> Any:
    """Return values of each period, or the one number that a line measures of them."""
    if match["measure"] == "most":
        return np.array([np.abs(values).max()])
    if match["measure"] == "spread":
        return np.array([np.ptp(values)])
    if match["measure"] == "bend":
        return np.array([np.abs(np.diff(values, 2)).max()])
    if match["measure"]:
        apart = round(float(match["ms"]) * 1e-3 / period_s) if match["ms"] else 1
        return np.array([np.abs(values[apart:] - values[:-apart]).max()])
    return values


def story_parameters(folder: Path) -> Iterator[Any]:
    """Yield the cases of all texts in a folder, as parameters of a test."""
    for case in read_cases(folder):
        for name, each in variants(case.lines):
            marks = [pytest.mark.needs(line.text[6:]) for line in each if line.text.startswith("needs ")]
            rest = [line for line in each if not line.text.startswith("needs ")]
            yield pytest.param(case._replace(lines=rest), id=f"{case.place}: {case.name}{name}", marks=marks)


def variants(told: Sequence[Line]) -> Iterator[tuple[str, Sequence[Line]]]:
    """Yield the lines of a case for each text that its names stand for."""
    named = [re.match(r"([A-Z]+(?: [A-Z]+)*) = (.*)", line.text) for line in told]
    names = next((one[1] for one in named if one), None)
    if names is None:
        yield "", told
        return
    texts = [text for one in named if one and one[1] == names for text in one[2].split(" | ")]
    others = [line for line, one in zip(told, named, strict=True) if not one or one[1] != names]
    for text in texts:
        rest = others
        for name, value in zip(names.split(), text.split(" ; "), strict=True):
            rest = [line._replace(text=line.text.replace(name, value)) for line in rest]
        yield from ((f" ({text}){more}", lines) for more, lines in variants(rest))


def check_story(case: TextCase, folder: Path) -> None:
    """Perform a story in an empty folder, and check what it expects; errors name file and line."""
    robot, _, motion = case.head.partition("----\n")
    if robot.strip().endswith(".yaml"):
        robot = (ROBOTS / robot.strip()).read_text("utf-8")
    texts = [line.text for line in case.lines]
    if any("mujoco" in text for text in texts):
        pytest.importorskip("mujoco")
    shafts = {int(text.split()[2].rstrip(":")) for text in texts if text.startswith("=> shaft ")}
    story = Story(folder, case.file, robot, motion, shafts)
    performed = False
    for line in case.lines:
        with place_of(line):
            if not line.text.startswith("=> "):
                story.tell(line.text)
                continue
            if not performed:
                story.perform()
            performed = True
            story.expect(line.text.removeprefix("=> "))
    assert performed, "the story expects nothing"
    story.finish()
