"""Make the pictures of the pages from the program: `python docs/pictures/make.py [NAME ...]`.

A picture is named after its file. Pictures of a terminal are what commands print there. `report`,
`arm_report`, `latency` and `characterize` are plots of pages of `--report`, as Chromium shows them. Robots
are on the page of `dxlrun view`, of a log or live. `by_hand.py` answers the dialogues. It and `drawn.py` draw
the others.

Needs the extra `report`. Pictures that need Chromium or `pip install ./plugins/dxlrun_view` are omitted where
these are missing. All take some minutes, because robots run in real time; `--virtual` omits what only real
time shows.

`inputs.json` has the hashes of what each picture is made from (`inputs.py`). It is written with the pictures;
`--check` makes nothing, and exits with 1 when inputs have changed since.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from PIL import Image, ImageChops  # comes with bokeh

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import by_hand  # noqa: E402  # in this folder
import drawn  # noqa: E402
import inputs  # noqa: E402
from inputs import MISTAKES, PLAY, ROBOTS, first_lines, first_tables, lose_servo, prepare  # noqa: E402
from terminal import printed, terminal  # noqa: E402

PICTURES = Path(__file__).resolve().parent

WIDTH, HEIGHT = 1040, 2600
"""Of a report's picture, px."""
COLOURS = 48
"""Of a PNG, so that it is small."""
MOVE = "(time => { const at = document.querySelector('#time'); at.value = time; at.oninput(); })"
"""In the page of `dxlrun view`: go to a time of a log."""


