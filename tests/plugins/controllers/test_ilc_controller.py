"""ilc_controller: the error of a repeated motion falls, and the correction stays small whatever happens."""

import itertools
import math
import random
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from tests.kit.stages import Stage

from dxlrun import Outcome
from dxlrun_controllers.laws.learning import Repetition, gaussian
from dxlrun_controllers.motions.ilc_controller import IlcController

pytestmark = pytest.mark.long

PERIOD_S = 0.02
TICK = math.radians(0.088)
MOTION_S = 4.0
MOST = math.radians(10)
TWO = {"joints": ["a", "b"]}


def points(phase: float = 0.0) -> list[dict[str, Any]]:
    """Return a motion that begins and ends at rest, of two joints."""
    times = np.linspace(0.0, MOTION_S, 41)
    wave = np.sin(np.pi * times / MOTION_S) ** 2
    q = [wave * np.sin(2 * times + phase), 0.5 * wave * np.sin(3 * times)]
    return [{"time": float(t), "positions": [float(q[0][i]), float(q[1][i])]} for i, t in enumerate(times)]


@dataclass
class Servos:
    """Two servos in position control: a delay in cycles, then a lag, s; they answer in ticks."""

    delay: int = 1
    lag_s: float = 0.06
    gain: float = 1.0
    position: np.ndarray = field(default_factory=lambda: np.zeros(2))
    goals: deque[np.ndarray] = field(default_factory=deque)

    def move(self, goal: np.ndarray) -> np.ndarray:
        self.goals.append(goal)
        while len(self.goals) > self.delay + 1:
            self.goals.popleft()
        share = 1.0 - math.exp(-PERIOD_S / self.lag_s)
        self.position = self.position + share * (self.gain * self.goals[0] - self.position)
        return np.round(self.position / TICK) * TICK


class Learner:
    """A controller on its servos, cycle by cycle."""

    def __init__(
        self,
        servos: Servos | None = None,
        *,
        kept: bytes = b"",
        into: tuple[str, ...] = (),
        limits: dict[str, float] | None = None,
        repeated: int = 0,
        **keys: object,
    ) -> None:
        options: dict[str, Any] = {"present": (0.0, 0.0), "kept": kept, "into": into, "limits": limits or {}}
        self.stage = Stage(IlcController, {**TWO, **keys}, **options).activate()
        self.servos, self.cycle, self.said = servos or Servos(), 0, self.stage.said
        self.corrections: list[np.ndarray] = []
        self.commanded: list[np.ndarray] = []
        self.speeds: list[np.ndarray] = []
        self.errors = [self.repeat() for _ in range(repeated)]

    @property
    def now_s(self) -> float:
        return self.cycle * PERIOD_S

    @property
    def learned(self) -> list[Any]:
        return self.stage.controller._known._known

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            commanded = self.stage.update(self.now_s, follow=False)
            self.corrections.append(self.stage.controller._correction.copy())
            self.commanded.append(commanded)
            self.speeds.append(self.stage.commands.velocity.copy())
            self.stage.states.position[:] = self.servos.move(commanded)
            self.cycle += 1

    def send(self, start_in: float = 0.5, given: list[dict[str, Any]] | None = None, **more: object) -> None:
        trajectory = points() if given is None else given
        self.stage.send(self.now_s, "trajectory", points=trajectory, start_in=start_in, **more)

    def repeat(self, phase: float = 0.0, rest_s: float = 1.5, start_in: float = 0.5) -> float:
        """Play the motion once; return its error by the newest message, deg."""
        self.send(start_in, points(phase))
        self.run(start_in + MOTION_S + rest_s)
        return math.degrees(self.stage.messages[-1][1].error) if self.stage.messages else math.nan


@pytest.mark.parametrize("interface", ["position", "posvel"])
def test_the_error_falls_tenfold_in_ten_repetitions(interface):
    learner = Learner(command_interface=interface, repeated=11)
    errors = learner.errors
    assert errors[0] > 3.0
    assert errors[10] < errors[0] / 10
    assert max(errors[5:]) < errors[0] / 8
    messages = [message for _, message in learner.stage.messages]
    assert [message.repetition for message in messages] == list(range(11))
    assert learner.said == [f"motion {messages[0].motion} is not learned yet: no correction"]


