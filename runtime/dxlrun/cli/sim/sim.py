"""`dxlrun sim`: serve simulated servos on ports that other programs open like those of an adapter."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import Parameter
from msgspec.structs import replace

from dxlrun.cli.inputs import AssignmentOfItsOwn, Flag, JsonOfItsOwn, compiled
from dxlrun.cli.sim.sim_inputs import (
    Absent,
    InputMistakes,
    Split,
    read_faults,
    read_latency,
    servo_bus,
    with_adapter,
)
from dxlrun.errors import InputError
from dxlrun.output.target import check_target
from dxlrun.output.terminal import out, print_error, print_warning, show_parts
from dxlrun.output.unblocked import leave_real_time, unblocked

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dxlrun.cli.sim.sim_views import SimulationView
    from dxlrun.run.simulation_front import SimulationResult
    from dxlsim.faults.fault import Fault
    from dxlsim.messages import SimulationJob
    from dxlsim.simulation_plan import BusConfig, SimulationConfig

Words = Annotated[tuple[str, ...], Parameter(negative=(), show_default=False, allow_leading_hyphen=False)]
# The guardian's priority is one above the loop's.
_ABOVE_LOOP = 2
# Without a robot file: above a loop with the default priority.
_PRIORITY = 31 + _ABOVE_LOOP
Seed = Annotated[int, Parameter(show_default=False)]


@unblocked()
def sim(
    robot: Path | None = None,
    /,
    *assignments: AssignmentOfItsOwn,
    servo: Words = (),
    baud: int | None = None,
    protocol: float | None = None,
    recorded: Path | None = None,
    link: Path | None = None,
    fault: Words = (),
    faults: Path | None = None,
    seed: Seed = 0,
    ledger: Path | None = None,
    latency_timer: str | None = None,
    split: Split | None = None,
    echo: Flag = False,
    absent: Absent | None = None,
    as_json: JsonOfItsOwn = False,
    debug: Flag = False,
) -> int:
    """Serve simulated servos on pseudo-terminals: for any program that speaks Dynamixel.

    Give a robot file, servos with `--servo`, or a log with `--recorded`. Faults can be typed during the
    simulation; `help` lists them. Ctrl-C ends the simulation.

    Parameters
    ----------
    robot
        Robot file. All its buses are simulated, whatever their ports are.
    assignments
        Arguments of the robot file, for example rate:=25.
    servo
        Servos on one bus without a robot file, MODEL:IDS, for example XL430-W250:1-3 or AX-12A:1,4. Can be
        given several times.
    baud
        Baud rate, bit/s, of the bus of --servo. Default: the factory setting of the servos.
    protocol
        Protocol, 1.0 or 2.0, of the bus of --servo. Required only for models that exist with both.
    recorded
        Log to replay: a host gets the replies that the servos of the log sent. No servo is simulated then.
    link
        Symbolic link to the pseudo-terminal, whose own name changes at each start. With several buses, the
        links are LINK.NAME with the name of each bus.
    fault
        Fault to inject, for example "lose servo=3 at=2s". Can be given several times.
    faults
        Text file with one fault per line.
    seed
        Seed of the random numbers of faults and adapter. Default: 0.
    ledger
        Output file for the ledger of the simulated buses: every byte with its time, and every fault.
    latency_timer
        Time for which the adapter holds replies back, as FTDI adapters do, for example "4 ms".
    split
        Form in which the adapter delivers replies: whole, byte by byte, or in pieces of random length.
    echo
        Return all bytes that are sent, as some half-duplex adapters do.
    absent
        Reaction of the servos after a missing one in a sync or bulk read: no reply (silent), or a reply after
        its slot (slot).
    as_json
        Print the result as JSON: the ports, then one line per fault.
    debug
        Print the traceback of an error, and the output of the simulation process.
    """
    leave_real_time()
    mistakes = InputMistakes()
    with mistakes.collected():
        planned = read_faults(fault, faults)
    with mistakes.collected():
        if ledger is not None:
            check_target(ledger)
    with mistakes.collected():
        latency_ns = read_latency(latency_timer)
    with mistakes.collected():
        if recorded is None:
            simulated = _simulated(robot, assignments, servo, baud, protocol)
        else:
            others = {"a robot file": robot, "--servo": servo or None, "--baud": baud, "--protocol": protocol}
            simulated = _recorded(recorded, [name for name, value in others.items() if value is not None])
        links = link_of_each(simulated.config.buses, link)
    mistakes.raise_errors()
    given = {"latency_timer_ns": latency_ns, "split": split, "echo": echo or None}
    buses = tuple(with_adapter(bus, given, absent, seed) for bus in simulated.config.buses)
    check_simulated(buses, planned, seed)
    from dxlrun.channels.child_processes import spare_core
    from dxlrun.cli.sim.sim_views import SimulationView, ending
    from dxlsim.messages import SimulationJob

    title = simulated.title
    config = msgspec.structs.replace(
        simulated.config,
        buses=buses,
        faults=tuple(str(each) for each in planned),
        seed=seed,
        links={bus: str(path) for bus, path in links.items()},
    )
    shown = SimulationView(title, buses, links, simulated.hint)
    core = spare_core(simulated.loop_cores)
    job = SimulationJob(config, str(ledger) if ledger else None, simulated.priority, core)
    served = _serve(job, shown, as_json=as_json)
    if not as_json:
        show_parts(
            ending(title, served.elapsed_s, served.look), *[f"ledger: {ledger}"] * (ledger is not None)
        )
    if debug:
        sys.stderr.write(served.printed)
    for sentence in served.sentences:
        print_error(f"{title}: {sentence}")
    return 1 if served.sentences else 0


class _SimulationSetup(msgspec.Struct, frozen=True):
    """Simulation to be served: its buses, from a robot file, `--servo` or `--recorded`, and its real-time
    settings.
    """

    title: str
    config: SimulationConfig
    # Real-time priority, above the loop's.
    priority: int = _PRIORITY
    # Cores of the loop; empty: all.
    loop_cores: tuple[int, ...] = ()
    # A command line that uses the simulation when the port is added.
    hint: str | None = None


def _simulated(
    robot: Path | None,
    assignments: Sequence[str],
    servo: Sequence[str],
    baud: int | None,
    protocol: float | None,
) -> _SimulationSetup:
    from dxlsim.simulation_plan import SimulationConfig

    if robot is None:
        if not servo:
            raise InputError(
                "there is nothing to simulate; give a robot file, or servos such as --servo XL430-W250:1-3"
            )
        return _SimulationSetup("simulation", SimulationConfig((servo_bus(servo, baud, protocol),)))
    options = {"--servo": servo or None, "--baud": baud, "--protocol": protocol}
    given = [name for name, value in options.items() if value is not None]
    if (servo or ":" in str(robot)) and not robot.is_file():
        raise InputError(f"{robot} is not a robot file; give each servo by --servo, such as --servo {robot}")
    if given:
        raise InputError(f"{' and '.join(given)} and a robot file exclude each other; omit one of them")
    result = compiled(robot, assignments, (), None)
    for warning in result.warnings:
        print_warning(str(warning))
    from dxlrun.compile.simulation import simulation_of

    plan = result.plan
    simulation = simulation_of(replace(plan, buses=tuple(replace(bus, port="sim") for bus in plan.buses)))
    others = [word for word in assignments if not word.startswith("port:=")]
    hint = shlex.join(["dxlrun", str(robot), *others])
    takes_port = len(plan.buses) == 1 and "port" in plan.arguments
    return _SimulationSetup(
        title=plan.robot,
        config=simulation,
        priority=min(plan.loop.scheduler.priority + _ABOVE_LOOP, 99),
        loop_cores=plan.loop.scheduler.cores,
        hint=hint if takes_port else None,
    )


def _recorded(log: Path, others: Sequence[str]) -> _SimulationSetup:
    """Return a simulation of the buses of a log, which answer as recorded; `others`: given options that
    exclude it.

    Raises InputError for one of these or a missing plan, and LogError for an unreadable log.
    """
    if others:
        raise InputError(f"--recorded and {' and '.join(others)} exclude each other; omit one of them")
    if not log.exists():
        raise InputError(f"log {log} not found; give the path that the run printed")
    from dxlrun.log.log_reader import open_log
    from dxlrun.plan.robot_plan import from_json
    from dxlsim.simulation_plan import BusConfig, SimulationConfig

    reader = open_log(log)
    try:
        plan = from_json(reader.attachments["plan.json"])
    except (KeyError, ValueError) as error:
        raise InputError(f"{log}: the plan of the run cannot be read; give another log") from error
    path = str(log.absolute())
    buses = tuple(BusConfig(bus.name, bus.baud_rate, (), bus.protocol, recorded=path) for bus in plan.buses)
    hint = "dxlrun ROBOT.yaml" if len(buses) == 1 else None
    return _SimulationSetup(f"{plan.robot}, recorded", SimulationConfig(buses), hint=hint)


def check_simulated(buses: Sequence[BusConfig], faults: Sequence[Fault], seed: int) -> None:
    """Build the simulated buses with their faults once, so that mistakes are reported before anything starts.

    Raises InputError for a servo that cannot be simulated, and for each impossible fault.
    """
    from dxlrun.run.simulation_process import read_recordings
    from dxlsim.bus.ledger import Ledger
    from dxlsim.bus.recorded_bus import RecordedBus
    from dxlsim.bus.simulated_bus import SimulatedBus
    from dxlsim.faults.script import FaultScript

    ledger = Ledger(keep=False)
    try:
        recordings = read_recordings(buses)
        tried = [
            RecordedBus(bus, ledger, 0, recordings[bus.name])
            if bus.recorded
            else SimulatedBus(bus, ledger, 0)
            for bus in buses
        ]
    except ValueError as error:
        raise InputError(f"a servo cannot be simulated: {error}") from error
    FaultScript(faults, seed).attach(tried)


def link_of_each(buses: Sequence[BusConfig], link: Path | None) -> dict[str, Path]:
    """Return the path of the symbolic link to each bus' port: LINK for one bus, LINK.NAME for several; empty
    without.

    Raises InputError when a path exists and is not a link, when it leads to a simulation that runs, or when a
    link cannot be made.
    """
    if link is None:
        return {}
    names = [bus.name for bus in buses]
    links = {name: link if len(names) == 1 else link.with_name(f"{link.name}.{name}") for name in names}
    wrong = []
    if not link.parent.is_dir():
        wrong.append(f"--link {link}: directory {link.parent} not found; make it first")
    wrong += [
        f"--link {path} exists and is not a link; choose another --link"
        for path in links.values()
        if path.exists() and not path.is_symlink()
    ]
    wrong += [
        f"--link {path} leads to a simulation that runs; end that one, or choose another --link"
        for path in links.values()
        if _is_served(path)
    ]
    if wrong:
        raise InputError("\n".join(wrong))
    return {name: path.absolute() for name, path in links.items()}


def _is_served(link: Path) -> bool:
    """Return True if a link leads to the pseudo-terminal for which it was made.

    A terminal that is younger than the link got its name after the simulation was killed.
    """
    try:
        is_terminal = link.readlink().is_relative_to("/dev/pts")
        # The ctime of a terminal changes with its owner and mode, not with its data.
        return is_terminal and link.stat().st_ctime_ns <= link.lstat().st_mtime_ns
    except OSError:
        return False


def _serve(job: SimulationJob, shown: SimulationView, *, as_json: bool) -> SimulationResult:
    from dxlrun.cli.sim.sim_views import JsonView, PlainView
    from dxlrun.run.simulation_front import TypedLines, serve_simulation

    typed = TypedLines(sys.stdin.fileno())
    if as_json:
        return serve_simulation(job, JsonView(shown), typed)
    if not sys.stdout.isatty() or not typed.in_foreground:
        return serve_simulation(job, PlainView(shown), typed)
    from dxlrun.cli.sim.sim_views import TableView

    view = TableView(shown, out())
    with view.showing():
        return serve_simulation(job, view, typed)
