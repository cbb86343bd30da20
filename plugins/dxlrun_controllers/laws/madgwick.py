"""Orientation of a body from its gyroscope, its accelerometer, and optionally its magnetometer.

S. Madgwick, An efficient orientation filter for inertial and inertial/magnetic sensor arrays (report x-io and
University of Bristol, 2010). Equation numbers refer to this report.
"""

from __future__ import annotations

import math

Vector = tuple[float, float, float]


class Madgwick:
    """Madgwick's filter; its quaternion (w, x, y, z) rotates vectors of the body into a frame whose z axis
    points up.

    `gain` is beta of the report, rad/s: the rate at which accelerometer and magnetometer correct the drift of
    the
    integrated rates. The accelerometer measures +g upwards at rest. With a magnetometer, the x axis of the
    fixed
    frame is the horizontal direction of the magnetic field (eq. 45 and 46; they need no declination or
    inclination). Angles converge to within about gain * dt.
    """

    def __init__(self, gain: float) -> None:
        self.gain = gain
        self.w, self.x, self.y, self.z = 1.0, 0.0, 0.0, 0.0

    @property
    def heading(self) -> float:
        """Angle of the body about the vertical axis, rad."""
        return math.atan2(
            2.0 * (self.w * self.z + self.x * self.y), 1.0 - 2.0 * (self.y * self.y + self.z * self.z)
        )

    def initialize_orientation(self, acceleration: Vector, field: Vector | None, heading: float) -> None:
        """Set roll and pitch from the accelerometer, and the heading from the magnetic field.

        Without a field, the heading is `heading`, rad. An acceleration of zero leaves the orientation
        unchanged.
        """
        ax, ay, az = acceleration
        if ax == ay == az == 0.0:
            return
        roll, pitch = math.atan2(ay, az), math.atan2(-ax, math.hypot(ay, az))
        if field is not None:
            mx, my, mz = field
            down = my * math.sin(roll) + mz * math.cos(roll)
            heading = -math.atan2(
                my * math.cos(roll) - mz * math.sin(roll), mx * math.cos(pitch) + down * math.sin(pitch)
            )
        cr, sr = math.cos(roll / 2), math.sin(roll / 2)
        cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
        cy, sy = math.cos(heading / 2), math.sin(heading / 2)
        self.w, self.x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
        self.y, self.z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy

    def update(self, rate: Vector, acceleration: Vector, field: Vector | None, dt: float) -> None:
        """Advance the orientation by `dt` s.

        Args:
            rate: Angular velocity in the axes of the body, rad/s.
            acceleration: Direction of the measured acceleration, in any unit. With zero, only the rates
                count.
            field: Direction of the magnetic field, in any unit; None without a magnetometer.
            dt: s.
        """
        w, x, y, z = self.w, self.x, self.y, self.z
        gx, gy, gz = rate
        # eq. 12
        dw = 0.5 * (-x * gx - y * gy - z * gz)
        dx = 0.5 * (w * gx + y * gz - z * gy)
        dy = 0.5 * (w * gy - x * gz + z * gx)
        dz = 0.5 * (w * gz + x * gy - y * gx)
        length = math.hypot(*acceleration)
        if length > 0.0:
            ex, ey, ez = acceleration
            # eq. 25: the vertical as the quaternion has it, minus the measured one
            fx = 2.0 * (x * z - w * y) - ex / length
            fy = 2.0 * (w * x + y * z) - ey / length
            fz = 1.0 - 2.0 * (x * x + y * y) - ez / length
            # eq. 26 transposed, times eq. 25
            nw = -2.0 * y * fx + 2.0 * x * fy
            nx = 2.0 * z * fx + 2.0 * w * fy - 4.0 * x * fz
            ny = -2.0 * w * fx + 2.0 * z * fy - 4.0 * y * fz
            nz = 2.0 * x * fx + 2.0 * y * fy
            if field is not None and (strength := math.hypot(*field)) > 0.0:
                mw, mx, my, mz = self._magnetic(field[0] / strength, field[1] / strength, field[2] / strength)
                nw, nx, ny, nz = nw + mw, nx + mx, ny + my, nz + mz
            steepness = math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
            if steepness > 0.0:  # eq. 33 and 34
                step = self.gain / steepness
                dw, dx, dy, dz = dw - step * nw, dx - step * nx, dy - step * ny, dz - step * nz
        w, x, y, z = w + dw * dt, x + dx * dt, y + dy * dt, z + dz * dt  # eq. 13
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        self.w, self.x, self.y, self.z = w / norm, x / norm, y / norm, z / norm

    def _magnetic(self, mx: float, my: float, mz: float) -> tuple[float, float, float, float]:
        """Return the magnetometer's part of the gradient, for a field of length 1."""
        w, x, y, z = self.w, self.x, self.y, self.z
        # eq. 45 and 46: the field in the fixed frame, turned into the plane of x and z
        hx = mx * (1.0 - 2.0 * (y * y + z * z)) + 2.0 * my * (x * y - w * z) + 2.0 * mz * (x * z + w * y)
        hy = 2.0 * mx * (x * y + w * z) + my * (1.0 - 2.0 * (x * x + z * z)) + 2.0 * mz * (y * z - w * x)
        bx = math.hypot(hx, hy)
        bz = 2.0 * mx * (x * z - w * y) + 2.0 * my * (y * z + w * x) + mz * (1.0 - 2.0 * (x * x + y * y))
        # eq. 29
        fx = 2.0 * bx * (0.5 - y * y - z * z) + 2.0 * bz * (x * z - w * y) - mx
        fy = 2.0 * bx * (x * y - w * z) + 2.0 * bz * (w * x + y * z) - my
        fz = 2.0 * bx * (w * y + x * z) + 2.0 * bz * (0.5 - x * x - y * y) - mz
        # eq. 30 transposed, times eq. 29
        return (
            -2.0 * bz * y * fx + (-2.0 * bx * z + 2.0 * bz * x) * fy + 2.0 * bx * y * fz,
            2.0 * bz * z * fx + (2.0 * bx * y + 2.0 * bz * w) * fy + (2.0 * bx * z - 4.0 * bz * x) * fz,
            (-4.0 * bx * y - 2.0 * bz * w) * fx
            + (2.0 * bx * x + 2.0 * bz * z) * fy
            + (2.0 * bx * w - 4.0 * bz * y) * fz,
            (-4.0 * bx * z + 2.0 * bz * x) * fx + (-2.0 * bx * w + 2.0 * bz * y) * fy + 2.0 * bx * x * fz,
        )
