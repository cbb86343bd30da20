"""fall_reflex: when it lets others take over, when it counts again, and what silence of the IMU does."""

from __future__ import annotations

import math

import pytest
from tests.kit.stages import standing

from dxlrun_controllers.sensing.fall_reflex import FallReflex

NAN = math.nan


class Bench:
    def __init__(self, **written: object) -> None:
        keys = {
            "imu": "imu",
            "activate": ["curl"],
            "roll": ["-40 deg", "40 deg"],
            "pitch": ["-30 deg", "50 deg"],
        }
        self.stage = standing(FallReflex, {**keys, **written}).activate()

    def tip(self, roll: float, pitch: float = 0.0, cycles: int = 1, age_s: float = 0.0) -> Bench:
        """Update with a posture, degrees: pitched, then rolled about its own x axis."""
        a, b = math.radians(roll) / 2, math.radians(pitch) / 2
        q = (
            math.sin(a) * math.cos(b),
            math.cos(a) * math.sin(b),
            -math.sin(a) * math.sin(b),
            math.cos(a) * math.cos(b),
        )
        return self.see(q, cycles, age_s)

    def see(self, q: tuple[float, ...], cycles: int = 1, age_s: float = 0.0) -> Bench:
        for _ in range(cycles):
            self.stage.context.reads[:] = [*q, age_s]
            self.stage.step()
        return self

    @property
    def count(self) -> int:
        return len(self.stage.takeovers)


@pytest.mark.parametrize("roll", [41.0, -41.0, 100.0, 179.0, -170.0])
def test_a_posture_beyond_the_roll_counts_after_its_time(roll: float) -> None:
    bench = Bench().tip(0.0, cycles=20).tip(roll, cycles=3)  # 60 ms are over with the fourth
    assert not bench.count
    bench.tip(roll)
    assert bench.stage.takeovers == [(("curl",), f"falls with roll {roll:.0f} deg, pitch 0 deg")]
    assert bench.stage.context.provided[0] == 1.0


def test_an_angle_that_rounds_to_zero_has_no_sign() -> None:
    bench = Bench().tip(-0.2, 51.0, cycles=20)
    assert bench.stage.takeovers == [(("curl",), "falls with roll 0 deg, pitch 51 deg")]


@pytest.mark.parametrize(
    ("pitch", "falls"), [(49.0, 0), (51.0, 1), (-29.0, 0), (-31.0, 1), (89.9, 1), (-90.0, 1)]
)
def test_pitch_has_bounds_of_its_own(pitch: float, falls: int) -> None:
    assert Bench().tip(0.0, pitch, cycles=10).count == falls


def turned(heading: float, pitch: float, roll: float) -> tuple[float, ...]:
    """Return x, y, z, w of a body turned to a heading, pitched, and rolled, degrees: Z, then Y, then X."""
    a, b, c = (math.radians(angle) / 2 for angle in (roll, pitch, heading))
    return (
        math.sin(a) * math.cos(b) * math.cos(c) - math.cos(a) * math.sin(b) * math.sin(c),
        math.cos(a) * math.sin(b) * math.cos(c) + math.sin(a) * math.cos(b) * math.sin(c),
        math.cos(a) * math.cos(b) * math.sin(c) - math.sin(a) * math.sin(b) * math.cos(c),
        math.cos(a) * math.cos(b) * math.cos(c) + math.sin(a) * math.sin(b) * math.sin(c),
    )


@pytest.mark.parametrize("heading", [0.0, 80.0, -170.0])
def test_the_heading_does_not_count(heading: float) -> None:
    for pitch, roll, falls in (
        (49.0, 39.0, 0),
        (-29.0, 39.0, 0),
        (51.0, 39.0, 1),
        (49.0, -41.0, 1),
        (-31.0, 0.0, 1),
    ):
        assert Bench().see(turned(heading, pitch, roll), 10).count == falls


def test_with_no_time_it_acts_in_the_same_cycle() -> None:
    assert Bench(time="0 s").tip(41.0).count == 1


def test_a_posture_that_comes_back_in_time_is_no_fall() -> None:
    bench = Bench()
    for _ in range(10):
        bench.tip(45.0, cycles=3).tip(10.0)
    assert not bench.count
    assert bench.stage.context.provided[0] == 0.0


def test_it_counts_once_a_fall_and_again_after_a_time_upright() -> None:
    bench = Bench().tip(90.0, cycles=300)
    assert bench.count == 1
    bench.tip(0.0, cycles=40).tip(90.0, cycles=10)  # 0.8 s are not enough
    assert bench.count == 1
    bench.tip(0.0, cycles=52)
    assert bench.stage.said == ["upright again (roll 0 deg, pitch 0 deg): the next fall counts"]
    assert bench.stage.context.provided[0] == 0.0
    assert bench.tip(90.0, cycles=4).count == 2


def test_an_old_orientation_does_not_trigger_it() -> None:
    bench = Bench().tip(0.0, cycles=5).tip(90.0, cycles=2).tip(90.0, cycles=50, age_s=0.21)
    assert not bench.count
    assert bench.stage.said == ["no orientation from imu for 0.2 s: falls are not detected"]
    assert bench.tip(90.0, cycles=3).count == 0  # counted anew
    assert bench.tip(90.0).count == 1


@pytest.mark.parametrize("q", [(NAN, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, math.inf)])
def test_silence_may_let_them_take_over_too(q: tuple[float, ...]) -> None:
    bench = Bench(on_silence="activate").see(q, cycles=9)
    assert not bench.count
    bench.see(q, cycles=50)
    assert bench.stage.takeovers == [(("curl",), "no orientation from imu for 0.2 s")]


def test_zeros_are_no_orientation_and_the_length_of_a_quaternion_does_not_matter() -> None:
    bench = Bench().tip(0.0, cycles=5).see((0.0, 0.0, 0.0, 0.0), cycles=30)
    assert not bench.count
    assert bench.stage.said == ["no orientation from imu for 0.2 s: falls are not detected"]
    for scale in (0.01, 100.0):
        fallen = Bench().see(tuple(scale * one for one in turned(30.0, 0.0, 41.0)), cycles=10)
        assert fallen.stage.takeovers == [(("curl",), "falls with roll 41 deg, pitch 0 deg")]
        tipped = Bench().see(tuple(scale * one for one in turned(30.0, 49.0, 39.0)), cycles=10)
        assert not tipped.count
