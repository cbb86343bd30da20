"""Tagged messages: all that processes share beside cycles and packets, one union as MessagePack.

What reports (events, commands that were taken, topics and their messages) goes through rings to the log and
to clients; commands and their answers go through the mailbox. Each is an array that its tag begins.
"""

from __future__ import annotations

from typing import TypeAlias

import msgspec

from dxlrun.channels.answers import Answered
from dxlrun.channels.commands import Command, TakenCommand
from dxlrun.channels.events import Event
from dxlrun.channels.messages import OpenedTopic, TopicMessage

Tagged: TypeAlias = Event | TakenCommand | OpenedTopic | TopicMessage | Command | Answered

_DECODER: msgspec.msgpack.Decoder[Tagged] = msgspec.msgpack.Decoder(Tagged)
decode = _DECODER.decode
"""Return the message of a record of kind TAGGED; raises ValueError when it is none."""
