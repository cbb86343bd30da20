"""Steered robots as text: what clients request at which time, and what must come of it.

The texts in `tests/steering` have the form of `tests/kit/cases.py`; the head is a robot file. A story has
changes of the robot (`active: false => active: true`), and steps on virtual time:

    A joint that is commanded is not released by mistake
      at 0.4 s  torque off elbow
        => refused joint_commanded: elbow is commanded by arm
        => elbow holds
      at 0.6 s  torque off elbow release
        => elbow limp
        => active none

A line `=>` holds at the end of its step, which is the beginning of the next one; the last step has 0.2 s.
Requests of a step are separated by `;`, and are done where nothing else is said of them. `ACTIONS` and
`CHECKS` have all forms. A controller of the type `scripted` commands what is commanded of it, else `own`;
one of the type `holding` commands 0.5 when its stream has ended.
"""

import json
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import pytest
import yaml
from tests.kit.cases import Line, TextCase, place_of, read_form
from tests.kit.line_faults import turn_by_hand
from tests.kit.virtual_run import VirtualRun

import dxlrun
from dxlrun.channels.answers import Acceptance, Completion, Refusal
from dxlrun.channels.commands import LOOP, CommandMessage
from dxlrun.channels.cycle import LIMP, OFFLINE
from dxlrun.channels.event_records import Event, EventCode
from dxlrun.channels.ring import RecordKind
from dxlrun.compile import robot_compiler
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns, load_plugins
from dxlrun.plan.robot_plan import Plan
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun.testing import plan_of
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlwire.modes import Mode

LAST_S = 0.2


class Go(dxlrun.CommandModel):
    values: list[float]


class ScriptedParameters(dxlrun.ParametersModel):
    joints: tuple[str, ...] = ()
    command: tuple[str, ...] = ("position",)
    exports: tuple[str, ...] = ()
    takeovers: tuple[str, ...] = ()
    own: float | None = None
    speed: Annotated[float, dxlrun.LIVE] = 1.0


class Scripted(dxlrun.Controller[ScriptedParameters]):
    """Commands its own value or what is commanded of it; its goal `move` takes so many updates.

    The second value of `move` and `plan` is the number of updates after which it is aborted. A goal `aim` is
    judged by positions that it does not command.
    """

    Parameters = ScriptedParameters
    Commands: ClassVar = {"go": Go, "move": Go, "plan": Go, "aim": Go}
    Goals: ClassVar = frozenset({"move", "plan", "aim"})
    plans: ClassVar = frozenset({"plan"})
    story: ClassVar[Any] = None

    @classmethod
    def interfaces(cls, parameters: ScriptedParameters, joints: tuple[str, ...]) -> dxlrun.Interfaces:
        own = parameters
        return dxlrun.Interfaces(own.joints, own.command, own.exports, takeovers=own.takeovers)

    @classmethod
    def prepare(cls, kind: str, command: Any, parameters: ScriptedParameters) -> Any:
        return np.array(command.values)

    def _step(self, step: str) -> None:
        if self.story is not None:
            self.story.enter_step(self, step)

    def on_activate(self, time_ns: int) -> None:
        self.goal, self.left, self.own = None, 0, self.parameters.own
        self._step("activate")

    def on_deactivate(self, time_ns: int) -> None:
        self._step("deactivate")
        if self.goal is not None:
            self.goal.end(dxlrun.Outcome.REACHED)  # too late: it is aborted

    def on_parameters(self, time_ns: int) -> None:
        self._step("parameters")

    def on_command(self, kind: str, data: Any, time_ns: int) -> None:
        self._step("command")
        self.own = float(data[0]) if len(data) else self.own

    def on_goal(self, goal: Any, data: Any, time_ns: int) -> None:
        if goal.kind == "aim":
            self._step("goal")
            goal.judge(data)
            return
        self.goal, self.left = goal, int(data[0])
        self.fails = int(data[1]) if len(data) > 1 else -1
        self._step("goal")
        self._abort_due()

    def _abort_due(self) -> None:
        if self.fails == 0 and self.goal is not None:
            self.goal.end(dxlrun.Outcome.ABORTED, "out of reach")
            self.goal = None
        self.fails -= 1

    def on_cancel(self, goal: Any, time_ns: int) -> None:
        self.left = -2  # it comes to rest two updates later
        self._step("cancel")

    def update(self, time_ns: int, period_ns: int) -> None:
        self._step("update")
        for interface in self.parameters.command:
            given = getattr(self.context.references, interface)
            commands = getattr(self.context.commands, interface)
            if np.isfinite(given).any():
                np.copyto(commands, given, where=np.isfinite(given))
            elif self.own is not None:
                commands[:] = self.own
        if self.goal is not None:
            self._abort_due()
        if self.goal is not None:
            self.left += 1 if self.left < 0 else -1
            if self.left in (0, -1):
                self.goal.end(dxlrun.Outcome.REACHED if self.left == 0 else dxlrun.Outcome.CANCELLED)
                self.goal.feedback(0.5)  # too late: it changes nothing
                self.goal = None


