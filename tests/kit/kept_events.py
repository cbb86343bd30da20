"""Events that parts under test emit, kept in a list."""

from __future__ import annotations

from dataclasses import dataclass, field

from dxlrun.channels.event_records import EventBody, EventCode, Severity


@dataclass
class Events:
    """Takes events and keeps them: code, severity, source and text; their data apart."""

    data: list[tuple[EventCode, bytes]] = field(default_factory=list)
    list: list[tuple[EventCode, Severity, str, str]] = field(default_factory=list)

    def emit_event(self, source: str, event: EventBody, data: bytes = b"") -> None:
        self.list.append((event.code, event.severity, source, event.text))
        self.data.append((event.code, data))

    def of(self, code: EventCode) -> list[tuple[str, str]]:
        return [(source, text) for kind, _, source, text in self.list if kind == code]

    def texts(self, code: EventCode) -> list[str]:
        return [text for _, text in self.of(code)]

    def sources(self, code: EventCode) -> list[str]:
        return [source for source, _ in self.of(code)]

    def data_of(self, code: EventCode) -> list[bytes]:
        return [data for kind, data in self.data if kind == code]
