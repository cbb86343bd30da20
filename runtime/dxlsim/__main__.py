"""Command `python -m dxlsim`: serves simulated servos on a pseudo-terminal, for any program that speaks
Dynamixel."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from msgspec.structs import replace

from dxlsim.bus.ledger import Ledger
from dxlsim.faults.fault import fault_help
from dxlsim.messages import SimulationMessage
from dxlsim.serving.served_bus import LocalStarter
from dxlsim.serving.simulation_server import Server, wake_on_signals
from dxlsim.simulation_plan import BusConfig, SimulationConfig
from dxlsim.texts.duration import parse_duration
from dxlsim.texts.servo_words import bus_of_servos
from dxlwire.exceptions import InputError, NotCompiled

_EXAMPLES = """\
examples:
  python -m dxlsim --servo XL430-W250:1-6 --link /tmp/ttyDXL
  python -m dxlsim --servo AX-12A:1-3 --servo MX-28:4 --protocol 1.0 --baud 1000000
  python -m dxlsim --servo XL430-W250:1 --fault "silence servo=1 at=5s for=1s" --ledger bus.jsonl
"""
_BUFFER = 1 << 16  # Write buffer of the ledger, bytes


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m dxlsim",
        description="Serve simulated Dynamixel servos on a pseudo-terminal until Ctrl-C.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add(
        "--servo",
        action="append",
        default=[],
        metavar="MODEL:IDS",
        help="servos, such as XL430-W250:1-3 or AX-12A:1,4; can be given several times",
    )
    add(
        "--baud",
        type=int,
        metavar="RATE",
        help="baud rate, bit/s; default: the factory setting of the servos",
    )
    add(
        "--protocol",
        type=float,
        metavar="1.0|2.0",
        help="protocol; required only for models available with 1.0 and 2.0",
    )
    add(
        "--link",
        type=Path,
        metavar="PATH",
        help="symbolic link to the pseudo-terminal, as a fixed name for its port",
    )
    add(
        "--fault",
        action="append",
        default=[],
        metavar="LINE",
        help='fault to inject, such as "lose servo=3 at=2s"; can be given several times',
    )
    add("--faults", action="store_true", help="list the kinds of faults, and exit")
    add(
        "--seed",
        type=int,
        default=0,
        metavar="NUMBER",
        help="seed of the random numbers of faults; default: 0",
    )
    add(
        "--ledger",
        type=Path,
        metavar="FILE",
        help="new file for the ledger, JSON lines: every byte on the bus with its time, and every fault",
    )
    add(
        "--latency-timer",
        metavar="TIME",
        help='latency timer of the adapter, such as "4 ms"; default: none',
    )
    return parser


def main(words: Sequence[str] | None = None) -> int:
    """Serve simulated servos as the command line describes until SIGINT or SIGTERM; return the exit code.

    Returns:
        0; 1 if the ledger is incomplete after a write error; 2 if the arguments are wrong.
    """
    parser = _parser()
    given = parser.parse_args(words)
    if given.faults:
        print("\n".join(fault_help()))
        return 0
    if not given.servo:
        parser.error("--servo is missing; give servos such as --servo XL430-W250:1-3")
    try:
        bus = _with_latency(bus_of_servos(given.servo, given.baud, given.protocol), given.latency_timer)
        links = {} if given.link is None else {bus.name: str(given.link)}
        config = SimulationConfig((bus,), tuple(given.fault), given.seed, links)
        with (
            wake_on_signals(signal.SIGINT, signal.SIGTERM) as wake,  # until the ledger is written
            Ledger(_open_ledger(given.ledger), keep=False) as ledger,
        ):
            _serve(config, ledger, stop=wake.fileno())
    except (InputError, NotCompiled, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    if ledger.error is not None:
        print(ledger.error, file=sys.stderr)
        return 1
    return 0


def _open_ledger(path: Path | None) -> IO[bytes] | None:
    try:
        return None if path is None else path.open("xb", _BUFFER)
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror}); choose another --ledger") from None


def _with_latency(bus: BusConfig, text: str | None) -> BusConfig:
    if text is None:
        return bus
    try:
        timer_ns = parse_duration(text)
    except ValueError as error:
        raise InputError(f"--latency-timer: {error}; write a time such as 4 ms") from None
    return replace(bus, adapter=replace(bus.adapter, latency_timer_ns=timer_ns))


def _serve(config: SimulationConfig, ledger: Ledger, *, stop: int) -> None:
    (bus,) = config.buses
    link = config.links.get(bus.name)

    def show_ports(message: SimulationMessage) -> None:
        if message.ports is not None:
            path = message.ports[bus.name]
            where = f"{link} -> {path}" if link and path else path or "the adapter is unplugged"
            print(f"{where}: {_text_of(bus)}; Ctrl-C ends it", flush=True)
        if message.happened is not None:
            print(f"fault: {message.happened}", flush=True)

    Server(config, ledger, LocalStarter(show_ports)).serve_ports(stop=stop)


def _text_of(bus: BusConfig) -> str:
    models: dict[str, list[str]] = {}
    for servo in bus.servos:
        models.setdefault(servo.model, []).append(str(servo.servo_id))
    servos = "; ".join(f"{model} {', '.join(ids)}" for model, ids in models.items())
    return f"{servos} at {bus.baud_rate} bit/s, Protocol {bus.protocol:.1f}"


if __name__ == "__main__":
    with suppress(BrokenPipeError):
        sys.exit(main())
    os._exit(1)  # The reader of the output has exited