class Holding(Scripted):
    """Holds by a command of its own when its stream ends."""

    def on_hold(self, time_ns: int) -> None:
        assert np.isnan(self.context.commands.position).all(), "it begins without commands"
        self._step("hold")
        self.context.commands.position[:] = self.own = 0.5


@dataclass
class Step:
    """Actions at a time, and the lines of what holds at the end."""

    at_s: float
    actions: list[str]
    place: str
    checks: list[Line] = field(default_factory=list)


class Story(VirtualRun):
    """The run of a case, which checks each step."""

    def __init__(self, plan: Plan, steps: Sequence[Step]) -> None:
        self.coming, self.step = list(steps), Step(-1.0, [], "")
        self.emitted: list[str] = []
        self.calls: list[str] = []
        self.sets: list[list[str]] = []
        self.asked: list[int] = []
        self.later: list[int] = []  # requests that wait
        self.taken: dict[str, Any] = {}
        self.breaks: dict[tuple[str, str], Callable[[Any], None]] = {}
        self.torque_given: list[str] = []
        self.ending = False
        plugins = with_scripted(self)
        super().__init__(plan, plugins=plugins, watch=self.see)
        self.door = Preparation({joint.name: joint for joint in plan.loop.joints}, plugins)
        for name, servo in self.servos.items():
            servo.registers.watch_items(("torque_enable",), partial(self.see_torque, name, servo))

    def check(self) -> None:
        """Run; raise AssertionError with file, line and what was found."""
        self.run()
        self.end_step()
        assert not self.coming, f"{self.coming[0].place}: the run ended before: {self.result}"

    # While it runs

    def begin_cycle(self) -> None:
        """Begin the steps that are due."""
        now_s = self.record.cycle * self.plan.loop.period_ns * 1e-9 + 1e-6
        if not self.coming and now_s >= self.step.at_s + LAST_S:
            self.stop.request()
            self.ending = True
        while self.coming and now_s >= self.coming[0].at_s:
            self.end_step()
            self.step = self.coming.pop(0)
            for kept in (self.emitted, self.calls, self.asked, self.torque_given):
                kept.clear()
            self.sets = self.sets[-1:]
            for action in self.step.actions:
                read_form(ACTIONS, action)(self)

    def see(self, kind: RecordKind, payload: Any) -> None:
        """Keep an event, or what is active in a cycle."""
        if kind == RecordKind.TAGGED:
            with suppress(msgspec.ValidationError):
                event = msgspec.msgpack.decode(payload, type=Event)
                self.emitted.append(f"{EventCode(event.code).name.lower()} {event.source}: {event.text}")
        elif kind == RecordKind.CYCLE:
            self.taken = self.snapshot()
            if self.sets[-1:] != [self.taken["active"]]:
                self.sets.append(self.taken["active"])

    def see_torque(self, name: str, servo: SimulatedServo) -> None:
        if servo.registers["torque_enable"]:
            self.torque_given.append(name)

    def snapshot(self) -> dict[str, Any]:
        record, states = self.record, self.record.states
        arrays = {"commands": record.commands.values, "reference": record.reference, "torque": states.torque}
        arrays |= {"position": states.position, "mode": states.mode}
        found: dict[str, Any] = {name: array.copy() for name, array in arrays.items()}
        found["on"] = {name: servo.torque_on for name, servo in self.servos.items()}
        plans = self.robot.manager.plans
        found["active"] = [plan.name for bit, plan in enumerate(plans) if record.active >> bit & 1]
        return found

    def enter_step(self, controller: Scripted, step: str) -> None:
        """Keep a call of a scripted controller, and do what a line asked for at this call."""
        name = controller.context.name
        if step != "update" and not self.ending:
            self.calls.append(f"{step} {name}")
        if act := self.breaks.pop((name, step), None):
            act(controller)

    # Actions

    def request(self, kind: str, /, of: str = LOOP, lease_s: float = 0.0, **data: Any) -> None:
        """Request something of the loop, or send a command to a controller."""
        try:
            named = of in [plan.name for plan in self.robot.manager.plans]
            raw = json.dumps(data).encode() if data and of == LOOP else b""
            unchecked = CommandMessage(0, of, kind, raw, "anna", round(lease_s * 1e9))
            self.asked.append(self.post(self.prepared(of, kind, data, lease_s) if named else unchecked))
        except RefusedRequest as error:
            self.asked.append(self.inbox.numbered(unchecked).number)
            self.inbox.answers[self.asked[-1]] = error.refusal

    def load(self, name: str, entry: str) -> None:
        keys = yaml.safe_load(entry)
        plan = self.plan.loop.controllers[0]
        usual = {"distribution": "tests 1", "publishes": (), "active": False, "every": 1}
        own = {"joints": keys.pop("joints", plan.joints), "command": keys.pop("command", ["position"])}
        fields = {
            key: keys.pop(key) for key in ("into", "reference", "fallback", "rate", "reads") if key in keys
        }
        parameters = json.dumps({**own, "exports": fields.get("reference", []), **keys})
        self.request("load", name=name, type="scripted", parameters=parameters, **usual, **own, **fields)

    def turn(self, joint: str, position: str) -> None:
        (planned,) = (one for bus in self.plan.buses for one in bus.servos if one.joint == joint)
        turn_by_hand(self.servos[joint], planned.direction * float(position) + planned.reference)

    def stick(self, joint: str, item: str, value: str) -> None:
        """Let an item of a servo keep a value, whatever is written."""
        servo = self.servos[joint]
        servo.registers.watch_items((item,), lambda: servo.poke(item, int(value)))

    # Checks

    def end_step(self) -> None:
        """Check the lines of the step that ends."""
        answers = [self.inbox.answers.get(number) for number in self.asked]
        self.unnamed = list(zip(self.asked, answers, strict=True))
        for line in self.step.checks:
            with place_of(line):
                what = read_form(CHECKS, line.text.removeprefix("=> "))(self)
                assert what is None, f"found: {what}\n  {self.told}"
        for _, answer in self.unnamed:
            done = isinstance(answer, Completion)
            assert done, f"{self.step.place}: not done: {answer}\n  {self.told}"

    @property
    def told(self) -> str:
        """Return what happened in the step."""
        return "\n  ".join(
            [*map(str, (self.sets, self.inbox.answers, self.result)), *self.calls, *self.emitted]
        )

    def next_answer(self, earlier: str | None) -> Any:
        """Return the answer to the next request of the step, or to the oldest one that waited."""
        number = self.later.pop(0) if earlier else self.unnamed.pop(0)[0]
        return number, self.inbox.answers.get(number)

    def refused(self, earlier: str | None, code: str, text: str | None) -> object:
        """Compare a refusal with its code and a part of its text, behind which its fields are."""
        _, found = self.next_answer(earlier)
        fits = isinstance(found, Refusal) and found.code == code
        return None if fits and (text or "") in f"{found.text} {found.fields}" else found

    def done(self, earlier: str | None, text: str | None) -> object:
        _, found = self.next_answer(earlier)
        return None if isinstance(found, Completion) and (text or "") in repr(found) else repr(found)

    def waits(self) -> object:
        number, found = self.next_answer(None)
        self.later.append(number)
        return None if isinstance(found, Acceptance) else found or "no answer"

    def active(self, text: str) -> object:
        wanted = [[] if one == "none" else one.split() for one in text.split(", then ")]
        found = self.sets if len(wanted) > 1 else self.sets[-1:]
        return None if found == wanted else found

    def ordered(self, step: str, names: str) -> object:
        found = [call.split()[1] for call in self.calls if call.split()[0] == step]
        return None if found == ([] if names == "none" else names.split()) else found

    def torque(self, joint: str, state: str) -> object:
        torque, on = self.taken["torque"][self.rows[joint]], self.taken["on"][joint]
        is_limp, is_lost = torque in LIMP, torque in OFFLINE
        fits = {"limp": is_limp and not on, "lost": is_lost, "holds": on and not is_limp and not is_lost}
        return None if fits[state] else f"torque {torque}, the servo has torque: {on}"

    def commanded(self, joint: str, value: str) -> object:
        found = self.taken["commands"][:, self.rows[joint]]
        found = found[np.isfinite(found)].tolist()
        wanted = [] if value == "nothing" else [float(value)]
        return None if found == pytest.approx(wanted) else found

    def is_near(self, found: float, value: str, tolerance: float = 1e-9) -> object:
        return None if found == pytest.approx(float(value), abs=tolerance, nan_ok=True) else found

    def reference(self, name: str, value: str) -> object:
        place = self.record.layout.references.index(name)
        return self.is_near(float(self.taken["reference"][place]), value.replace("nothing", "nan"))

    def mode(self, joint: str, name: str) -> object:
        found = Mode(int(self.taken["mode"][self.rows[joint]])).name.lower()
        return None if found == name.replace(" ", "_") else found

    def event(self, no: str | None, text: str) -> object:
        found = [event for event in self.emitted if text in event]
        return None if bool(found) == (not no) else found

    def ended(self, reason: str, text: str | None) -> object:
        fits = self.result is not None and self.result.reason == reason and (text or "") in self.result.detail
        return None if fits else self.result


