"""Topics: the names of a log's topics, and the messages in them as bytes.

Custom messages are dataclasses or msgspec structs; `messages` is a module with those of ROS 2.

    from dxlrun.tooling.topics import Codec, declared_message, messages

    codec = Codec(declared_message(messages.Header, "std_msgs").type)
    print(codec.message.text)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun import messages as messages
    from dxlrun.channels.topic_messages import MessageSink as MessageSink
    from dxlrun.channels.topic_messages import PublishedTopic as PublishedTopic
    from dxlrun.log.reading.arrow import message_struct as message_struct
    from dxlrun.log.reading.logged_topics import LoggedTopic as LoggedTopic
    from dxlrun.log.schemas import BUS_PREFIX as BUS_PREFIX
    from dxlrun.log.schemas import LogTopic as LogTopic
    from dxlrun.log.schemas import bus_topic as bus_topic
    from dxlrun.messages.cdr import ENCAPSULATION as ENCAPSULATION
    from dxlrun.messages.cdr import Codec as Codec
    from dxlrun.messages.declared import declared_message as declared_message
    from dxlrun.messages.definition import MessageType as MessageType
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
