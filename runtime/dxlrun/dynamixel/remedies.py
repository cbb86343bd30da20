"""Remedies: instructions to the user for late and missing replies of servos.

Start-up, the cycle, tools, the end of a run and the analysis of a log share these rules. A machine that was
too busy is named first. For simulated servos no hardware check is suggested. A cause is named only on direct
evidence.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from dxlrun.plan.machine_load import MachineLoad
from dxlwire.exceptions import counted, help_link
from dxlwire.port.latency_timer import SYSTEM, fix, is_simulated, is_timer, latency_timer

CHECK = "check its cable and power"
INJECTED = "check the faults injected into the simulation"
_IDLE = MachineLoad()


def choose_remedy(
    port: str, hardware: str = CHECK, *, simulated: str = INJECTED, load: MachineLoad = _IDLE
) -> str:
    """Return the remedy for late or missing replies on a bus, in the imperative and without a full stop.

    Args:
        port: Port of the bus, as in the robot file.
        hardware: Remedy for real servos on an idle machine, such as "check its cable and power".
        simulated: Remedy for simulated servos on an idle machine.
        load: Load of the machine at that time, as far as it is known.

    Example:
        >>> choose_remedy("sim", "check its cable and power")
        'check the faults injected into the simulation'
    """
    if load.too_busy:
        return free_machine((port,))
    return simulated if is_simulated(port) else hardware


def free_machine(ports: Iterable[str]) -> str:
    """Return the instruction for a machine that was too busy: end other programs. It adds `--virtual` if one
    of the ports is simulated.
    """
    virtual = ", or use --virtual" if any(map(is_simulated, ports)) else ""
    return f"end other programs{virtual}"


def late_replies(
    bus: str, port: str, extra_ns: float, planned_ns: float, load: MachineLoad = _IDLE
) -> tuple[str, str]:
    """Return (observation, remedy) for a bus whose replies usually come later than planned.

    Both have no full stop; the remedy is empty if none is known. A delay that looks like the default latency
    timer of an FTDI adapter is named, unless the bus is simulated or the machine was too busy.

    Args:
        bus: Name of the bus.
        port: Its port, as in the robot file.
        extra_ns: Delay of the replies beyond the time on the wire and the return delay.
        planned_ns: Time that was planned for the adapter.
        load: Load of the machine at that time, as far as it is known.
    """
    observed = (
        f"replies on bus {bus} are delayed by {extra_ns / 1e6:.1f} ms (planned for the adapter: "
        f"{planned_ns / 1e6:g} ms)"
    )
    if load.too_busy:
        return observed, choose_remedy(port, "", load=load)
    if not is_timer(extra_ns) or is_simulated(port):
        return observed, ""
    name = Path(port).name
    device = name if name.startswith("ttyUSB") else f"$(basename $(readlink -f {port}))"
    command = fix(f"/sys/bus/usb-serial/devices/{device}/latency_timer")
    return f"{observed}, probably by a latency timer of 16 ms", f"`{command}` shortens it"


def describe_late_start(
    bus: str, port: str, late_ns: Sequence[int], planned_ns: int, system: Path = SYSTEM
) -> str:
    """Return a sentence about the late replies of a bus at start-up, without a full stop.

    The sentence reports the observation. It names the adapter's latency timer if the kernel reports that the
    timer is longer than planned.

    Args:
        bus: Name of the bus.
        port: Its port, as in the robot file.
        late_ns: Delay of each reply beyond the time on the wire and the return delay.
        planned_ns: Time that was planned for the adapter.
        system: Directory in which the kernel lists its devices, for tests.
    """
    late = [each for each in late_ns if each > planned_ns]
    total, most_ms = counted(len(late_ns), "reply", "replies"), max(late, default=0) / 1e6
    observed = (
        f"{len(late)} of {total} on bus {bus} were delayed by up to {most_ms:.0f} ms (planned for the "
        f"adapter: {planned_ns / 1e6:g} ms)"
    )
    timer = None if is_simulated(port) else latency_timer(port, system)
    if timer is None or timer.found_ms * 1_000_000 <= planned_ns:
        return observed
    link = help_link("replies-come-late")
    timed = f"the adapter's latency timer is {timer.found_ms} ms: shorten it with `{timer.fix}`"
    return f"{observed}; {timed}; {link}"