def breaking(story: Story, name: str, step: str | None) -> None:
    """Let a scripted controller raise at its next step."""

    def fail(controller: Scripted) -> None:
        raise RuntimeError("broken")

    story.breaks[name, step or "update"] = fail


def requesting(act: str) -> Callable[..., None]:
    """Return the action in which a scripted controller asks the runtime for something in its next update."""

    def request(story: Story, name: str, *words: str) -> None:
        def do(controller: Scripted) -> None:
            if act == "take_over":
                controller.context.take_over(words[0].split(), words[2])
                if words[1]:
                    raise RuntimeError("broken")
            elif act == "end_run":
                controller.context.end_run(words[0])
            else:
                controller.own = float(words[0])

        story.breaks[name, "update"] = do

    return request


def switch(story: Story, activate: str | None, deactivate: str | None) -> None:
    story.request("switch", activate=(activate or "").split(), deactivate=(deactivate or "").split())


def flicker(story: Story, joint: str) -> None:
    """Let a servo answer in every second 20 ms from now on, without an end."""
    bus = next(bus for bus in story.buses if story.servos[joint] in bus.servos)

    def turn(on: bool) -> None:
        story.servos[joint].silence(on)
        bus.at(bus.now_ns + 20_000_000, partial(turn, not on))

    turn(True)