class Maker:
    """Makes pictures in a directory, from runs in another one."""

    def __init__(self, into: Path, place: Path, *, virtual: bool) -> None:
        self.into, self.place, self.virtual = into, place, virtual
        prepare(place)

    def terminal(self, name: str, *commands: str, code: int = 0, columns: int = 104) -> None:
        """Take a picture of commands, one after the other."""
        told = [
            (f"dxlrun {one}", printed(one.split(), self.place, code=code, columns=columns))
            for one in commands
        ]
        (self.into / f"{name}.svg").write_text(terminal(told, columns))

    @contextmanager
    def running(self, *words: str) -> Iterator[None]:
        """Run a robot or simulated servos meanwhile."""
        code = "import sys; from dxlrun.cli import main; sys.exit(main())"
        command = [sys.executable, "-c", code, *words]
        with (self.place / "said").open("wb") as said:
            process = subprocess.Popen(command, cwd=self.place, stdout=said, stderr=said)
        try:
            while not self._began(words):
                if process.poll() is not None:
                    raise SystemExit((self.place / "said").read_text())
                time.sleep(0.5)
            yield
        finally:
            process.terminate()
            process.wait(60)

    def _began(self, words: Sequence[str]) -> bool:
        if words[0] == "sim":
            return Path(words[-1]).exists()
        return any(re.search(r"[ m]active", line) for line in printed(["list"], self.place))

    def figures(self, name: str, page: Path, *plots: str) -> None:
        """Take a picture of a page of `--report`: its head, and some plots one below the other."""
        chromium = shutil.which("chromium")
        if chromium is None:
            return
        shown = ", ".join(f"#{plot}" for plot in plots)
        hidden = ".table, nav, #worst, #machine, #buses, #steering, #events, main p:not(.legend), footer"
        hidden += ", section:not(.verdict, :has(figure))"
        style = f"<style>figure:not({shown}), {hidden} {{ display: none }}</style>"
        shortened, taken = self.place / "shown.html", self.place / "taken.png"
        text = re.sub(r"(Linux \d+\.\d+)[^,<]*", r"\1", page.read_text())  # not which machine
        shortened.write_text(text.replace("</head>", f"{style}</head>"))
        words = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run"]
        words += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
        words += [f"--user-data-dir={self.place / 'chromium'}", "--virtual-time-budget=30000"]
        words += [f"--window-size={WIDTH},{HEIGHT}", f"--screenshot={taken}", shortened.as_uri()]
        subprocess.run([chromium, *words], check=True, capture_output=True, timeout=300)
        with Image.open(taken) as picture:
            opaque = picture.convert("RGB")
            below = ImageChops.difference(opaque, Image.new("RGB", opaque.size, "white")).getbbox()
            cut = opaque.crop((0, 0, WIDTH, min(HEIGHT, below[3] + 30) if below else HEIGHT))
            cut.quantize(COLOURS).save(self.into / f"{name}.png", optimize=True)

    # The pictures

    def readme(self) -> None:
        """Run the README's first command, and analyze it: `terminal` and `report`."""
        more = ("--virtual",) if self.virtual else ()
        ran = printed((*PLAY, *more), self.place)
        if any("too busy" in line for line in ran):
            raise SystemExit("terminal: this machine is too busy for a run in real time; repeat it later")
        analyzed = printed(("analyze", "--report", "report.html"), self.place)
        self.figures("report", self.place / "report.html", "lateness", "steps", "joint-7")  # head_yaw_joint
        commands = [(f"dxlrun {' '.join((*PLAY, *more))}", ran)]
        commands.append(("dxlrun analyze", [*first_tables(analyzed), "..."]))
        (self.into / "terminal.svg").write_text(terminal(commands))

    def check(self) -> None:
        """Check the tutorial's arm."""
        self.terminal("check", "check arm.yaml", columns=130)

    def mistakes(self) -> None:
        """Check a file with five mistakes."""
        kept, file = (self.place / "arm.yaml").read_text(), self.place / "arm.yaml"
        file.write_text(MISTAKES)
        self.terminal("mistakes", "check arm.yaml", code=2)
        file.write_text(kept)

    def graph(self) -> None:
        """Show the controllers of the torso."""
        self.terminal("graph", "check robots/bioloid_torso.yaml --graph", columns=150)

    def watch(self) -> None:
        """Watch the tutorial's arm in its motion."""
        with self.running("arm.yaml"):
            printed(("play", "wave", "--no-wait"), self.place)
            time.sleep(2)
            lines = printed(("watch", "--once"), self.place, columns=90)
            printed(("stop",), self.place)
        shown = [line.replace(f"{self.place}/", "") for line in lines]
        (self.into / "watch.svg").write_text(terminal([("dxlrun watch --once", shown)], 90))

    def arm_report(self) -> None:
        """Play the tutorial's motion, and plot it."""
        printed(("arm.yaml", "--virtual", "--play", "wave.yaml"), self.place)
        printed(("analyze", "--report", "arm.html"), self.place)
        self.figures("arm_report", self.place / "arm.html", "joint-2", "joint-2-error", "steps")

    def scan(self) -> None:
        """Look for four simulated servos."""
        link = str(self.place / "servos")
        with self.running("sim", "--servo", "XL430-W250:1-3", "--servo", "XM430-W350:4", "--link", link):
            words = "scan /dev/ttyUSB0 --protocol 2.0 --baud 57600 --ids 1-9"
            lines = printed(words.replace("/dev/ttyUSB0", link).split(), self.place)
        shown = [line.replace(link, "/dev/ttyUSB0") for line in lines]
        (self.into / "scan.svg").write_text(terminal([(f"dxlrun {words}", shown)], 84))

    def doctor(self) -> None:
        """Look at this machine."""
        lines = [re.sub(r"(Linux \d+\.\d+)\S*", r"\1", line) for line in printed(("doctor",), self.place)]
        (self.into / "doctor.svg").write_text(terminal([("dxlrun doctor", lines)]))

    def latency(self) -> None:
        """Measure how late this machine wakes a loop up."""
        printed(("latency", "--count", "10000", "--period", "1ms", "--report", "latency.html"), self.place)
        self.figures("latency", self.place / "latency.html", "latency-histogram", "lateness")

    def lost(self) -> None:
        """Analyze a run in which a servo was silent for a second."""
        lose_servo(self.place, self.place / "arm.mcap")
        verdict = first_lines(printed(("analyze", "arm.mcap"), self.place, code=1))
        (self.into / "lost.svg").write_text(terminal([("dxlrun analyze arm.mcap", [*verdict, "..."])]))

    def characterize(self) -> None:
        """Measure a simulated servo."""
        words = "characterize robots/single_joint.yaml joint --virtual"
        printed((*words.split(), "--report", "characterize.html"), self.place)
        self.figures("characterize", self.place / "characterize.html", "joint-steps", "joint-moves")

    def fall(self) -> None:
        """Tip a torso over."""
        words = ("robots/fall_reflex.yaml", "--virtual", "--play", "robots/motions/fall_reflex_tip.yaml")
        printed(words, self.place)
        (self.into / "fall.svg").write_text(drawn.fall(self._log))

    def reach(self, name: str, robot: str, link: str) -> None:
        """Draw where a link of an arm gets to."""
        printed(("reach", f"robots/{robot}.yaml", link, f"{name}.png"), self.place)
        self._kept(name, base64.b64encode((self.place / f"{name}.png").read_bytes()).decode())

    def cycle(self) -> None:
        """Look into a cycle of the torso."""
        # The goals of a motion change, so the cycle has a write. Its goals are not reached in 3 s.
        printed((*PLAY, "--virtual", "--duration", "3"), self.place, code=1)
        (self.into / "cycle.svg").write_text(drawn.cycle(self._log))

    def drawing(self, name: str) -> None:
        """Draw a picture that needs no run."""
        (self.into / f"{name}.svg").write_text(DRAWINGS[name]())

    def setup(self) -> None:
        """Set a new servo up."""
        place = self._of_one_joint("setup")
        with self.running("sim", "--servo", "XL430-W250:1", "--link", str(place / "line")):
            self._dialogue("setup", by_hand.setup(place))

    def calibrate(self) -> None:
        """Calibrate a joint."""
        self._dialogue("calibrate", by_hand.calibrate(self._of_one_joint("calibrate")))

    def teach(self) -> None:
        """Show a motion."""
        self._dialogue("teach", by_hand.teach(self._of_one_joint("teach")))

    def _of_one_joint(self, name: str) -> Path:
        """Return a new folder with the robot of the dialogues."""
        place = self.place / name
        place.mkdir()
        (place / "arm.yaml").write_text(by_hand.ROBOT)
        return place

    def _dialogue(self, name: str, frame: by_hand.Frame) -> None:
        (self.into / f"{name}.svg").write_text(terminal([frame]))

    @property
    def _log(self) -> Path:
        """The newest log."""
        return max((self.place / "logs").glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)

    def viewed(self, names: Sequence[str]) -> None:
        """Take pictures of robots on the page."""
        if (
            shutil.which("chromium") is None
            or find_spec("dxlrun_view") is None
            or not files("dxlrun_view").joinpath("page/build/page.js").is_file()
        ):
            return
        from tests.kit.browser import Browser
        from tests.view.served import Served

        from dxlrun_view.live_robot import LiveRobot
        from dxlrun_view.recorded_robot import RecordedRobot

        with ExitStack() as stack:
            drawing = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run")
            browser = Browser(self.place / "browser", *drawing)
            stack.callback(browser.close)
            for name in names:
                if name not in ROBOTS:
                    continue
                shown = ROBOTS[name]
                motion = ("--play", f"robots/motions/{shown.motion}.yaml")
                printed((f"robots/{shown.robot}.yaml", *shown.arguments, "--virtual", *motion), self.place)
                served = Served(RecordedRobot(self._log))
                browser.open(served.address, *shown.size)
                browser.until("window.looked > 3")
                looked = browser.value(f"{MOVE}({shown.at_s}), window.looked")
                browser.until(f"window.looked > {looked + 3}")
                browser.click("#fit")
                left, top, width, height = browser.place("#scene")
                middle = (left + width / 2, top + height / 2)
                browser.drag(middle, (middle[0] + shown.turned, middle[1]))
                browser.until(f"window.looked > {looked + 8}")
                self._kept(name, browser.picture())
                served.close()
            if "view" not in names or self.virtual:
                return
            with self.running("robots/bioloid_torso_imu.yaml"):
                live = LiveRobot("bioloid_torso_imu")
                served = Served(live, control=True)
                for name, width, height in (("view", 1280, 760), ("view_phone", 390, 760)):
                    browser.open(served.address, width, height, dark=width < 600)
                    browser.until("window.looked > 5")
                    if name == "view":
                        printed(("play", "three_parts", "--no-wait"), self.place)
                        end_s = live.moment_at(None).time + 9.0
                        # Looks between those of the page, so that its curves have no gap on a busy machine.
                        while live.moment_at(None).time < end_s:
                            time.sleep(0.04)
                    self._kept(name, browser.picture())
                served.close()

    def _kept(self, name: str, picture: str) -> None:
        with Image.open(io.BytesIO(base64.b64decode(picture))) as shown:
            shown.convert("RGB").quantize(COLOURS * 2).save(self.into / f"{name}.png", optimize=True)


