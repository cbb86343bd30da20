"""The value of --listen of `view` and `foxglove`: HOST:PORT, HOST or :PORT."""

from __future__ import annotations

import pytest

from dxlrun import InputError
from dxlrun.remote.network.listener import Place


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("127.0.0.1", Place("127.0.0.1", None)),
        (":9000", Place("127.0.0.1", 9000)),
        (":0", Place("127.0.0.1", 0)),
        ("lab3:9000", Place("lab3", 9000)),
        ("0.0.0.0:65535", Place("0.0.0.0", 65535)),  # noqa: S104
        ("::1", Place("::1", None)),
        ("::", Place("::", None)),
        ("fe80::1:9000", Place("fe80::1:9000", None)),
        ("[::1]", Place("::1", None)),
        ("[::1]:9000", Place("::1", 9000)),
    ],
)
def test_place_is_read_from_its_text(text: str, place: Place) -> None:
    assert Place.parse(text) == place


@pytest.mark.parametrize("text", ["", ":", ":65536", ":99999999", "lab3:", "lab3:http", "x:y:z", "[::1]9000"])
def test_text_that_is_no_place_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="write HOST:PORT, HOST or :PORT"):
        Place.parse(text)
