"""Dialogues of `dxlrun setup`, `calibrate` and `teach` on simulated servos, and drawings of the hands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from drawn import BLUE, GREEN, GREY, RED
from terminal import lines_of

ROBOT = """\
name: arm
arguments: {port: {default: sim, help: port}}
buses:
  main: {port: "${port}", protocol: 2.0, baud_rate: 1_000_000, adapter: {kind: ftdi}, return_delay_time: 0 us}
loop: {rate: 50}
joints:
  elbow: {bus: main, id: 3, model: XL430-W250, reference: 180 deg, direction: 1}
controllers:
  arm: {type: joint_trajectory_controller, joints: [elbow]}
"""
PORT = "/dev/ttyUSB0"
"""Port that the pictures show in place of the simulated one."""
Frame = tuple[str, list[str]]
"""A command, and the lines that it leaves on the terminal."""


def setup(place: Path) -> Frame:
    """Give a new servo its ID and rate."""
    from tests.kit.hands import Screen

    words = ("setup", "arm.yaml", f"port:={place / 'line'}")
    with Screen(place, *words) as screen:
        for question in ("(s: skip it)", "Connect all servos"):
            screen.sees(question)
            screen.types("\n")
        screen.ended()
        return _frame(place, words, screen.shown)


def calibrate(place: Path) -> Frame:
    """Measure a joint that a hand moves to its zero pose and its ends."""
    from tests.kit.hands import LiveRobot, Screen

    words = ("calibrate", "arm.yaml", f"port:={place / 'line'}")
    turns = {"hold the joints": 0, "zero pose": -20, "positive": -30, "negative": 70}
    with LiveRobot(place, place / "arm.yaml", runs=False) as servos, Screen(place, *words) as screen:
        for question, turn in turns.items():
            screen.sees(question)
            servos.turn(lambda: None, 0.3, id3=turn)
            screen.types("\n")
        screen.sees("Write this into")
        screen.types("y\n")
        screen.ended()
        return _frame(place, words, screen.shown)


def teach(place: Path) -> Frame:
    """Show two poses to a running robot, and let it play them."""
    from tests.kit.hands import LiveRobot, Screen

    words = ("teach", "wave.yaml")
    answers = (("Hold them", "", 0), ("0 taught", "", 30), ("1 taught", "", 40), ("2 taught", "s", 0))
    with LiveRobot(place, place / "arm.yaml") as servos, Screen(place, *words) as screen:
        for question, answer, turn in (*answers, ("be switched on", "", 0), ("Play the", "y", 0)):
            screen.sees(question)
            servos.turn(lambda: None, 0.3, id3=turn)
            screen.types(f"{answer}\n")
        screen.ended()
        return _frame(place, words, screen.shown)


def _frame(place: Path, words: Sequence[str], shown: str) -> Frame:
    link = str(place / "line")
    lines = [line.replace(link, PORT).replace(f"{place}/", "") for line in lines_of(shown)]
    return f"dxlrun {' '.join(words)}".replace(link, PORT), lines


# Drawings: three panels each

PANEL, HEIGHT, LINK = 310, 214, 62


def draw_setup() -> str:
    """Draw how new servos are connected: one alone, the next one alone, then all."""
    first = [*_box(20, "adapter", "USB"), *_wire(106, 136), *_box(136, "servo", "ID 1 -> 1"), *_power(179)]
    second = [*_box(20, "adapter", "USB"), *_wire(106, 136), *_box(136, "servo", "ID 1 -> 2"), *_power(179)]
    chain = [*_box(8, "adapter", "USB"), *_wire(94, 110), *_box(110, "servo", "ID 1")]
    chain += [*_wire(196, 212), *_box(212, "servo", "ID 2"), *_power(153)]
    return _panels(
        (first, "1. the first servo alone, Enter"),
        (second, "2. the next one alone, Enter"),
        (chain, "3. all connected, Enter: compared"),
    )


def draw_calibrate() -> str:
    """Draw where hands move a joint: the zero pose, its positive end, its negative end."""
    ends = ((0, "1. zero pose, Enter"), (70, "2. positive end, Enter"), (-50, "3. negative end, Enter"))
    panels = []
    for angle, caption in ends:
        way = [] if not angle else [*_arm(0, ghost=True), *_arc(0, angle, RED if angle > 0 else BLUE)]
        panels.append(([*way, *_arm(angle), *_hand(angle)], caption))
    return _panels(*panels)


def draw_teach() -> str:
    """Draw how a motion is shown: a pose, the next pose, and the robot that plays both."""
    first, second = 40, -35
    return _panels(
        ([*_arm(first), *_hand(first)], "1. limp: move it to a pose, Enter"),
        ([*_arm(first, ghost=True), *_arm(second), *_hand(second)], "2. to the next pose, Enter; then s"),
        (
            [*_arm(first, ghost=True), *_arm(second, ghost=True), *_arc(first, second, GREEN), *_arm(0)],
            "3. hands off: it plays the way",
        ),
    )


def _panels(*panels: tuple[Sequence[str], str]) -> str:
    width = PANEL * len(panels)
    parts = [
        f'<svg viewBox="0 0 {width} {HEIGHT}" xmlns="http://www.w3.org/2000/svg"',
        ' font-family="DejaVu Sans, sans-serif" text-anchor="middle">',
        '<defs><marker id="to" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7"',
        ' orient="auto"><path d="M0 0L8 4L0 8z" fill="context-stroke"/></marker></defs>',
        f'<rect width="{width}" height="{HEIGHT}" fill="white"/>',
    ]
    for number, (shapes, caption) in enumerate(panels):
        parts += [
            f'<g transform="translate({number * PANEL} 0)">',
            *shapes,
            f'<text x="{PANEL / 2}" y="{HEIGHT - 12}" font-size="14">{caption}</text></g>',
        ]
    return "\n".join([*parts, "</svg>"]) + "\n"


def _point(angle: float, length: float) -> tuple[float, float]:
    """Return a point of the forearm, whose angle is measured from upright, clockwise, deg."""
    along = math.radians(angle)
    return round(PANEL / 2 + length * math.sin(along), 1), round(104 - length * math.cos(along), 1)


def _arm(angle: float, *, ghost: bool = False) -> list[str]:
    (x, y), colour = _point(angle, LINK + 14), "#cbd2d9" if ghost else GREY
    dash = ' stroke-dasharray="6 6"' * ghost
    cap = "butt" if ghost else "round"
    line = f'<path d="M{PANEL / 2} 104L{x} {y}" stroke="{colour}" stroke-width="11"'
    forearm = f'{line}{dash} stroke-linecap="{cap}"/>'
    if ghost:
        return [forearm]
    return [
        f'<path d="M{PANEL / 2} 172V104" stroke="{GREY}" stroke-width="13"/>',
        f'<path d="M{PANEL / 2 - 45} 174H{PANEL / 2 + 45}" stroke="{GREY}" stroke-width="6"/>',
        forearm,
        f'<circle cx="{PANEL / 2}" cy="104" r="13" fill="#e3eefa" stroke="{GREY}" stroke-width="2"/>',
    ]


def _hand(angle: float) -> list[str]:
    """Draw a hand that holds the end of the forearm: a palm with four fingers."""
    (x, y), turned = _point(angle, LINK + 10), angle
    fingers = "".join(
        f'<rect x="-17" y="{at}" width="34" height="8" rx="4" fill="#f2c9a1" stroke="#8a5a2b"/>'
        for at in (-17, -8, 1, 10)
    )
    palm = '<rect x="9" y="-19" width="34" height="38" rx="11" fill="#f2c9a1" stroke="#8a5a2b"/>'
    return [f'<g transform="translate({x} {y}) rotate({turned})">{palm}{fingers}</g>']


def _arc(begin: float, end: float, colour: str) -> list[str]:
    (x0, y0), (x1, y1) = _point(begin, LINK - 18), _point(end, LINK - 18)
    sweep, radius = int(end > begin), LINK - 18
    line = f'<path d="M{x0} {y0}A{radius} {radius} 0 0 {sweep} {x1} {y1}" stroke="{colour}" fill="none"'
    return [f'{line} stroke-width="2.5" marker-end="url(#to)"/>']


def _box(left: float, name: str, about: str) -> list[str]:
    middle = left + 43
    return [
        f'<rect x="{left}" y="96" width="86" height="56" rx="7" fill="#e3eefa" stroke="{GREY}"/>',
        f'<text x="{middle}" y="121" font-size="15" font-weight="bold">{name}</text>',
        f'<text x="{middle}" y="140" font-size="12">{about}</text>',
    ]


def _wire(begin: float, end: float) -> list[str]:
    return [f'<path d="M{begin} 124H{end}" stroke="{GREY}" stroke-width="4"/>']


def _power(x: float) -> list[str]:
    return [
        f'<text x="{x}" y="52" font-size="13" fill="{RED}">power, with a switch</text>',
        f'<path d="M{x} 60V94" stroke="{RED}" stroke-width="3"/>',
    ]
