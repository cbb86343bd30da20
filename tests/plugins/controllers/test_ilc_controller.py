"""ilc_controller: the error of a repeated motion falls, whatever happens the correction stays small, and what
was learned goes on in the next run. Plants are a delay and a lag with ticks; the law is computed twice."""

from __future__ import annotations

import itertools
import math
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

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


def points(phase: float = 0.0) -> list[dict[str, object]]:
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

    def __init__(self, servos: Servos | None = None, kept: bytes = b"", **more: object) -> None:
        parameters = {"joints": ["a", "b"], **more}
        self.stage = Stage(IlcController, parameters, present=(0.0, 0.0), kept=kept)
        self.servos = servos or Servos()
        self.cycle = 0
        self.stage.activate()
        self.corrections: list[np.ndarray] = []
        self.commanded: list[np.ndarray] = []
        self.speeds: list[np.ndarray] = []

    @property
    def now_s(self) -> float:
        return self.cycle * PERIOD_S

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            commanded = self.stage.update(self.now_s, follow=False)
            self.corrections.append(self.stage.controller._correction.copy())
            self.commanded.append(commanded)
            self.speeds.append(self.stage.commands.velocity.copy())
            self.stage.states.position[:] = self.servos.move(commanded)
            self.cycle += 1

    def repeat(self, phase: float = 0.0, rest_s: float = 1.5, start_in: float = 0.5) -> float:
        """Play the motion once; return its error by the newest message, deg."""
        self.stage.send(self.now_s, "trajectory", points=points(phase), start_in=start_in)
        self.run(start_in + MOTION_S + rest_s)
        return math.degrees(self.stage.messages[-1][1].error) if self.stage.messages else math.nan


@pytest.mark.parametrize("interface", ["position", "posvel"])
def test_the_error_falls_tenfold_in_ten_repetitions(interface: str) -> None:
    learner = Learner(command_interface=interface)
    errors = [learner.repeat() for _ in range(11)]
    assert errors[0] > 3.0
    assert errors[10] < errors[0] / 10
    assert max(errors[5:]) < errors[0] / 8
    assert [message.repetition for _, message in learner.stage.messages] == list(range(11))
    assert learner.stage.said == [
        f"motion {learner.stage.messages[0][1].motion} is not learned yet: no correction"
    ]


def test_without_a_gain_nothing_is_learned() -> None:
    learner = Learner(gain=0.0)
    first, second = learner.repeat(), learner.repeat()
    assert second == pytest.approx(first, rel=0.01)
    assert not learner.stage.keeps
    assert not np.any(learner.corrections)


def test_the_delay_is_that_of_the_first_repetition() -> None:
    learner = Learner(Servos(delay=3, lag_s=0.001))
    learner.repeat()
    (motion,) = learner.stage.controller._known._known
    # a goal is sent at the end of its cycle and read at the begin of another: one more cycle than the servo's
    assert motion.delay_s == pytest.approx([4 * PERIOD_S] * 2, rel=0.1)
    given = Learner(Servos(delay=3), delay="30 ms")
    given.repeat()
    assert given.stage.controller._known._known[0].delay_s == pytest.approx([0.03, 0.03])


# Servos that are swapped

OTHERS = {
    "slower": Servos(delay=2, lag_s=0.12),
    "quicker": Servos(delay=0, lag_s=0.005),
    "later": Servos(delay=9),
    "leads": Servos(gain=1.15),
    "lazy": Servos(gain=0.6),
    "backward": Servos(gain=-1.0),
    "dead": Servos(gain=0.0),
}


@pytest.mark.parametrize("name", list(OTHERS))
def test_a_swapped_servo_never_lets_the_error_grow_without_bound(name: str) -> None:
    other = OTHERS[name]
    fresh = Learner(Servos(other.delay, other.lag_s, other.gain), gain=0.0).repeat()
    learner = Learner()
    for _ in range(6):
        learner.repeat()
    learner.servos = Servos(other.delay, other.lag_s, other.gain, learner.servos.position)
    errors = [learner.repeat() for _ in range(14)]
    assert np.abs(learner.corrections).max() <= MOST + 1e-9
    # what was learned on the other servo makes it worse by that correction at most, and only twice
    assert max(errors) < fresh + math.degrees(MOST)
    assert max(errors[3:]) < 1.3 * fresh
    assert min(errors[-3:]) < 1.1 * fresh
    if name in ("slower", "quicker", "later"):
        assert max(errors[-3:]) < fresh / 2
    assert any("is dropped" in text for text in learner.stage.said) == (errors[0] > 0 and _twice(errors))