@pytest.mark.parametrize(("keys", "delay_s"), [({}, 4 * PERIOD_S), ({"delay": "30 ms"}, 0.03)])
def test_the_delay_is_that_of_the_first_repetition_unless_it_is_given(keys, delay_s):
    learner = Learner(Servos(delay=3, lag_s=0.001), repeated=1, **keys)
    # a goal is sent at the end of its cycle and read at the start of another: one cycle more than the servo's
    assert learner.learned[0].delay_s == pytest.approx([delay_s] * 2, rel=0.1)


# Servos that are swapped

OTHERS = {
    "slower": {"delay": 2, "lag_s": 0.12},
    "quicker": {"delay": 0, "lag_s": 0.005},
    "later": {"delay": 9},
    "leads": {"gain": 1.15},
    "lazy": {"gain": 0.6},
    "backward": {"gain": -1.0},
    "dead": {"gain": 0.0},
}


@pytest.fixture(scope="module")
def taught():
    """Return what a controller keeps after six repetitions."""
    kept: bytes = Learner(repeated=6).stage.keeps[-1]
    return kept


@pytest.mark.parametrize("name", OTHERS)
def test_a_swapped_servo_never_lets_the_error_grow_without_bound(name, taught):
    (fresh,) = Learner(Servos(**OTHERS[name]), gain=0.0, repeated=1).errors
    learner = Learner(Servos(**OTHERS[name]), kept=taught, repeated=14)
    errors = learner.errors
    assert np.abs(learner.corrections).max() <= MOST + 1e-9
    # what was learned on the other servo makes it worse by that correction at most, and only twice
    assert max(errors) < fresh + math.degrees(MOST)
    assert max(errors[3:]) < 1.3 * fresh
    assert min(errors[-3:]) < 1.1 * fresh
    if name in ("slower", "quicker", "later"):
        assert max(errors[-3:]) < fresh / 2
    # two errors in a row of more than twice the smallest one, which was 0.3 before
    twice = any(min(pair) > 2 * 0.3 for pair in itertools.pairwise(errors))
    assert any("is dropped" in text for text in learner.said) == (errors[0] > 0 and twice)


def test_one_bad_repetition_is_ignored_and_a_second_one_drops_what_was_learned():
    learner = Learner(repeated=6)
    before, count = learner.stage.keeps[-1], len(learner.stage.keeps)
    learner.servos.gain = 0.5
    learner.repeat()
    learner.servos.gain = 1.0
    assert "nothing is learned" in learner.said[-1]
    assert learner.stage.keeps[-1] == before
    assert learner.repeat() < 0.5, "the correction is still there"
    learner.servos.gain = 0.5
    learner.repeat()
    learner.repeat()
    assert "is dropped: again its error" in learner.said[-1]
    assert learner.learned == []
    assert len(learner.stage.keeps) == count + 2


# Repetitions from which nothing is learned


def skip_a_cycle(learner: Learner) -> None:
    learner.cycle += 1


def lose_a_reply(learner: Learner) -> None:
    learner.stage.states.valid[1] = False
    learner.run(PERIOD_S)
    learner.stage.states.valid[1] = True


def clamp_a_goal(learner: Learner) -> None:
    learner.stage.sent.position[0] += 0.001


def cancel(learner: Learner) -> None:
    learner.stage.cancel(learner.now_s)


def preempt(learner: Learner) -> None:
    learner.repeat(phase=1.0)


def slow_down(learner: Learner) -> None:
    learner.stage.change(learner.now_s, speed=0.5)
    learner.run(4.0)


def activate_again(learner: Learner) -> None:
    learner.stage.controller.on_deactivate(round(learner.now_s * 1e9))
    learner.stage.controller.on_activate(round(learner.now_s * 1e9))


@pytest.mark.parametrize(
    ("happen", "why"),
    [
        (skip_a_cycle, "cycles were skipped"),
        (lose_a_reply, "a servo did not answer"),
        (clamp_a_goal, "its goals were clamped"),
        (cancel, "it was not played to its end"),
        (preempt, "it was not played to its end"),
        (slow_down, "it is played at another speed"),
        (activate_again, "it was not played to its end"),
    ],
)
def test_a_repetition_that_was_disturbed_is_ignored(happen, why):
    learner = Learner(repeated=2)
    name, table = learner.stage.messages[0][1].motion, learner.stage.keeps[-1]
    learner.send()
    learner.run(2.0)
    happen(learner)
    learner.run(4.0)
    assert [text for text in learner.said if "nothing is learned" in text] == [
        f"nothing is learned from this repetition of motion {name}: {why}"
    ]
    if happen is not preempt:
        assert learner.stage.keeps[-1] == table
    learner.stage.change(learner.now_s, speed=1.0)
    learner.run(1.0)
    assert learner.repeat() < learner.errors[0] / 2, "the next one is played and learned from as before"


