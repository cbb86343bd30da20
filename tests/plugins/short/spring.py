from dxlrun import Floats, JointController


class Spring(JointController):
    """Pulls its joints back to where they were, as a spring with a damper."""

    stiffness: float = 1.5
    damping: float = 0.05

    def efforts(self, time: float, dt: float) -> Floats:
        return self.stiffness * (self.start - self.position) - self.damping * self.velocity
