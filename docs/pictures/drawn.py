"""Pictures that are drawn: what logs hold, and the processes of a run, as SVG."""

from __future__ import annotations

import io
from html import escape
from pathlib import Path
from typing import TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from dxlrun.testing import read_log

mpl.use("svg")
mpl.rcParams |= {
    "svg.hashsalt": "dxlrun",
    "svg.fonttype": "none",
    "font.family": "DejaVu Sans",
    "axes.grid": True,
}
mpl.rcParams |= {"grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False}
BLUE, RED, GREY, GREEN = "#1f6fb4", "#c0392b", "#5f6b76", "#2e8b57"


def fall(log: Path) -> str:
    """Draw how robots/fall_reflex.yaml is tipped over: its pitch, and the shoulder that curls up."""
    run = read_log(log)
    names = [f"{source}/{state}" for source, states in run.header.sources.items() for state in states]
    x, y, z, w = (run.cycles["source_state"][:, names.index(f"imu/orientation.{axis}")] for axis in "xyzw")
    begin = run.cycles["woken_ns"][0]
    time = (run.cycles["woken_ns"] - begin) * 1e-9
    (taken,) = (event for event in run.events if "takes over" in event.text)
    figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
    axes.plot(
        time, np.degrees(np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))), RED, label="pitch, by the IMU"
    )
    shoulder = run.joints.index("left_shoulder")
    axes.plot(time, np.degrees(run.cycles["position"][:, shoulder]), BLUE, label="left_shoulder")
    axes.axhline(40, color=RED, linewidth=1, linestyle="--", label="limit of the reflex")
    axes.axvline((taken.t_ns - begin) * 1e-9, color=GREY, linewidth=1)
    axes.annotate(taken.text.partition(":")[0], ((taken.t_ns - begin) * 1e-9 + 0.05, -22), color=GREY)
    axes.set(xlabel="s", ylabel="deg", xlim=(0, time[-1]))
    axes.legend(loc="lower right", frameon=False)
    return _svg(figure)


def cycle(log: Path) -> str:
    """Draw one cycle of the torso: what passes its bus, and the steps of the loop, from the log."""
    run = read_log(log)
    number = 100
    row, packets = run.cycles[number], run.packets
    mine = np.flatnonzero(packets.cycle == run.cycles["cycle"][number])
    begin = row["woken_ns"]
    figure, axes = plt.subplots(figsize=(8, 2.6), layout="constrained")
    for one in mine:
        sent = packets.kind[one] == 1
        first, last = ((at[one] - begin) * 1e-6 for at in (packets.first_ns, packets.last_ns))
        axes.barh(int(sent), max(last - first, 0.03), left=first, height=0.5, color=BLUE if sent else GREEN)
    ends = [(row[name] - begin) * 1e-6 for name in ("read_ns", "updated_ns", "written_ns")]
    axes.barh(2, ends[0], height=0.5, color=GREY)
    axes.annotate(f"read, {ends[0]:.1f} ms", (ends[0] / 2, 2), color="white", ha="center", va="center")
    axes.barh(2, ends[2] - ends[0], left=ends[0], height=0.5, color=RED)
    axes.annotate(
        "update, write, then idle until the next deadline", (ends[2] + 0.2, 2), va="center", color=RED
    )
    axes.set(
        xlim=(0, run.period_ns * 1e-6),
        xlabel="ms since the loop woke up",
        yticks=(0, 1, 2),
        yticklabels=("replies", "instructions", "loop"),
    )
    axes.grid(visible=False, axis="y")
    return _svg(figure)


def _svg(figure: Figure) -> str:
    written = io.StringIO()
    figure.savefig(written, format="svg", metadata={"Date": None, "Creator": None}, facecolor="white")
    plt.close(figure)
    text = written.getvalue()
    return text[text.index("<svg") :]


