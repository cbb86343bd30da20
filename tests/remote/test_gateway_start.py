"""Whether a run has a gateway is what robot file and command line say; no run waits until it has started."""

import io
from dataclasses import fields
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec.structs import replace
from rich.console import Console

from dxlrun.channels.child_processes import Failed, Listening, Stop
from dxlrun.channels.heartbeat import Heartbeat, Phase, create
from dxlrun.channels.mailbox import Mailbox
from dxlrun.channels.ring import RingWriter
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.plan.robot_plan import from_json, to_json
from dxlrun.remote.job import Descriptors
from dxlrun.remote.link import Link
from dxlrun.run import supervisor
from dxlrun.run.run_processes import create_memory
from dxlrun.run.run_summary import RunOptions

pytestmark = pytest.mark.usefixtures("no_memory_left")

ROBOT = Path(__file__).parents[2] / "robots" / "single_joint.yaml"


class Gateway:
    """What the supervisor sees of a gateway: its messages, and that its channel is closed afterwards."""

    def __init__(self, *messages):
        self.messages = list(messages)
        self.channel = self
        self.closed = not messages
        self.killed = False

    def poll_message(self, timeout_s):
        self.closed = True
        return self.messages.pop(0) if self.messages else None

    def kill(self):
        self.killed = True


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """Return the plan of a robot file with one more block."""
    directory = tmp_path_factory.mktemp("robots")

    @cache
    def make(block):
        path = directory / "robot.yaml"
        path.write_text(f"{ROBOT.read_text()}\n{block}\n")
        return from_json(to_json(compile_files(path, {}, (), None, None).plan))

    return make


@pytest.fixture
def make_run(plan):
    def make(block="", **options):
        return supervisor._Run(plan(block), RunOptions(**options), None, Console(file=io.StringIO()))

    return make


@pytest.fixture
def heartbeat():
    found = Heartbeat(create())
    found.enter_phase(Phase.RUNNING)
    return found


@pytest.fixture
def started(monkeypatch):
    """The gateways that were started; the next one to start may be put into it."""
    found = []
    ready = [Gateway(Listening("/nowhere/robot.sock"))]

    def start(log, memory, epoch_offset_ns, listen):
        if isinstance(ready[0], OSError):
            raise ready[0]
        found.append(ready[0])
        return ready[0]

    monkeypatch.setattr(supervisor, "start_gateway", start)
    start.found, start.ready = found, ready
    return start


@pytest.mark.parametrize(
    ("block", "wanted", "count"),
    [
        ("", True, 1),
        ("processes: {gateway: {enabled: true}}", True, 1),
        ("processes: {gateway: {enabled: false}}", True, 0),
        ("", False, 0),
        ("processes: {gateway: {enabled: true}}", False, 0),
    ],
)
def test_both_the_robot_file_and_the_command_line_can_forbid_it(make_run, started, block, wanted, count):
    run = make_run(block, gateway=wanted)
    heartbeat = Heartbeat(create())
    heartbeat.enter_phase(Phase.RUNNING)
    for _ in range(3):
        run._look_after_gateway(heartbeat)
    assert len(started.found) == count


@pytest.mark.parametrize("phase", [Phase.LOADING, Phase.SETUP, Phase.STOPPING, Phase.DONE])
def test_it_is_started_when_the_loop_runs_and_not_before_or_after(make_run, started, heartbeat, phase):
    heartbeat.enter_phase(phase)
    make_run()._look_after_gateway(heartbeat)
    assert started.found == []


@pytest.mark.parametrize(
    ("ready", "remark"),
    [
        (OSError(11, "Resource temporarily unavailable"), "did not start (Resource temporarily unavailable)"),
        (Gateway(Failed("/tmp/x must be a directory")), "did not start (/tmp/x must be a directory)"),  # noqa: S108
        (Gateway(), "ended"),
    ],
    ids=["no process", "no place", "ends"],
)
def test_without_it_the_run_continues_with_one_remark(make_run, started, heartbeat, ready, remark):
    run = make_run()
    started.ready[0] = ready
    for _ in range(5):
        run._look_after_gateway(heartbeat)
    assert run.remarks == [f"the gateway {remark}: the run continues, but cannot be steered"]
    assert run.sentences == []
    assert all(one.killed for one in started.found)


def test_the_socket_of_a_gateway_that_was_killed_is_removed(make_run, started, heartbeat, tmp_path):
    place = tmp_path / "robot.sock"
    place.touch()
    started.ready[0] = Gateway(Listening(str(place)))
    run = make_run()
    for _ in range(3):
        run._look_after_gateway(heartbeat)
    assert not place.exists()
    assert len(run.remarks) == 1


@pytest.mark.parametrize("kind", ["held", "refused", "simulated", "not wanted", "listens", "listens not"])
def test_a_robot_that_must_be_reached_begins_when_the_gateway_answers(plan, started, heartbeat, kind):
    """On a real port, or where clients of other computers are to; it ends where there is none."""
    given = plan("") if kind in {"simulated", "listens", "listens not"} else real(plan(""))
    memory = create_memory(given)
    listen = "lab3:7660" if kind in {"listens", "listens not"} else ""
    options = RunOptions(record=False, gateway=kind != "not wanted", listen=listen)
    run = supervisor._Run(given, options, memory, Console(file=io.StringIO()))
    run.post_pause()
    inbox = Mailbox(memory.mailbox, RingWriter(memory.answers))
    held = kind in {"held", "refused", "listens", "listens not"}
    assert [(one.kind, one.origin) for one in inbox.drain_commands()] == [("pause", "loop")] * held
    run.guardian = SimpleNamespace(channel=SimpleNamespace(send_message=(sent := []).append))
    if refused := kind in {"refused", "listens not"}:
        started.ready[0] = Gateway(Failed("no place"))
    for _ in range(2):
        run._look_after_gateway(heartbeat)
    assert sent == [Stop()] * refused
    fix = f"{'omit --listen' if listen else 'give --no-gateway'} to run without the gateway"
    assert run.sentences == (
        [f"the gateway did not start (no place), so the robot did not move; {fix}"] * len(sent)
    )
    descriptors = Descriptors(*(getattr(memory, one.name) for one in fields(Descriptors)))
    Link(given, descriptors).let_begin()
    assert [(one.kind, one.origin) for one in inbox.drain_commands()] == [("resume", "loop")] * held


def real(plan):
    return replace(plan, buses=tuple(replace(bus, port="/dev/ttyUSB0") for bus in plan.buses))