def servo_action(name: str, *values: Any) -> Callable[[Story, str], None]:
    return lambda story, joint: getattr(story.servos[joint], name)(*values)


def play(story: Story, text: str) -> None:
    """Request a motion: `leg go 0=0.1 0.1=0.2 until 0.3, arm move 0=5/3`; a value may be missing."""
    parts, values = [], []
    for part in text.split(", "):
        points, _, end_s = part.partition(" until ")
        controller, kind, *pairs = points.split()
        times = [float(pair.partition("=")[0]) for pair in pairs]
        given = [pair.partition("=")[2].split("/") for pair in pairs]
        values += [float(value) for one in given for value in one if value]
        parts.append(
            {
                "controller": controller,
                "kind": kind,
                "at_ns": [round(at_s * 1e9) for at_s in times],
                "sizes": [*map(len, given)],
                "end_ns": round(float(end_s or 0) * 1e9),
            }
        )
    head = json.dumps({"parts": parts}).encode()
    data = head + b"\n" + np.array(values, dtype="<f8").tobytes()
    story.asked.append(story.post(CommandMessage(0, LOOP, "play", data, "anna")))


def send_bytes(story: Story, controller: str | None, kind: str, data: str) -> None:
    """Send a command as no gateway does."""
    message = CommandMessage(0, controller or LOOP, kind, bytes.fromhex(data), "anna")
    story.asked.append(story.post(message))


def command(story: Story, controller: str, kind: str, data: str, seconds: str | None) -> None:
    story.request(kind, controller, float(seconds or 0), **yaml.safe_load(data or "{}"))