REACHES = {
    "reach": ("open_manipulator_x_space", "end_effector_link"),
    "reach_op3": ("op3_space", "r_hand"),
}
"""Robot and link of each picture of what a link gets to."""
DRAWINGS: dict[str, Callable[[], str]] = {
    "processes": drawn.processes,
    "motion": drawn.motion,
    "key": drawn.key,
    "setup_hands": by_hand.draw_setup,
    "calibrate_hands": by_hand.draw_calibrate,
    "teach_hands": by_hand.draw_teach,
}
MADE: dict[str, Callable[[Maker], None]] = {
    "terminal": Maker.readme,
    "report": Maker.readme,
    "check": Maker.check,
    "mistakes": Maker.mistakes,
    "graph": Maker.graph,
    "scan": Maker.scan,
    "lost": Maker.lost,
    "fall": Maker.fall,
    "cycle": Maker.cycle,
    **{name: partial(Maker.reach, name=name, robot=arm[0], link=arm[1]) for name, arm in REACHES.items()},
    "setup": Maker.setup,
    "calibrate": Maker.calibrate,
    "teach": Maker.teach,
    "characterize": Maker.characterize,
    "arm_report": Maker.arm_report,
    "watch": Maker.watch,
    "doctor": Maker.doctor,
    "latency": Maker.latency,
    **{name: partial(Maker.drawing, name=name) for name in DRAWINGS},
}
VIEWED = ("view", "view_phone", *ROBOTS)
"""Pictures of the page of `dxlrun view`."""
SLOW = ("watch", "doctor", "latency", "characterize")
"""Omitted with `--virtual`: real time, this machine, or minutes."""


