"""The foreign viewer reads the server of foxglove-sdk, too: the tests beside this one judge by it."""

import pytest
from tests.foxglove.foreign import ForeignViewer

foxglove = pytest.importorskip("foxglove", reason="the extra foreign brings it for Python 3.11")


def test_the_viewer_of_the_tests_reads_the_server_of_foxglove_sdk():
    from foxglove import Capability, Service, ServiceSchema

    context = foxglove.Context()
    channel = foxglove.Channel(
        "/a",
        message_encoding="cdr",
        schema=foxglove.Schema(name="T", encoding="ros2msg", data=b"int8 x"),
        context=context,
    )
    service = Service("/halt", schema=ServiceSchema("Halt"), handler=lambda request: request.payload)
    server = foxglove.start_server(
        name="robot",
        port=0,
        capabilities=[Capability.Services],
        supported_encodings=["json"],
        services=[service],
        context=context,
    )
    url = f"ws://127.0.0.1:{server.port}"
    with ForeignViewer(url, "foxglove.sdk.v1", "https://evil.example") as viewer:  # it lets each page in
        assert viewer.words("serverInfo")["name"] == "robot"
        viewer.until(lambda: viewer.channels and viewer.services)
        assert (viewer.channels["/a"]["schema"], viewer.channels["/a"]["encoding"]) == ("int8 x", "cdr")
        viewer.subscribe("/a")
        viewer.call("/halt", {"a": [1]}, 5)
        viewer.until(lambda: 5 in viewer.responses)
        assert viewer.responses[5] == {"a": [1]}
        channel.log(b"\0\1\0\0\7", log_time=1234)
        viewer.until(lambda: viewer.messages)
        assert viewer.messages == [("/a", 1234, b"\0\1\0\0\7")]
    server.stop()
