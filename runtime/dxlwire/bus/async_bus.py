"""Asyncio bus: the same servos for an asyncio program. The event loop waits for the replies."""

from __future__ import annotations

import asyncio
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dxlwire.bus.blocking_bus import RATE
from dxlwire.bus.kernel_exchange import Reading
from dxlwire.bus.programs import Addressed, Failures, find_ids, identify
from dxlwire.bus.sdk_exchange import SdkReading
from dxlwire.bus.servo_group import ServoGroup, Switch, Values, found_group, named_servos
from dxlwire.bus.servo_rows import ServoStates, WrittenRows
from dxlwire.bus.session import SdkSession, Session, open_session
from dxlwire.exceptions import ServoError
from dxlwire.exchange.arrays import Floats
from dxlwire.exchange.bus_engine import NEVER
from dxlwire.transaction import Program, ProgramJob, Result


class _Waiting(ABC):
    """A session whose replies an asyncio program awaits, one call at a time; base class of two ways."""

    def __init__(self, session: Session | SdkSession) -> None:
        self.session = session
        self.lock = asyncio.Lock()

    @abstractmethod
    async def run_program(self, program: Program[Result]) -> Result:
        """Run a program to its end and return its result. Raises PortError if the line is closed or lost."""

    @abstractmethod
    async def read_servos(self, reading: Reading | SdkReading) -> None:
        """Read every item of a reader once. Raises PortError if the line is closed or lost."""


class _InEventLoop(_Waiting):
    """The event loop waits for the line, without a thread. The parser reads, not the kernel, because the
    kernel would wait itself."""

    session: Session

    async def run_program(self, program: Program[Result]) -> Result:
        """Run a program to its end and return its result. Raises PortError if the line is closed or lost."""
        session = self.session
        async with self.lock:
            session.check_open()
            job = ProgramJob(program)
            with session.uninterrupted():
                session.engine.load_job(job, waits=True)
                session.lines.discard_input(session.lines.buses)
                await self._pump()
            return session.finish_program(job.result)

    async def read_servos(self, reading: Reading | SdkReading) -> None:
        """Read every item of a reader once. Raises PortError if the line is closed or lost."""
        assert isinstance(reading, Reading)  # noqa: S101  `make_reading` made it for this session
        session = self.session
        async with self.lock:
            session.check_open()
            reading.begin_cycle(kernel=False)
            try:
                with session.uninterrupted():
                    await self._pump()
            finally:
                reading.end_cycle()  # Also of a cancelled call
            session.log.commit_packets()
            session.check_open()

    async def _pump(self) -> None:
        """Execute the loaded job of the line."""
        engine, lines = self.session.engine, self.session.lines
        deadline_ns = engine.process_due(engine.now_ns())
        while deadline_ns != NEVER:  # A cancelled call leaves its job, which the next one drops
            await self._wait_readable(deadline_ns)
            ready = lines.ports.wait_for_bytes(0)
            deadline_ns = engine.read_and_process() if ready else engine.process_due(engine.now_ns())

    async def _wait_readable(self, deadline_ns: int) -> None:
        descriptors = self.session.lines.ports.descriptors
        if descriptors is None:  # Virtual time
            self.session.lines.ports.wait_for_bytes(deadline_ns)
            await asyncio.sleep(0)
            return
        loop = asyncio.get_running_loop()
        ready = asyncio.Event()
        loop.add_reader(descriptors[0], ready.set)
        try:
            left_s = max(0, deadline_ns - self.session.engine.now_ns()) * 1e-9
            await asyncio.wait_for(ready.wait(), left_s)
        except TimeoutError:
            pass
        finally:
            loop.remove_reader(descriptors[0])


class _InThread(_Waiting):
    """One thread for the bus waits for the line: dynamixel-sdk does not know event loops."""

    session: SdkSession

    def __init__(self, session: SdkSession) -> None:
        super().__init__(session)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=f"dxlwire {session.name}")

    async def run_program(self, program: Program[Result]) -> Result:
        """Run a program to its end and return its result. Raises PortError if the line is closed or lost."""
        run_program = partial(self.session.run_program, program)
        return await asyncio.get_running_loop().run_in_executor(self._thread, run_program)

    async def read_servos(self, reading: Reading | SdkReading) -> None:
        """Read every item of a reader once. Raises PortError if the line is closed or lost."""
        await asyncio.get_running_loop().run_in_executor(self._thread, reading.read_servos)


def _waiting_for(session: Session | SdkSession) -> _Waiting:
    return _InThread(session) if isinstance(session, SdkSession) else _InEventLoop(session)


