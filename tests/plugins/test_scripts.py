"""Controllers by scripts: what they command and report when servos, clients and time do what a text says.

The texts in `scripts` have the form of `tests/kit/cases.py`; the head is a controller:

    A command between two updates starts from the position that is desired then
      at 0 trajectory to 1.3 in 1 s
      at 0.5 trajectory {points: [{time: 1, positions: [0]}]}
      at 0.5 1.5 => position 0.8, 0

Before the activation: `keys` of the controller, `with` options of its stage (`tests.kit.stages`), and
`before`, which has what was `sent` and `measured`. Then: commands by their names; `change` of keys; `cancel`,
`activate`, `deactivate`, `restart`; `measured`, `sent`, `references` and `reads`; `servos` that `stay`,
`follow` or `move` at the commanded velocity, upward as far as an `obstacle`.
`at` updates at these times, s, and `steps` in so many cycles. `=>` has what is expected:

    => position 0.5 nan ± 0.01       commands, one a joint: at each time, or after the last step;
                                     with commas, one after each update
    => reached after 1.000 s (a, 0)  how the newest goal ended, its joint and error; `running`: it has not
    => said the text...              the next event; a script expects all of them
    => refused the text              of a command
"""

import math
import re
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import pytest
import yaml
from msgspec.structs import replace
from tests.kit.cases import case_parameters, fits, place_of
from tests.kit.stages import Stage

from dxlrun import LINEAR, MotorLoad, MotorModel, ServoModel
from dxlrun.channels.cycle import Torque
from dxlrun_controllers.plugin import dxlrun_controllers

LINE = re.compile(
    r"(?:at (?P<times>[\d. ]+?)(?:\s|$))?(?:steps (?P<steps>\d+)|(?P<word>[a-z]\w*) ?(?P<rest>.*))?$"
)
TO = re.compile(r"to ([-\d. ]+) in ([\d.]+) s ?(.*)$")
ENDED = re.compile(r"(reached|missed|aborted|cancelled|preempted) ?(.*?)(?: \((\w*), (.*)\))?$")
TORQUES = {True: Torque.ON, "lost": Torque.LOST, "released": Torque.RELEASED}
ROWS = ("position", "velocity", "effort", "pwm", "provided")
UNITS = {"linear": LINEAR}
PLAIN = MotorModel("MX-64", 12.0, 1.6, 3.6, 0.011, delay_ns=0, position_gain=0.16, p_gain=32,
                   torque_per_effort=1.6)  # fmt: skip
MODELS = {
    "MOTOR": MotorModel("XM430-W350", 12.0, 1.6, 4.0, 0.01, position_gain=0.005, p_gain=800),
    "PLAIN": PLAIN,
    "WEIGHT": replace(PLAIN, load=MotorLoad(0.0, 0.5, 0.0)),
    "XM430": ServoModel("XM430-W350", "ID 1 on bus main", "A", 4.1, 2.3, 12.0, 4.8, 80.0),
    None: None,
}
"""Models of motors and servos that scripts name"""


def parsed(text: str) -> Any:
    return yaml.safe_load(re.sub(r"(?<![\w.\"])(-?)(nan|inf)\b(?! \w)", r"\1.\2", text))


def assert_numbers(found: Any, text: str) -> None:
    numbers, _, tolerance = text.partition("±")
    expected = [float(word) for word in numbers.split()]
    near = {"abs": float(tolerance)} if tolerance else {"rel": 1e-6, "abs": 1e-9}
    assert np.ravel(found).tolist() == pytest.approx(expected, nan_ok=True, **near)