def _twice(errors: list[float]) -> bool:
    """Return whether two errors in a row were more than twice the smallest one, which was 0.3 before."""
    return any(min(pair) > 2 * 0.3 for pair in itertools.pairwise(errors))


def test_one_bad_repetition_is_left_out_and_a_second_one_drops_what_was_learned() -> None:
    learner = Learner()
    for _ in range(6):
        learner.repeat()
    before = learner.stage.keeps[-1]
    count = len(learner.stage.keeps)
    learner.servos.gain = 0.5
    learner.repeat()
    learner.servos.gain = 1.0
    assert "nothing is learned" in learner.stage.said[-1]
    assert learner.stage.keeps[-1] == before
    assert learner.repeat() < 0.5, "the correction is still there"
    learner.servos.gain = 0.5
    learner.repeat()
    learner.repeat()
    assert "is dropped: again its error" in learner.stage.said[-1]
    assert learner.stage.controller._known._known == []
    assert len(learner.stage.keeps) == count + 2


# What nothing is learned from


def lost_cycle(learner: Learner) -> None:
    learner.run(2.0)
    learner.cycle += 1
    learner.run(4.0)


def lost_reply(learner: Learner) -> None:
    valid = learner.stage.states.valid
    learner.run(2.0)
    valid[1] = False
    learner.run(PERIOD_S)
    valid[1] = True
    learner.run(4.0)


def clamped(learner: Learner) -> None:
    learner.run(2.0)
    learner.stage.sent.position[0] += 0.001
    learner.run(4.0)


def cancelled(learner: Learner) -> None:
    learner.run(2.0)
    learner.stage.cancel(learner.now_s)
    learner.run(4.0)


def preempted(learner: Learner) -> None:
    learner.run(2.0)
    learner.repeat(phase=1.0)


def slower(learner: Learner) -> None:
    learner.run(2.0)
    learner.stage.change(learner.now_s, speed=0.5)
    learner.run(8.0)


def deactivated(learner: Learner) -> None:
    learner.run(2.0)
    learner.stage.controller.on_deactivate(round(learner.now_s * 1e9))
    learner.stage.controller.on_activate(round(learner.now_s * 1e9))
    learner.run(4.0)


@pytest.mark.parametrize(
    ("happens", "why"),
    [
        (lost_cycle, "cycles were skipped"),
        (lost_reply, "a servo did not answer"),
        (clamped, "its goals were clamped"),
        (cancelled, "it was not played to its end"),
        (preempted, "it was not played to its end"),
        (slower, "it is played at another speed"),
        (deactivated, "it was not played to its end"),
    ],
)
def test_a_repetition_that_was_disturbed_is_left_out(happens: Callable[[Learner], None], why: str) -> None:
    learner = Learner()
    first = learner.repeat()
    learner.repeat()
    name, table = learner.stage.messages[0][1].motion, learner.stage.keeps[-1]
    learner.stage.send(learner.now_s, "trajectory", points=points(), start_in=0.5)
    happens(learner)
    assert [text for text in learner.stage.said if "nothing is learned" in text] == [
        f"nothing is learned from this repetition of motion {name}: {why}"
    ]
    if happens is not preempted:
        assert learner.stage.keeps[-1] == table
    learner.stage.change(learner.now_s, speed=1.0)
    learner.run(1.0)
    assert learner.repeat() < first / 2, "and the next one is played and learned from as before"


def test_a_motion_that_is_too_long_is_played_and_not_learned() -> None:
    learner = Learner(longest="3 s")
    learner.repeat()
    assert learner.stage.goal.ended[0][0] is Outcome.REACHED
    assert "it is longer than `longest`" in learner.stage.said[-1]
    assert not learner.stage.messages