def main() -> int:
    """Make all pictures, or those that are named; or check their inputs."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join((*MADE, *VIEWED)))
    parser.add_argument("--into", type=Path, default=PICTURES)
    parser.add_argument("--virtual", action="store_true")
    parser.add_argument("--check", action="store_true", help="name the pictures whose inputs have changed")
    options = parser.parse_args()
    names = options.names or [
        name for name in (*MADE, *VIEWED) if not (options.virtual and name in (*SLOW, *VIEWED[:2]))
    ]
    if unknown := [name for name in names if name not in {*MADE, *VIEWED}]:
        parser.error(f"there is no picture {unknown[0]}; the pictures are {', '.join((*MADE, *VIEWED))}")
    with tempfile.TemporaryDirectory() as directory:
        os.environ["XDG_RUNTIME_DIR"] = directory  # no other robot of this machine
        if options.check:
            print("\n".join(lines := inputs.stale(options.names)))
            return 1 if lines else 0
        began_ns = time.time_ns()
        maker = Maker(options.into.resolve(), Path(directory), virtual=options.virtual)
        for make in dict.fromkeys(MADE[name] for name in names if name in MADE):
            make(maker)
        maker.viewed([name for name in names if name in VIEWED])
    made = {path.stem for path in options.into.iterdir() if path.stat().st_mtime_ns >= began_ns}
    if options.into == PICTURES and not options.virtual:
        inputs.record(sorted(made & {*MADE, *VIEWED}))
    for name in sorted({*names} - made):
        print(f"{name}: not made; it needs Chromium, and some the package of dxlrun view")
    return 0


if __name__ == "__main__":
    sys.exit(main())
