"""How soon the servos answer."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from dxlrun.analysis.bus import Servo
from dxlrun.analysis.figures.drawing import BLUE, MUTED, ORANGE, Drawing, Words, draw
from dxlrun.analysis.verdict import microseconds


def reply_drawing(servos: Sequence[Servo]) -> Drawing | None:
    """Return the figure of the reply times; None where no servo answered what it was asked."""
    shown = [servo for servo in servos if servo.asked > servo.lost]
    if not shown:
        return None
    slowest = max(shown, key=lambda servo: servo.reply_max_us)

    def fill(figure: Figure) -> None:
        axes = figure.subplots()
        rows = range(len(shown))
        median = [servo.reply_median_us / 1e3 for servo in shown]
        most = [servo.reply_max_us / 1e3 for servo in shown]
        axes.hlines(rows, median, most, color=MUTED, linewidth=1.0)
        axes.plot(median, rows, "o", color=BLUE, markersize=4.5, markeredgewidth=0, label="median")
        axes.plot(most, rows, "D", color=ORANGE, markersize=4, markeredgewidth=0, label="slowest")
        axes.set_yticks(rows, [f"{servo.joint or servo.bus} {servo.servo_id}" for servo in shown])
        axes.set_ylim(len(shown) - 0.5, -0.5)
        axes.set_xlim(0, max(most) * 1.06 or 1)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("reply time, ms")
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.2)

    told = f"The slowest reply, of servo {slowest.servo_id}, took {microseconds(slowest.reply_max_us)}."
    words = Words(
        "reply-times",
        "Reply time of each servo",
        f"Median and slowest reply time of each servo in ms. {told}",
        f"{told} From before the instruction is written to after the reply's last byte is read.",
    )
    return draw(words, 0.9 + 0.21 * len(shown), fill)