BOX_HEIGHT = 52
Box: TypeAlias = tuple[int, int, int, str, str]
"""Left, top, width, name and remark."""
Arrow: TypeAlias = tuple[str, str, str, str, str, bool]
"""From box and side, to box and side, what passes, whether it passes in both directions."""
OUTSIDE = {"clients", "servos", "servo"}
"""Boxes of what is not dxlrun's, with a dashed edge."""
IN_LOOP = {"loop", "read", "update", "gate", "write", "start", "exchange"}
"""Boxes of the loop's process."""
PROCESSES: tuple[dict[str, Box], tuple[Arrow, ...]] = (
    {
        "supervisor": (10, 20, 210, "supervisor", "compiles the file, starts the others"),
        "bus": (300, 20, 190, "simulated bus", "only for ports sim"),
        "sensors": (300, 200, 190, "sensors", "one process each"),
        "guardian": (10, 110, 210, "guardian", "holds the ports, watches the loop"),
        "loop": (300, 110, 190, "loop", "read, update, gate, write"),
        "recorder": (570, 200, 190, "recorder", "writes the log"),
        "gateway": (570, 110, 190, "gateway", "answers clients"),
        "clients": (830, 110, 150, "clients", "send, watch, view"),
        "servos": (570, 20, 190, "servos", "on serial lines"),
    },
    (
        ("loop", "top", "bus", "bottom", "bytes", True),
        ("loop", "top-right", "servos", "left", "bytes", True),
        ("guardian", "right", "loop", "left", "heartbeat", True),
        ("supervisor", "bottom", "guardian", "top", "starts", False),
        ("sensors", "top", "loop", "bottom", "slots", False),
        ("loop", "bottom-right", "recorder", "left", "rings", False),
        ("gateway", "left", "loop", "right", "mailbox", True),
        ("clients", "left", "gateway", "right", "HTTP", True),
    ),
)
MOTION: tuple[dict[str, Box], tuple[Arrow, ...]] = (
    {
        "send": (10, 20, 190, "dxlrun send", "words become fields"),
        "gateway": (270, 20, 190, "gateway", "SI units, limits of joints"),
        "read": (10, 120, 190, "read", "replies become states"),
        "update": (270, 120, 190, "update", "controllers command joints"),
        "gate": (530, 120, 190, "gate", "commands become goals"),
        "write": (790, 120, 190, "write", "goals become one packet"),
        "servos": (270, 220, 450, "servos", "on a serial line"),
        "record": (10, 320, 190, "cycle record", "states, commands, goals"),
        "recorder": (270, 320, 190, "recorder", "messages of the log"),
        "log": (530, 320, 190, "log", "one MCAP file"),
        "analyze": (790, 320, 190, "dxlrun analyze", "one row a joint"),
    },
    (
        ("send", "right", "gateway", "left", "HTTP", False),
        ("gateway", "bottom", "update", "top", "mailbox", False),
        ("read", "right", "update", "left", "states", False),
        ("update", "right", "gate", "left", "commands", False),
        ("gate", "right", "write", "left", "goals", False),
        ("write", "bottom", "servos", "right", "sync write", False),
        ("servos", "left", "read", "bottom-right", "status", False),
        ("read", "bottom", "record", "top", "arrays", False),
        ("record", "right", "recorder", "left", "ring", False),
        ("recorder", "right", "log", "left", "chunks", False),
        ("log", "right", "analyze", "left", "slices", False),
    ),
)
KEY: tuple[dict[str, Box], tuple[Arrow, ...]] = (
    {
        "file": (10, 20, 180, "robot file", "position_p_gain: 1500"),
        "tree": (270, 20, 180, "document", "values with line and column"),
        "form": (530, 20, 180, "form", "a valid joint"),
        "check": (790, 20, 180, "check", "address 84, 2 bytes"),
        "servo": (10, 130, 180, "servo", "elbow_flex, ID 3"),
        "exchange": (270, 130, 180, "exchange", "bytes and timeout"),
        "start": (530, 130, 180, "start-up", "read, compare, write"),
        "plan": (790, 130, 180, "plan", "JSON in shared memory"),
    },
    (
        ("file", "right", "tree", "left", "YAML", False),
        ("tree", "right", "form", "left", "dicts", False),
        ("form", "right", "check", "left", "Robot", False),
        ("check", "bottom", "plan", "top", "no error", False),
        ("plan", "left", "start", "right", "BusPlan", False),
        ("start", "left", "exchange", "right", "transaction", False),
        ("exchange", "left", "servo", "right", "packet", True),
    ),
)


def processes() -> str:
    """Draw the processes of a run, and what passes between them."""
    return _boxes_and_arrows(*PROCESSES, width=990, height=272)


def motion() -> str:
    """Draw the way of one motion, from a command to a row of a report."""
    return _boxes_and_arrows(*MOTION, width=990, height=392)


def key() -> str:
    """Draw the way of one key of a robot file to the servo."""
    return _boxes_and_arrows(*KEY, width=990, height=202)


def _boxes_and_arrows(boxes: dict[str, Box], arrows: tuple[Arrow, ...], *, width: int, height: int) -> str:
    parts = [
        f'<svg viewBox="0 0 {width} {height}" xmlns="http://www.w3.org/2000/svg"',
        ' font-family="DejaVu Sans, sans-serif" text-anchor="middle">',
        '<defs><marker id="to" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7"',
        f' orient="auto-start-reverse"><path d="M0 0L8 4L0 8z" fill="{GREY}"/></marker></defs>',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for key_, (x, y, wide, name, about) in boxes.items():
        fill = "white" if key_ in OUTSIDE else "#e3eefa" if key_ in IN_LOOP else "#f3f5f7"
        line = f'stroke="{GREY}"' + ' stroke-dasharray="5 4"' * (key_ in OUTSIDE)
        middle = x + wide / 2
        parts += [
            f'<rect x="{x}" y="{y}" width="{wide}" height="{BOX_HEIGHT}" rx="6" fill="{fill}" {line}/>',
            f'<text x="{middle}" y="{y + 22}" font-size="15" font-weight="bold">{name}</text>',
            f'<text x="{middle}" y="{y + 40}" font-size="10.5">{escape(about)}</text>',
        ]
    for one, out, other, into, what, both in arrows:
        (x0, y0), (x1, y1) = _side(boxes[one], out), _side(boxes[other], into)
        ends = 'marker-end="url(#to)"' + ' marker-start="url(#to)"' * both
        beside = 6 + 3 * len(what)
        x, y = ((x0 + x1) / 2, y0 - 5) if y0 == y1 else ((x0 + x1) / 2 + beside, (y0 + y1) / 2 + 4)
        parts += [
            f'<path d="M{x0} {y0}L{x1} {y1}" stroke="{GREY}" fill="none" {ends}/>',
            f'<text x="{x}" y="{y}" font-size="10.5" fill="{GREY}">{what}</text>',
        ]
    return "\n".join([*parts, "</svg>"]) + "\n"


def _side(box: Box, side: str) -> tuple[float, float]:
    """Return a point on the edge of a box."""
    x, y, width, *_ = box
    across = {"left": 0.0, "right": 1.0}.get(side, 0.85 if side.endswith("right") else 0.5)
    along = 0.0 if side.startswith("top") else 1.0 if side.startswith("bottom") else 0.5
    return x + across * width, y + along * BOX_HEIGHT