def test_a_motion_that_is_too_long_is_played_and_not_learned():
    learner = Learner(longest="3 s", repeated=1)
    assert learner.stage.goal.outcome is Outcome.REACHED
    assert "it is longer than `longest`" in learner.said[-1]
    assert not learner.stage.messages


def test_a_motion_that_begins_while_the_one_before_is_learned():
    learner = Learner()
    learner.stage.controller._steps = 1  # of 34: they take longer than the way to the first point
    learner.stage.controller._repetition._step = 16
    errors = [learner.repeat(rest_s=0.1, start_in=0.1) for _ in range(2)]
    assert np.any(learner.corrections), "in the second one, as soon as the first is learned"
    errors += [learner.repeat(rest_s=0.1, start_in=0.1) for _ in range(6)]
    assert errors[-1] < errors[1] / 5, "the first is reported with the second"
    assert any("the previous repetition is still being learned" in text for text in learner.said)


def test_joints_that_a_motion_does_not_move_get_no_correction():
    learner = Learner(Servos(gain=0.8, position=np.array([0.0, 0.3])))
    for _ in range(3):
        learner.send(given=[{**each, "positions": each["positions"][:1]} for each in points()], joints=["a"])
        learner.run(6.0)
    largest = np.abs(learner.corrections).max(axis=0)
    assert largest[0] > math.radians(3)
    assert largest[1] == 0.0


def test_each_motion_has_its_own_correction_and_the_oldest_is_forgotten():
    learner = Learner(motions=2)
    for phase in (0.0, 1.0):
        for _ in range(4):
            learner.repeat(phase)
    assert learner.repeat(0.0) < 0.6
    assert learner.repeat(1.0) < 0.6
    assert learner.repeat(2.0) > 2.0, "a changed motion is a new one"
    assert " is dropped for motion " in learner.said[-1]
    assert learner.repeat(1.0) < 0.6
    assert learner.repeat(0.0) > 2.0, "it was forgotten"


def test_a_motion_is_the_same_whenever_it_begins():
    made = Stage(IlcController, TWO)

    def key(stage: Stage = made, **command: object) -> tuple[float, ...]:
        return tuple(stage.prepare("trajectory", **command)[-2:].tolist())

    own = key(points=points())
    assert key(points=points(), start_in=2.0, timeout=9.0) == own
    others = {key(points=points(0.001)), key(points=points()[:-1]), key(points=points(), joints=["b", "a"])}
    others.add(key(Stage(IlcController, TWO | {"command_interface": "posvel"}), points=points()))
    assert len(others - {own}) == 4


@pytest.mark.parametrize("end", ["cancel", "next", "same"])
def test_no_correction_jumps(end):
    learner = Learner(repeated=5)
    learner.corrections.clear()
    learner.send()
    learner.run(1.7)
    if end == "cancel":
        learner.stage.cancel(learner.now_s)
        learner.run(1.0)
    learner.send(0.0, points(1.0 if end == "next" else 0.0))
    learner.run(6.0)
    steps = np.abs(np.diff(learner.corrections, axis=0))
    assert np.abs(learner.corrections).max() > math.radians(3)
    assert steps.max() < math.radians(2.0), "of 0.2 s, in which it fades, the steepest cycle has 15 %"


@pytest.mark.parametrize("into", [(), ("below",)])
def test_the_speed_is_that_of_the_corrected_position(into):
    learner = Learner(command_interface="posvel", into=into, repeated=4)
    begin = len(learner.commanded)
    learner.repeat()
    rows = slice(begin + 50, begin + 200)  # in the motion
    speeds = np.diff(learner.commanded, axis=0, prepend=[[0.0, 0.0]])[rows] / PERIOD_S
    off = np.abs(np.array(learner.speeds)[rows] - (speeds if into else np.abs(speeds)))
    grew = np.abs(np.diff(learner.corrections, axis=0)[rows]) / PERIOD_S
    # a linear piece ends every 5 rows: there the speed is already that of the next one
    assert np.median(off, axis=0) == pytest.approx([0.0, 0.0], abs=0.01)
    assert (np.median(grew, axis=0) > 0.05).all()


