"""Tagged messages: union of all records except cycles and packets, as MessagePack arrays with a leading tag.

Events, executed commands, topics and their messages go through rings to the log and to clients. Commands and
answers go through the mailbox.
"""

from __future__ import annotations

from typing import TypeAlias

import msgspec

from dxlrun.channels.answers import AnswerMessage
from dxlrun.channels.commands import CommandMessage, TakenCommand
from dxlrun.channels.event_records import Event
from dxlrun.channels.topic_messages import OpenedTopic, TopicRecord

Tagged: TypeAlias = Event | TakenCommand | OpenedTopic | TopicRecord | CommandMessage | AnswerMessage

_DECODER: msgspec.msgpack.Decoder[Tagged] = msgspec.msgpack.Decoder(Tagged)
decode = _DECODER.decode
"""Decode the payload of a record of kind TAGGED to its type. Raises ValueError for other data."""
