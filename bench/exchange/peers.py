"""Peers: the maker's SDK and rustypot, each as one class that exchanges with all servos in one call.

They use the same registers as we do, by the quickest calls they have for that [i]: groups of the SDK,
raw addresses of rustypot. Protocol 1.0 has no sync read and an AX no bulk read: there they read one by one.
In Protocol 2.0 both can use sync read, and fast sync read as an option.
Each ends with what a program works with, integers of position, velocity and effort, and begins with integers
of goals; ours has SI units at both ends. With `values=False` they leave the bytes as they are.
"""

from __future__ import annotations

from dxlrun.errors import InputError
from dxlrun_lab.late_servos import Sent
from exchange.case import Case, Registers

TIMEOUT_S = 1.0
"""rustypot waits so long for a reply; the SDK has a time of its own."""


class Sdk:
    """The groups of dynamixel-sdk."""

    def __init__(self, path: str, case: Case, registers: Registers, *, values: bool, fast: bool) -> None:
        import dynamixel_sdk as sdk

        self._good = sdk.COMM_SUCCESS
        self._ids, self._registers, self._values = case.ids, registers, values
        self._port = sdk.PortHandler(path)
        if not self._port.setBaudRate(case.baud_rate):
            raise InputError(f"dynamixel-sdk does not know the rate {case.baud_rate} bit/s")
        self._packets = sdk.PacketHandler(case.protocol)
        self._read = sdk.GroupSyncRead(
            self._port, self._packets, registers.read_address, registers.read_length
        )
        self._write = sdk.GroupSyncWrite(
            self._port, self._packets, registers.write_address, registers.write_length
        )
        for each in case.ids:
            self._read.addParam(each)
            self._write.addParam(each, [0] * registers.write_length)
        self._turn = 0
        self._prepared = [self._goal(tick) for tick in registers.ticks]
        self._ask = self._one_by_one if case.protocol == 1.0 else self._together
        self._exchange = self._read.fastSyncRead if fast else self._read.txRxPacket
        self.positions: list[int] = []

    def start(self) -> None:
        """Nothing is needed."""

    def exchange(self) -> bool:
        """Read by a group, or one by one; write by a group."""
        good = self._ask()
        self._turn = 1 - self._turn
        tick, prepared = self._registers.ticks[self._turn], self._prepared[self._turn]
        for each in self._ids:
            self._write.changeParam(each, self._goal(tick) if self._values else prepared)
        return bool(self._write.txPacket() == self._good) and good

    def recover(self) -> None:
        """Throw away what is left, and exchange."""
        self._port.clearPort()
        self.exchange()

    def sent(self) -> Sent:
        """Nothing is known."""
        return ()

    def close(self) -> None:
        """Close the line."""
        self._port.closePort()

    def _goal(self, tick: int) -> list[int]:
        """Put a goal into the bytes that are written, as the SDK's examples do, byte by byte."""
        offset, size = self._registers.goal
        goal = [0] * self._registers.write_length
        goal[offset : offset + size] = [tick >> 8 * place & 0xFF for place in range(size)]
        return goal

    def _together(self) -> bool:
        good = bool(self._exchange() == self._good)
        if good and self._values:
            get, start = self._read.getData, self._registers.read_address
            self.positions = [
                get(each, start + offset, size)
                for each in self._ids
                for offset, size in self._registers.values
            ]
        return good

    def _one_by_one(self) -> bool:
        good = True
        values: list[int] = []
        registers = self._registers
        for each in self._ids:
            data, result, _ = self._packets.readTxRx(
                self._port, each, registers.read_address, registers.read_length
            )
            if result != self._good:
                good = False
            elif self._values:
                values += [
                    int.from_bytes(data[offset : offset + size], "little")
                    for offset, size in registers.values
                ]
        self.positions = values
        return good


class Rustypot:
    """rustypot's raw-address calls."""

    def __init__(self, path: str, case: Case, registers: Registers, *, values: bool, fast: bool) -> None:
        import rustypot

        self._bus: rustypot.AxPyController | rustypot.Xl430PyController
        if case.protocol == 1.0:
            self._bus = rustypot.AxPyController(path, case.baud_rate, TIMEOUT_S)
        else:
            self._bus = rustypot.Xl430PyController(path, case.baud_rate, TIMEOUT_S)
            self._bus.set_fast_sync_read(fast)
        self._ids, self._registers, self._values = list(case.ids), registers, values
        self._turn = 0
        self._prepared = [self._goals(tick) for tick in registers.ticks]
        self._ask = self._one_by_one if case.protocol == 1.0 else self._together
        self.positions: list[int] = []

    def start(self) -> None:
        """Nothing is needed."""

    def exchange(self) -> bool:
        """Read in one call, or one by one; write in one call."""
        try:
            self._ask()
            self._turn = 1 - self._turn
            goals = self._prepared[self._turn]
            if self._values:
                goals = self._goals(self._registers.ticks[self._turn])
            self._bus.sync_write_raw_data(self._ids, self._registers.write_address, goals)
        except RuntimeError:  # what it raises for a lost reply
            return False
        return True

    def recover(self) -> None:
        """Exchange; it throws away what is left by itself."""
        self.exchange()

    def sent(self) -> Sent:
        """Nothing is known."""
        return ()

    def close(self) -> None:
        """Close the line."""
        self._bus.close()

    def _goals(self, tick: int) -> list[bytes]:
        offset, size = self._registers.goal
        before, after = bytes(offset), bytes(self._registers.write_length - offset - size)
        return [before + tick.to_bytes(size, "little") + after for _ in self._ids]

    def _together(self) -> None:
        registers = self._registers
        data = self._bus.sync_read_raw_data(self._ids, registers.read_address, registers.read_length)
        if self._values:
            self._take(data)

    def _one_by_one(self) -> None:
        read, address, length = (
            self._bus.read_raw_data,
            self._registers.read_address,
            self._registers.read_length,
        )
        data = [read(each, address, length) for each in self._ids]
        if self._values:
            self._take(data)

    def _take(self, data: list[list[int]]) -> None:
        self.positions = [
            int.from_bytes(one[offset : offset + size], "little")
            for one in data
            for offset, size in self._registers.values
        ]