ACTIONS: dict[str, Callable[..., None]] = {
    r"(?:activate (.+?))?(?:, )?(?:deactivate (.+))?": switch,
    r"torque (on|off) (.+?)( release)?": lambda story, on, joints, release: story.request(
        "torque", joints=joints.split(), on=on == "on", release=bool(release)
    ),
    r"reboot (.+?)( release)?": lambda story, joints, release: story.request(
        "reboot", joints=joints.split(), release=bool(release)
    ),
    r"rate (\S+) Hz": lambda story, rate: story.request("rate", rate=float(rate)),
    r"(pause|resume|halt|stop)": lambda story, kind: story.request(kind),
    r"cancel goal (-?\d+)": lambda story, goal: story.request("cancel", goal=int(goal)),
    r"cancel (\w+)": lambda story, name: story.request("cancel", controller=name),
    r"load (\w+) (\{.*\})": Story.load,
    r"unload (\w+)": lambda story, name: story.request("unload", controller=name),
    r"ask (\w+) (\{.*\})": lambda story, kind, data: story.request(kind, **yaml.safe_load(data)),
    r"parameters (\w+) (\{.*\})": lambda story, name, values: story.request(
        "parameters", controller=name, values=yaml.safe_load(values)
    ),
    r"send (\w+) (\w+)(?: (\{.*\}))?(?: for (\S+) s)?": command,
    r"play (.+)": play,
    r"bytes (?:(\w+) )?(\w+) ([0-9a-f]+)": send_bytes,
    r"(\w+) breaks(?: in (\w+))?": breaking,
    r"(\w+) requests (.+?)( and breaks)?: (.+)": requesting("take_over"),
    r"(\w+) ends the run: (.+)": requesting("end_run"),
    r"(\w+) commands (\S+)": requesting("command"),
    r"hand (\w+) to (\S+)": Story.turn,
    r"stick (\w+) (\w+) (\d+)": Story.stick,
    r"flicker (\w+)": flicker,
    r"silence (\w+)": servo_action("silence"),
    r"answer (\w+)": servo_action("silence", False),
    r"overload (\w+)": servo_action("trigger_overload"),
    r"power cycle (\w+)": servo_action("power_cycle"),
    r"poke (\w+) (\w+) (\d+)": lambda story, joint, item, value: story.servos[joint].poke(item, int(value)),
}
"""Actions of a step."""

CHECKS: dict[str, Callable[..., object]] = {
    r"(then )?refused (\w+)(?:: (.+))?": Story.refused,
    r"(then )?done(?: (.+))?": Story.done,
    r"waits": Story.waits,
    r"active (.+)": Story.active,
    r"(activate|deactivate|command|goal|cancel|parameters) called: (.+)": Story.ordered,
    r"(\w+) (limp|holds|lost)": Story.torque,
    r"(\w+) got no torque": lambda story, name: name in story.torque_given or None,
    r"(\w+) commanded (\S+)": Story.commanded,
    r"(\w+) at (\S+)": lambda story, name, value: story.is_near(
        float(story.taken["position"][story.rows[name]]), value, 0.02
    ),
    r"(\S+) referenced (\S+)": Story.reference,
    r"(\w+) in (.+) mode": Story.mode,
    r"(no )?event (.+)": Story.event,
    r"run (ended|stopped|fault)(?:: (.+))?": Story.ended,
}
"""Lines that say what holds; each returns what was found instead, or None."""


@cache
def plain_plugins() -> PlugIns:
    return load_plugins()


def with_scripted(story: Story | None = None) -> PlugIns:
    """Return the installed plug-ins and the types `scripted` and `holding`."""
    own = {one.__name__.lower(): type(one.__name__, (one,), {"story": story}) for one in (Scripted, Holding)}
    offers = {name: Offer(name, one, "tests 1") for name, one in own.items()}
    return PlugIns({**plain_plugins().controllers, **offers}, {}, drivers=plain_plugins().drivers)


PLANS: dict[str, Plan] = {}


def compile_story(text: str, folder: Path) -> Plan:
    """Compile a robot once for all of its stories."""
    if text not in PLANS:
        (folder / "robot.yaml").write_text(text)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(robot_compiler, "load_plugins", lambda **_: with_scripted())
            PLANS[text] = plan_of(folder / "robot.yaml")
    return PLANS[text]


def check_story(case: TextCase, folder: Path) -> None:
    """Run a case; raise AssertionError with file, line and what was found."""
    text, steps = case.head, list[Step]()
    for line in case.lines:
        if found := re.fullmatch(r"at (\S+) s *(.*)", line.text):
            actions = found[2].split("; ") if found[2] else []
            steps.append(Step(float(found[1]), actions, line.place))
        elif line.text.startswith("=> "):
            assert steps, f"{line.place}: nothing is expected before the first step"
            steps[-1].checks.append(line)
        else:
            right, _, wrong = line.text.replace("\\n", "\n").partition(" => ")
            added = right.startswith("+ ")
            assert added or right in text, f"{line.place}: {right}"
            text = f"{text}{right[2:]}\n" if added else text.replace(right, wrong, 1)
    Story(compile_story(text, folder), steps).check()
