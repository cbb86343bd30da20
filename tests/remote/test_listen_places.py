"""The value of --listen of `view` and `foxglove`: HOST:PORT, HOST or :PORT."""

from __future__ import annotations

import pytest

from dxlrun import InputError
from dxlrun.remote.network.listener import ListenAddress


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("127.0.0.1", ListenAddress("127.0.0.1", None)),
        (":9000", ListenAddress("127.0.0.1", 9000)),
        (":0", ListenAddress("127.0.0.1", 0)),
        ("lab3:9000", ListenAddress("lab3", 9000)),
        ("0.0.0.0:65535", ListenAddress("0.0.0.0", 65535)),  # noqa: S104
        ("::1", ListenAddress("::1", None)),
        ("::", ListenAddress("::", None)),
        ("fe80::1:9000", ListenAddress("fe80::1:9000", None)),
        ("[::1]", ListenAddress("::1", None)),
        ("[::1]:9000", ListenAddress("::1", 9000)),
    ],
)
def test_place_is_read_from_its_text(text: str, place: ListenAddress) -> None:
    assert ListenAddress.parse(text) == place


@pytest.mark.parametrize("text", ["", ":", ":65536", ":99999999", "lab3:", "lab3:http", "x:y:z", "[::1]9000"])
def test_text_that_is_no_place_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="write HOST:PORT, HOST or :PORT"):
        ListenAddress.parse(text)