class Scene:
    """A controller on its stage. Before the first word that needs it, its keys and options are gathered."""

    def __init__(self, keys: dict[str, Any], options: dict[str, Any], before: dict[str, Any]) -> None:
        self.keys, self.options, self.before = dict(keys), dict(options), dict(before)
        self.servos, self._stage = "follow", None
        self.obstacle = math.inf
        self.unexpected: dict[str, list[Any]] = {}

    @property
    def stage(self) -> Stage:
        if self._stage is None:
            keys, options = dict(self.keys), dict(self.options)
            controller = resolve_name(dxlrun_controllers()[keys.pop("type")])
            for name in {"into", "others"} & set(options):
                options[name] = tuple(options[name])
            for name in {"motors", "servos"} & set(options):
                options[name] = tuple(MODELS[model] for model in options[name])
            if "unit" in options:
                options["unit"] = UNITS[options["unit"]]
            self._stage = stage = Stage(controller, keys, **options)
            self.unexpected = {
                "said": stage.said, "warned": stage.warned, "ends": stage.endings, "takeover": stage.takeovers
            }  # fmt: skip
            for word, values in self.before.items():
                self.put(word, values)
            stage.activate()
        return self._stage

    def put(self, word: str, values: Any) -> None:
        """Set what was measured, sent or referred to; null stays as it is."""
        stage = self.stage
        owner = {"measured": stage.states, "sent": stage.sent, "references": stage.context.references}
        rows = {"reads": values} if word == "reads" else values
        for name, value in rows.items():
            row = stage.context.reads if word == "reads" else getattr(owner[word], name)
            for place, one in enumerate(value if isinstance(value, list) else [value] * len(row)):
                if one is not None:
                    row[place] = TORQUES[one] if name == "torque" else one

    def perform(self, line: str) -> None:
        """Do what a line says, and check what it expects."""
        action, _, expected = line.partition("=>")
        match = LINE.match(action.strip())
        assert match, "this line is neither a time nor a word with its values"
        times = [float(time) for time in (match["times"] or "").split()]
        if match["word"]:
            self._do(match["word"], match["rest"], *times, refused=expected.strip())
        elif times or match["steps"]:
            self._update_all(times, int(match["steps"] or 0), expected.strip())
        else:
            self._expect(expected.strip())

    def _update_all(self, times: list[float], steps: int, expected: str) -> None:
        word, _, rest = expected.partition(" ")
        groups = rest.split(",") if word in ROWS else [rest]
        count = len(times) + steps
        if len(groups) == 1:
            every = groups if word in ROWS and times else [""]
            groups = every * (count - 1) + groups
        for at_s, group in zip([*times, *[None] * steps], groups, strict=True):
            if at_s is None:
                self._step()
            else:
                self.stage.update(at_s, follow=self.servos == "follow")
            if group:
                self._expect(f"{word} {group.strip()}")
        if word and not rest:
            self._expect(word)

    def _step(self) -> None:
        stage = self.stage
        states, commands = stage.states, stage.commands
        stage.step()
        if self.servos == "follow":
            np.copyto(states.position, commands.position, where=~np.isnan(commands.position))
        elif self.servos == "move":
            before, most = states.position.copy(), commands.velocity * stage.period_s
            place = before + np.clip(commands.position - before, -most, most)
            blocked = (before <= self.obstacle) & (place > self.obstacle)
            states.position[:] = np.where(blocked, self.obstacle, place)
            states.velocity[:] = (states.position - before) / stage.period_s

    def _do(self, word: str, rest: str, at_s: float | None = None, *, refused: str = "") -> None:
        if word in ("keys", "with", "before"):
            assert self._stage is None, f"{word} stands before everything else"
            target = {"keys": self.keys, "with": self.options, "before": self.before}[word]
            target |= parsed(rest)
            return
        stage = self.stage
        if word == "servos":
            assert rest in ("follow", "stay", "move")
            self.servos = rest
        elif word == "obstacle":
            self.obstacle = float(rest)
        elif word == "change":
            stage.change(at_s, **parsed(rest))
        elif word == "cancel":
            stage.cancel(at_s)
        elif word in ("activate", "deactivate", "restart"):
            getattr(stage.controller, f"on_{word}")(stage.time_ns)
        elif word in ("measured", "sent", "references", "reads"):
            self.put(word, parsed(rest))
        elif refused:
            with pytest.raises(ValueError, match=re.escape(refused.removeprefix("refused "))):
                stage.prepare(word, **parsed(rest))
        else:
            stage.send(at_s, word, **self._command(rest))

    @staticmethod
    def _command(rest: str) -> dict[str, Any]:
        if not (way := TO.match(rest)):
            return parsed(rest) or {}
        point = {"time": float(way[2]), "positions": [float(word) for word in way[1].split()]}
        return {"points": [point], **(parsed(way[3]) or {})}

    def _expect(self, text: str) -> None:
        stage, (word, _, rest) = self.stage, text.partition(" ")
        if match := ENDED.match(text):
            self._expect_end(*match.groups())
        elif word == "running":
            assert stage.goal.outcome is None, stage.goal.ended
        elif word == "outcomes":
            assert [
                goal.outcome.name.lower() if goal.outcome else "running" for goal in stage.goals
            ] == rest.split()
        elif word in ("said", "warned", "ends", "takeover"):
            found = self.unexpected[word].pop(0)
            found = f"{' '.join(found[0])}: {found[1]}" if word == "takeover" else found
            assert fits(found, rest), found
        elif word == "messages":
            assert len(stage.messages) == int(rest)
        elif word == "message":
            path, _, value = rest.partition(" ")
            found = stage.messages[-1][1]
            for name in path.split("."):
                found = getattr(found, name)
            if re.match(r"[-\d.]+|nan", value):
                assert_numbers(found, value)
            else:
                assert str(found) == value
        else:
            rows = stage.context.provided if word == "provided" else getattr(stage.commands, word)
            assert_numbers(rows, rest)

    def _expect_end(self, outcome: str, text: str, joint: str | None, error: str | None) -> None:
        assert self.stage.goal.ended, "the goal is running"
        ended, found, of_joint, off = self.stage.goal.ended[0]
        assert ended.name.lower() == outcome, (ended, found)
        if text:
            assert fits(found, text), found
        if joint is not None and error is not None:
            assert of_joint == joint
            assert_numbers(off, error)

    def finish(self) -> None:
        """Check that nothing was reported which the script does not expect."""
        assert not any(self.unexpected.values()), self.unexpected


@pytest.mark.parametrize("case", case_parameters(Path(__file__).with_name("scripts")))
def test_script(case):
    first = parsed(case.head)
    scene = Scene(first["keys"], first.get("with", {}), first.get("before", {}))
    for line in case.lines:
        with place_of(line):
            scene.perform(line.text)
    scene.finish()


def test_a_script_that_is_wrong_fails_at_its_line():
    keys = {"type": "joint_group_position_controller", "joints": ["a"]}
    for line in ("at 0 => position 0.4", "=> said hello", "=> reached", "keys {}", "at 0 => effort 1"):
        scene = Scene(keys, {"present": 0.3}, {})
        assert scene.stage
        with pytest.raises((AssertionError, IndexError)):
            scene.perform(line)
    assert math.isnan(parsed("[nan]")[0])