def test_a_motion_that_begins_while_the_one_before_is_learned() -> None:
    learner = Learner()
    learner.stage.controller._steps = 1  # of 34: they take longer than the way to the first point
    learner.stage.controller._repetition._step = 16
    errors = [learner.repeat(rest_s=0.1, start_in=0.1) for _ in range(8)]
    assert errors[-1] < errors[1] / 5, "the first is reported with the second"
    assert any("the previous repetition is still being learned" in text for text in learner.stage.said)


# Motions


def test_joints_that_a_motion_does_not_move_get_no_correction() -> None:
    learner = Learner(Servos(gain=0.8, position=np.array([0.0, 0.3])))
    for _ in range(3):
        one = [{**point, "positions": point["positions"][:1]} for point in points()]  # type: ignore[index]
        learner.stage.send(learner.now_s, "trajectory", points=one, joints=["a"], start_in=0.5)
        learner.run(6.0)
    largest = np.abs(learner.corrections).max(axis=0)
    assert largest[0] > math.radians(3)
    assert largest[1] == 0.0


def test_a_motion_without_an_error() -> None:
    still = [{"time": t, "positions": [0.0, 0.0]} for t in (0.0, 1.0)]

    def repeat(learner: Learner) -> None:
        learner.stage.send(learner.now_s, "trajectory", points=still, start_in=0.1)
        learner.run(2.0)

    learner = Learner()
    repeat(learner)
    assert learner.stage.messages[-1][1].error == 0.0
    again = Learner(kept=learner.stage.keeps[-1])
    again.servos.position[:] = 0.5  # the arm is pushed
    repeat(again)
    repeat(again)
    assert "nothing is learned" in again.stage.said[0]


def test_each_motion_has_its_own_correction_and_the_oldest_is_forgotten() -> None:
    learner = Learner(motions=2)
    for phase in (0.0, 1.0):
        for _ in range(4):
            learner.repeat(phase)
    assert learner.repeat(0.0) < 0.6
    assert learner.repeat(1.0) < 0.6
    assert learner.repeat(2.0) > 2.0, "a changed motion begins anew"
    assert " is dropped for motion " in learner.stage.said[-1]
    assert learner.repeat(1.0) < 0.6
    assert learner.repeat(0.0) > 2.0, "it was forgotten"


def test_a_motion_is_the_same_whenever_it_begins() -> None:
    made = Stage(IlcController, {"joints": ["a", "b"]})

    def key(**command: object) -> tuple[float, ...]:
        return tuple(made.prepare("trajectory", **command)[-2:].tolist())

    assert key(points=points(), start_in=2.0, timeout=9.0) == key(points=points())
    others = {key(points=points(0.001)), key(points=points()[:-1]), key(points=points(), joints=["b", "a"])}
    assert len({*others, key(points=points())}) == 4
    posvel = Stage(IlcController, {"joints": ["a", "b"], "command_interface": "posvel"})
    assert tuple(posvel.prepare("trajectory", points=points())[-2:].tolist()) != key(points=points())


@pytest.mark.parametrize("end", ["cancel", "next", "same"])
def test_no_correction_jumps(end: str) -> None:
    learner = Learner()
    for _ in range(5):
        learner.repeat()
    learner.corrections.clear()
    learner.stage.send(learner.now_s, "trajectory", points=points(), start_in=0.5)
    learner.run(1.7)
    if end == "cancel":
        learner.stage.cancel(learner.now_s)
        learner.run(1.0)
    learner.stage.send(learner.now_s, "trajectory", points=points(1.0 if end == "next" else 0.0))
    learner.run(6.0)
    steps = np.abs(np.diff(learner.corrections, axis=0))
    assert np.abs(learner.corrections).max() > math.radians(3)
    assert steps.max() < math.radians(2.0), "of 0.2 s, in which it fades, the steepest cycle has 15 %"


