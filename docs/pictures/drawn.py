"""Pictures that are drawn: what logs hold, and the processes of a run, as SVG."""

from __future__ import annotations

import io
from html import escape
from pathlib import Path

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


BOXES = {
    "supervisor": (10, 20, 210, "supervisor", "compiles the file, starts the others"),
    "bus": (300, 20, 190, "simulated bus", "only for ports sim"),
    "sensors": (300, 200, 190, "sensors", "one process each"),
    "guardian": (10, 110, 210, "guardian", "holds the ports, watches the loop"),
    "loop": (300, 110, 190, "loop", "read, update, gate, write"),
    "recorder": (570, 200, 190, "recorder", "writes the log"),
    "gateway": (570, 110, 190, "gateway", "answers clients"),
    "clients": (830, 110, 150, "clients", "send, watch, view"),
    "servos": (570, 20, 190, "servos", "on serial lines"),
}
ARROWS = (
    ("loop", "top", "bus", "bottom", "bytes", True),
    ("loop", "top-right", "servos", "left", "bytes", True),
    ("guardian", "right", "loop", "left", "heartbeat", True),
    ("supervisor", "bottom", "guardian", "top", "starts", False),
    ("sensors", "top", "loop", "bottom", "slots", False),
    ("loop", "bottom-right", "recorder", "left", "rings", False),
    ("gateway", "left", "loop", "right", "mailbox", True),
    ("clients", "left", "gateway", "right", "HTTP", True),
)
"""From box and side, to box and side, what passes, whether it passes in both directions."""
BOX_HEIGHT = 52


def processes() -> str:
    """Draw the processes of a run, and what passes between them."""
    parts = [
        '<svg viewBox="0 0 990 272" xmlns="http://www.w3.org/2000/svg"',
        ' font-family="DejaVu Sans, sans-serif" text-anchor="middle">',
        '<defs><marker id="to" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7"',
        f' orient="auto-start-reverse"><path d="M0 0L8 4L0 8z" fill="{GREY}"/></marker></defs>',
        '<rect width="990" height="272" fill="white"/>',
    ]
    for x, y, width, name, about in BOXES.values():
        outside = name in {"clients", "servos"}
        fill = "white" if outside else "#e3eefa" if name == "loop" else "#f3f5f7"
        line = f'stroke="{GREY}"' + ' stroke-dasharray="5 4"' * outside
        middle = x + width / 2
        parts += [
            f'<rect x="{x}" y="{y}" width="{width}" height="{BOX_HEIGHT}" rx="6" fill="{fill}" {line}/>',
            f'<text x="{middle}" y="{y + 22}" font-size="15" font-weight="bold">{name}</text>',
            f'<text x="{middle}" y="{y + 40}" font-size="10.5">{escape(about)}</text>',
        ]
    for one, out, other, into, what, both in ARROWS:
        (x0, y0), (x1, y1) = _side(one, out), _side(other, into)
        ends = 'marker-end="url(#to)"' + ' marker-start="url(#to)"' * both
        x, y = ((x0 + x1) / 2, y0 - 5) if y0 == y1 else ((x0 + x1) / 2 + 22, (y0 + y1) / 2 + 4)
        parts += [
            f'<path d="M{x0} {y0}L{x1} {y1}" stroke="{GREY}" fill="none" {ends}/>',
            f'<text x="{x}" y="{y}" font-size="10.5" fill="{GREY}">{what}</text>',
        ]
    return "\n".join([*parts, "</svg>"]) + "\n"


def _side(name: str, side: str) -> tuple[float, float]:
    """Return a place at the edge of a box."""
    x, y, width, *_ = BOXES[name]
    across = {"left": 0.0, "right": 1.0}.get(side, 0.85 if side.endswith("right") else 0.5)
    along = 0.0 if side.startswith("top") else 1.0 if side.startswith("bottom") else 0.5
    return x + across * width, y + along * BOX_HEIGHT
