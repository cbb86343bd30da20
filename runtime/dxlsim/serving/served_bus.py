"""Served bus: a simulated bus that a thread of this process serves on a pseudo-terminal, for tests and
scripts."""

from __future__ import annotations

import os
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from dxlsim.bus.ledger import Ledger
from dxlsim.messages import ServoLook, SimulationMessage, SimulationRequest
from dxlsim.serving.simulation_server import Server
from dxlsim.simulation_plan import SimulationConfig
from dxlsim.texts.servo_words import bus_of_servos
from dxlwire.exceptions import InputError

ANSWER_TIMEOUT_S = 10.0
"""Timeout for an answer of the server thread, s, which has to wait for the interpreter lock."""


class LocalStarter:
    """Starter of a server in this process: requests come from any thread, messages of the server go to a
    function."""

    def __init__(self, take: Callable[[SimulationMessage], None]) -> None:
        self.closed = False
        self._take = take
        self._requests: deque[SimulationRequest] = deque()
        self._ending = False
        self._wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def fileno(self) -> int:
        """Return a descriptor that is readable after a request, and always writable."""
        return self._wake

    def queue_request(self, request: SimulationRequest) -> None:
        """Send a request to the server; any thread may call this."""
        self._requests.append(request)
        os.eventfd_write(self._wake, 1)

    def end_server(self) -> None:
        """End the server after it has answered its pending requests."""
        self._ending = True
        os.eventfd_write(self._wake, 1)

    def send_message(self, message: SimulationMessage) -> None:
        """Pass a message of the server to the function."""
        self._take(message)

    def receive_messages(self) -> Sequence[SimulationRequest]:
        """Return the new requests; called by the server."""
        with suppress(BlockingIOError):
            os.eventfd_read(self._wake)
        self.closed = self._ending
        return [self._requests.popleft() for _ in range(len(self._requests))]

    def close(self) -> None:
        """Close the descriptor; call it after the server has ended."""
        os.close(self._wake)


class ServedBus:
    """Simulated bus on a pseudo-terminal, which any program opens like a USB adapter.

    A thread serves the bus, so its replies are as punctual as the interpreter lock allows. For tests that
    measure reply times, `python -m dxlsim` serves the same bus in a process of its own.

    Attributes:
        path: The device to open, such as `/dev/pts/3`; empty while the adapter is unplugged.
        baud_rate: Baud rate of the servos, bit/s.
        protocol: 1.0 or 2.0.
        ledger: Every byte that passed the line, with its time, and a note for each fault.
    """

    def __init__(self, config: SimulationConfig) -> None:
        """Serve the single bus of a configuration.

        Raises:
            InputError: The configuration is invalid.
            OSError: The terminal or the link cannot be created.
        """
        (bus,) = config.buses
        self.baud_rate, self.protocol, self._name = bus.baud_rate, bus.protocol, bus.name
        self.ledger = Ledger()
        self.path = ""
        self._answers: queue.Queue[SimulationMessage] = queue.Queue()
        self._ready = threading.Event()  # Set when the terminal is open or the thread has failed
        self._failure: Exception | None = None
        self._closed = False
        self._starter = LocalStarter(self._handle_message)
        try:
            self._server = Server(config, self.ledger, self._starter)
        except BaseException:
            self._starter.close()
            raise
        self._thread = threading.Thread(target=self._serve, name=f"simulated bus {bus.name}", daemon=True)
        self._thread.start()
        self._ready.wait(ANSWER_TIMEOUT_S)
        self._check()

    def _serve(self) -> None:
        try:
            self._server.serve_ports()
        except Exception as error:
            self._failure = error
            self._ready.set()
            self._answers.put(SimulationMessage(error=str(error)))

    def _handle_message(self, message: SimulationMessage) -> None:
        if message.ports is not None:
            self.path = message.ports[self._name]
            self._ready.set()
        elif message.happened is None:  # The ledger already has a note of the fault
            self._answers.put(message)

    def _ask(self, request: SimulationRequest) -> SimulationMessage:
        self._starter.queue_request(request)
        message = self._answers.get(timeout=ANSWER_TIMEOUT_S)
        self._check()
        return message

    def _check(self) -> None:
        if self._failure is not None:
            raise RuntimeError(f"the simulated bus has stopped: {self._failure}") from self._failure

    def inject(self, fault: str) -> None:
        """Inject a fault, now or at its time: `silence servo=1 for=500ms`.

        Raises:
            InputError: The fault is unknown or can never happen; `dxlsim.fault_help` lists all faults.
        """
        message = self._ask(SimulationRequest(fault=fault))
        if message.error is not None:
            raise InputError(message.error)

    def snapshot_servos(self) -> tuple[ServoLook, ...]:
        """Return the present state of each servo: position, torque, temperature, error, counts of packets."""
        return self._ask(SimulationRequest(look=True)).servos or ()

    def close(self) -> None:
        """Close the pseudo-terminal; the ledger is kept. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._starter.end_server()
        self._thread.join()
        self._starter.close()
        self._check()

    def __enter__(self) -> ServedBus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def serve_bus(
    *servos: str,
    baud_rate: int | None = None,
    protocol: float | None = None,
    faults: Iterable[str] = (),
    seed: int = 0,
    link: Path | None = None,
) -> ServedBus:
    """Serve simulated servos on a pseudo-terminal until the bus is closed.

    Args:
        servos: Models with their IDs, such as `XL430-W250:1-3`.
        baud_rate: bit/s; None: the factory setting of the servos.
        protocol: 1.0 or 2.0; needed only for models that exist with both.
        faults: Lines such as `lose servo=3 at=2s`; their times count from now.
        seed: Seed of the random values of faults.
        link: Path of a symbolic link to the pseudo-terminal, which is created.

    Raises:
        InputError: A model, an ID, a rate or a fault does not fit.
        OSError: The terminal or the link cannot be created.

    Example:
        >>> with serve_bus("XL430-W250:1,2") as bus:
        ...     [(servo.id, servo.torque) for servo in bus.snapshot_servos()]
        [(1, False), (2, False)]
    """
    bus = bus_of_servos(servos, baud_rate, protocol)
    links = {} if link is None else {bus.name: str(link)}
    return ServedBus(SimulationConfig((bus,), tuple(faults), seed, links))
