"""fall_reflex: when it lets others take over, when it counts again, and what silence of the IMU does."""

from __future__ import annotations

import math

import pytest
from tests.kit.stages import standing

from dxlrun_controllers.sensing.fall_reflex import FallReflex

NAN = math.nan
KEYS: dict[str, object] = {
    "imu": "imu",
    "activate": ["curl"],
    "roll": ["-40 deg", "40 deg"],
    "pitch": ["-30 deg", "50 deg"],
}
SILENCE = "no orientation from imu for 0.2 s"


def turned(heading: float, pitch: float, roll: float) -> tuple[float, ...]:
    """Return x, y, z, w of a body turned to a heading, pitched, and rolled, degrees: Z, then Y, then X."""
    a, b, c = (math.radians(angle) / 2 for angle in (roll, pitch, heading))
    return (
        math.sin(a) * math.cos(b) * math.cos(c) - math.cos(a) * math.sin(b) * math.sin(c),
        math.cos(a) * math.sin(b) * math.cos(c) + math.sin(a) * math.cos(b) * math.sin(c),
        math.cos(a) * math.cos(b) * math.sin(c) - math.sin(a) * math.sin(b) * math.cos(c),
        math.cos(a) * math.cos(b) * math.cos(c) + math.sin(a) * math.sin(b) * math.sin(c),
    )


class Bench:
    def __init__(self, **written: object) -> None:
        self.stage = standing(FallReflex, {**KEYS, **written}).activate()
        self.takeovers, self.said = self.stage.takeovers, self.stage.said

    def tip(self, roll: float, pitch: float = 0.0, cycles: int = 1, age_s: float = 0.0) -> Bench:
        """Update with a posture, degrees."""
        return self.see(turned(0.0, pitch, roll), cycles, age_s)

    def see(self, q: tuple[float, ...], cycles: int = 1, age_s: float = 0.0) -> Bench:
        for _ in range(cycles):
            self.stage.context.reads[:] = [*q, age_s]
            self.stage.step()
        return self


@pytest.mark.parametrize("roll", [41.0, -41.0, 100.0, 179.0, -170.0])
def test_a_posture_beyond_the_roll_counts_after_its_time(roll: float) -> None:
    bench = Bench().tip(0.0, cycles=20).tip(roll, cycles=3)  # 60 ms are over with the fourth
    assert not bench.takeovers
    bench.tip(roll)
    assert bench.takeovers == [(("curl",), f"falls with roll {roll:.0f} deg, pitch 0 deg")]
    assert bench.stage.context.provided[0] == 1.0


@pytest.mark.parametrize("heading", [0.0, 80.0, -170.0])
@pytest.mark.parametrize(
    ("roll", "pitch", "falls"),
    [
        *((0, 49, 0), (0, 51, 1), (0, -29, 0), (0, -31, 1), (0, 89.9, 1), (0, -90, 1)),
        *((39, 49, 0), (39, -29, 0), (39, 51, 1), (-41, 49, 1)),
    ],
)
def test_roll_and_pitch_have_their_bounds_and_the_heading_none(
    heading: float, roll: float, pitch: float, falls: int
) -> None:
    for scale in (0.01, 1.0, 100.0):  # the length of a quaternion has no meaning
        q = tuple(scale * each for each in turned(heading, pitch, roll))
        assert len(Bench().see(q, cycles=10).takeovers) == falls


def test_an_angle_that_rounds_to_zero_has_no_sign_and_without_a_time_it_acts_at_once() -> None:
    bench = Bench(time="0 s").tip(-0.2, 51.0)
    assert bench.takeovers == [(("curl",), "falls with roll 0 deg, pitch 51 deg")]


def test_a_posture_that_returns_in_time_is_not_a_fall() -> None:
    bench = Bench()
    for _ in range(10):
        bench.tip(45.0, cycles=3).tip(10.0)
    assert not bench.takeovers
    assert bench.stage.context.provided[0] == 0.0


def test_it_counts_once_a_fall_and_again_after_a_time_upright() -> None:
    bench = Bench().tip(90.0, cycles=300)
    assert len(bench.takeovers) == 1
    bench.tip(0.0, cycles=40).tip(90.0, cycles=10)  # 0.8 s are not enough
    assert len(bench.takeovers) == 1
    bench.tip(0.0, cycles=52)
    assert bench.said == ["upright again (roll 0 deg, pitch 0 deg): the next fall counts"]
    assert bench.stage.context.provided[0] == 0.0
    assert len(bench.tip(90.0, cycles=4).takeovers) == 2


def test_an_old_orientation_does_not_trigger_it() -> None:
    bench = Bench().tip(0.0, cycles=5).tip(90.0, cycles=2).tip(90.0, cycles=50, age_s=0.21)
    assert not bench.takeovers
    assert bench.said == [f"{SILENCE}: falls are not detected"]
    assert not bench.tip(90.0, cycles=3).takeovers  # counted from the start
    assert len(bench.tip(90.0).takeovers) == 1


@pytest.mark.parametrize("q", [(NAN, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, math.inf), (0.0,) * 4])
def test_silence_may_let_them_take_over_too(q: tuple[float, ...]) -> None:
    bench = Bench(on_silence="activate").see(q, cycles=9)
    assert not bench.takeovers
    assert bench.see(q, cycles=50).takeovers == [(("curl",), SILENCE)]