class AsyncBus:
    """A serial line with servos for an asyncio program; an async context manager. See `Bus`."""

    def __init__(
        self, port: str, baud_rate: int = RATE, protocol: float = 2.0, *, limp_at_exit: bool = False
    ) -> None:
        """Open a line; the arguments and errors are those of `Bus`."""
        self._waiting = _waiting_for(open_session(port, baud_rate, protocol))
        self._limp_at_exit = limp_at_exit
        self._groups: list[ServoGroup] = []

    @classmethod
    def on_session(cls, session: Session, *, limp_at_exit: bool = False) -> AsyncBus:
        """Return a bus on a line that is open already, such as a simulated one on virtual time."""
        bus = cls.__new__(cls)
        bus._waiting = _waiting_for(session)
        bus._limp_at_exit, bus._groups = limp_at_exit, []
        return bus

    async def __aenter__(self) -> AsyncBus:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the line, see `Bus.close`."""
        groups, self._groups = self._groups, []
        failures: Failures = {}
        session = self._waiting.session
        try:
            for group in groups if self._limp_at_exit else ():
                failures |= await self._waiting.run_program(group.switch_all(False))
        finally:
            session.close()
        if failures:
            raise ServoError(session.name, failures)

    async def reopen(self) -> None:
        """Open the line again after its adapter was unplugged, see `Bus.reopen`."""
        async with self._waiting.lock:
            self._waiting.session.reopen_line()

    def record(self, path: str | os.PathLike[str]) -> None:
        """Record all packets from now on in a new log, see `Bus.record`."""
        self._waiting.session.record(Path(path))

    async def scan(self, ids: Iterable[int] | None = None) -> AsyncServoSet:
        """Find the servos that answer at this baud rate, see `Bus.scan`."""
        session = self._waiting.session
        looked_for = range(session.line.dialect.HIGHEST_ID + 1) if ids is None else ids
        there = await self._waiting.run_program(
            find_ids(session.line, list(looked_for), session.log.answered)
        )
        found = await self._waiting.run_program(identify(session.line, dict.fromkeys(there)))
        return self._use(found)

    async def servos(self, models: Mapping[int, str]) -> AsyncServoSet:
        """Return servos by ID and model, see `Bus.servos`."""
        session = self._waiting.session
        return self._use(await self._waiting.run_program(named_servos(session, models)))

    def _use(self, found: tuple[list[Addressed], Failures]) -> AsyncServoSet:
        group = found_group(self._waiting.session, found)
        self._groups.append(group)
        return AsyncServoSet(self._waiting, group)


class AsyncServoSet:
    """Servos of an asyncio bus, see `ServoSet`."""

    def __init__(self, waiting: _Waiting, group: ServoGroup) -> None:
        self._waiting = waiting
        self._group = group

    @property
    def ids(self) -> tuple[int, ...]:
        """IDs of the servos."""
        return self._group.ids

    @property
    def models(self) -> tuple[str, ...]:
        """Models of the servos."""
        return self._group.models

    def __getitem__(self, ids: int | Sequence[int]) -> AsyncServoSet:
        return AsyncServoSet(self._waiting, self._group.part(ids))

    def __iter__(self) -> Iterator[int]:
        return iter(self.ids)

    def __len__(self) -> int:
        return len(self.ids)

    async def read(self, item: str, *, raw: bool = False) -> Floats:
        """Read an item of every servo once, see `ServoSet.read`."""
        values, failures = await self._waiting.run_program(self._group.read_values(item, raw=raw))
        self._group.raise_failures(failures)
        return values

    async def write(self, item: str, value: Values, *, raw: bool = False) -> None:
        """Write an item of every servo once, see `ServoSet.write`."""
        self._group.raise_failures(
            await self._waiting.run_program(self._group.write_values(item, value, raw=raw))
        )

    async def torque(self) -> NDArray[np.bool_]:
        """Return True for each servo that has torque."""
        return (await self.read("torque_enable")).astype(np.bool_)

    async def switch_torque(self, on: Switch) -> None:
        """Switch torque on or off; before it is switched on, goals become the present positions."""
        self._group.raise_failures(await self._waiting.run_program(self._group.switch_all(on)))

    def reader(self, *items: str, raw: bool = False) -> AsyncServoReader:
        """Prepare to read items again and again, see `ServoSet.reader`."""
        reading = self._group.make_reading(items, raw=raw)
        return AsyncServoReader(self._waiting, reading)

    def writer(self, *items: str, raw: bool = False) -> AsyncServoWriter:
        """Prepare to write items in RAM again and again, see `ServoSet.writer`."""
        writing = self._group.make_writing(items, raw=raw)
        return AsyncServoWriter(self._waiting, writing)


class AsyncServoReader:
    """Reads the same items of the same servos in each call."""

    def __init__(self, waiting: _Waiting, reading: Reading | SdkReading) -> None:
        self._waiting = waiting
        self._reading = reading

    async def __call__(self) -> ServoStates:
        """Read all items of all servos, see `ServoReader`."""
        await self._waiting.read_servos(self._reading)
        return self._reading.newest_state()


class AsyncServoWriter:
    """Writes the same items of the same servos in each call."""

    def __init__(self, waiting: _Waiting, writing: WrittenRows) -> None:
        self._waiting = waiting
        self._writing = writing

    async def __call__(self, *values: ArrayLike) -> None:
        """Send the values, see `ServoWriter`."""
        async with self._waiting.lock:
            self._writing.send_values(values)