@pytest.mark.parametrize("into", [(), ("below",)])
def test_the_speed_is_that_of_the_corrected_position(into: tuple[str, ...]) -> None:
    learner = Learner(command_interface="posvel")
    learner.stage = Stage(
        IlcController,
        {"joints": ["a", "b"], "command_interface": "posvel"},
        present=(0.0, 0.0),
        into=into,
    ).activate()
    for _ in range(4):
        learner.repeat()
    begin = len(learner.commanded)
    learner.repeat()
    rows = slice(begin + 50, begin + 200)  # in the motion
    gone = np.diff(learner.commanded, axis=0, prepend=[[0.0, 0.0]])[rows] / PERIOD_S
    off = np.abs(np.array(learner.speeds)[rows] - (gone if into else np.abs(gone)))
    grew = np.abs(np.diff(learner.corrections, axis=0)[rows]) / PERIOD_S
    # a linear piece ends every 5 rows: there the speed is already that of the next one
    assert np.median(off, axis=0) == pytest.approx([0.0, 0.0], abs=0.01)
    assert (np.median(grew, axis=0) > 0.05).all()


def test_a_correction_does_not_lead_over_a_limit() -> None:
    parameters = {"joints": ["a", "b"]}
    learner = Learner()
    learner.stage = Stage(
        IlcController, parameters, present=(0.0, 0.0), limits={"lower": -0.6, "upper": 0.6}
    ).activate()
    for _ in range(4):
        learner.repeat()
    assert np.abs(learner.commanded).max() == 0.6
    assert np.abs(learner.corrections).max() > math.radians(3)
    assert not any("clamped" in text for text in learner.stage.said)


# From run to run


def test_the_next_run_goes_on_with_what_was_kept() -> None:
    learner = Learner()
    for _ in range(4):
        learner.repeat()
    again = Learner(kept=learner.stage.keeps[-1])
    errors = [again.repeat() for _ in range(2)]
    assert errors[0] == pytest.approx(learner.repeat(), abs=0.05)
    assert again.stage.said == []
    assert again.stage.messages[0][1].repetition == 4


@pytest.mark.parametrize("seed", range(8))
def test_damaged_bytes_are_left_out_and_never_raise(seed: int) -> None:
    learner = Learner(motions=1, longest="4.2 s")
    learner.repeat()
    chance, data = random.Random(seed), bytearray(learner.stage.keeps[-1])
    for _ in range(chance.randint(1, 4)):
        at = chance.choice([chance.randrange(60), chance.randrange(len(data))])
        data[at] = chance.randrange(256)
    data = data[: chance.choice([len(data), chance.randrange(len(data))])]
    again = Learner(motions=1, longest="4.2 s", kept=bytes(data))
    again.repeat()
    assert np.isfinite(again.corrections).all()
    assert np.abs(again.corrections).max() <= MOST + 1e-6


def test_another_period_begins_anew_and_says_so() -> None:
    learner = Learner()
    learner.repeat()
    data = learner.stage.keeps[-1]
    other = data[:4] + (10_000_000).to_bytes(8, "little") + data[12:]
    again = Learner(kept=other)
    assert again.stage.said == [
        "the stored corrections cannot be used: they have a period of 10000000 ns instead of 20000000 ns"
    ]
    assert again.stage.controller._known._known == []


def test_more_than_can_be_kept_is_refused() -> None:
    with pytest.raises(ValueError, match="lower `motions` or `longest`"):
        Stage(IlcController, {"joints": ["a", "b"], "longest": "3000 s"})


# The law


def test_the_low_pass_has_no_phase_and_half_the_power_at_its_cut_off() -> None:
    for cutoff, period in ((5.0, 1 / 320), (2.0, 0.001), (8.0, 0.02)):
        weights = gaussian(cutoff, period)
        turns = np.exp(-2j * np.pi * cutoff * period * (np.arange(len(weights)) - len(weights) // 2))
        passed = np.sum(weights * turns)
        assert abs(passed) == pytest.approx(math.sqrt(0.5), rel=0.01)
        assert passed.imag == pytest.approx(0.0, abs=1e-12)
        assert weights.sum() == pytest.approx(1.0)
        assert (weights > 0).all()


@pytest.mark.parametrize("rows", [3, 40, 300, 1000])
def test_the_steps_give_what_the_formula_gives_at_once(rows: int) -> None:
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
