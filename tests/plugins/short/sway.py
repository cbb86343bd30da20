from dxlrun import Floats, JointController, Time, reading


class Sway(JointController):
    """Leans against the turning that a gyroscope measures, and comes back slowly."""

    gyroscope: float = reading("imu/angular_velocity.y")
    gain: float = 5.0
    back: Time = 0.5

    def begin(self) -> None:
        self.lean = 0.0

    def positions(self, time: float, dt: float) -> Floats:
        self.lean -= (self.gain * self.gyroscope + self.lean / self.back) * dt
        return self.start + self.lean