def test_a_correction_does_not_lead_over_a_limit():
    learner = Learner(limits={"lower": -0.6, "upper": 0.6}, repeated=4)
    assert np.abs(learner.commanded).max() == 0.6
    assert np.abs(learner.corrections).max() > math.radians(3)
    assert not any("clamped" in text for text in learner.said)


# From run to run


def test_the_next_run_continues_with_what_was_kept():
    learner = Learner(repeated=4)
    again = Learner(kept=learner.stage.keeps[-1], repeated=2)
    assert again.errors[0] == pytest.approx(learner.repeat(), abs=0.05)
    assert again.said == []
    assert again.stage.messages[0][1].repetition == 4


@pytest.fixture(scope="module")
def short():
    """Return what a controller of one short motion keeps."""
    kept: bytes = Learner(motions=1, longest="4.2 s", repeated=1).stage.keeps[-1]
    return kept


@pytest.mark.parametrize("seed", range(8))
def test_damaged_bytes_are_ignored_and_never_raise(seed, short):
    chance, data = random.Random(seed), bytearray(short)
    for _ in range(chance.randint(1, 4)):
        at = chance.choice([chance.randrange(60), chance.randrange(len(data))])
        data[at] = chance.randrange(256)
    data = data[: chance.choice([len(data), chance.randrange(len(data))])]
    again = Learner(motions=1, longest="4.2 s", kept=bytes(data), repeated=1)
    assert np.isfinite(again.corrections).all()
    assert np.abs(again.corrections).max() <= MOST + 1e-6


def test_another_period_forgets_and_reports_it(short):
    other = short[:4] + (10_000_000).to_bytes(8, "little") + short[12:]
    again = Learner(motions=1, longest="4.2 s", kept=other)
    assert again.said == [
        "the stored corrections cannot be used: they have a period of 10000000 ns instead of 20000000 ns"
    ]
    assert again.learned == []


def test_more_than_can_be_kept_is_refused():
    with pytest.raises(ValueError, match="lower `motions` or `longest`"):
        Stage(IlcController, TWO | {"longest": "3000 s"})


@pytest.mark.parametrize(("cutoff", "period"), [(5.0, 1 / 320), (2.0, 0.001), (8.0, 0.02)])
def test_the_low_pass_has_no_phase_and_half_the_power_at_its_cut_off(cutoff, period):
    weights = gaussian(cutoff, period)
    turns = np.exp(-2j * np.pi * cutoff * period * (np.arange(len(weights)) - len(weights) // 2))
    passed = np.sum(weights * turns)
    assert abs(passed) == pytest.approx(math.sqrt(0.5), rel=0.01)
    assert passed.imag == pytest.approx(0.0, abs=1e-12)
    assert weights.sum() == pytest.approx(1.0)
    assert (weights > 0).all()


@pytest.mark.parametrize("rows", [3, 40, 300, 1000])
def test_the_steps_give_what_the_formula_gives_at_once(rows):
    rng = np.random.default_rng(rows)
    joints, period, gain = 2, 0.005, 0.6
    law = Repetition(joints, 1200, period, 4.0)
    desired, measured, applied = rng.normal(size=(3, joints, rows))
    most, delay_s = np.array([0.5, 9.0]), np.array([0.0, 0.0123])
    for again in range(2):  # a second one begins from nothing
        law.start_recording()
        for row in range(rows - 2 * again):
            law.record(desired[:, row], measured[:, row], applied[:, row], judged=True)
    old = rng.normal(size=(joints, rows)).astype(np.float32)
    new = np.zeros((joints, rows), np.float32)
    steps = sum(1 for _ in law.learn_correction(old, new, gain, delay_s, most))
    weights = gaussian(4.0, period)
    half = len(weights) // 2
    played = np.concatenate([applied[:, : rows - 2], old[:, rows - 2 :]], axis=1)
    error = np.zeros((joints, rows + 10))
    error[:, : rows - 2] = (desired - measured)[:, : rows - 2]
    for joint in range(joints):
        at = np.arange(rows) + delay_s[joint] / period
        raw = played[joint] + gain * np.interp(at, np.arange(rows + 10), error[joint])
        padded = np.pad(raw, half, mode="edge")
        expected = np.convolve(padded, weights, mode="valid").clip(-most[joint], most[joint])
        assert new[joint] == pytest.approx(expected, abs=1e-6)
    assert steps <= joints * 2 * (rows // 150 + 1)
    assert law.error(rows - 2) == pytest.approx(np.sqrt(np.mean(error[:, : rows - 2] ** 2)))
