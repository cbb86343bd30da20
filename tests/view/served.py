"""A page that is served, and what a browser would ask of it."""

import http.client
import json
import ssl
import threading
from contextlib import closing
from typing import Any

from tests.kit.awaited import DEADLINE_S

from dxlrun.remote.network.listener import Listener
from dxlrun_view.page_server import HEADER, Page, hosts_of, server_of
from dxlrun_view.shown import ViewSource


class Served:
    """A page that is served, and what a browser would ask of it."""

    def __init__(
        self, source: ViewSource, *, control: bool = False, tls: ssl.SSLContext | None = None
    ) -> None:
        self.listener = Listener("127.0.0.1", 0, tls)
        self.port = self.listener.getsockname()[1]
        self.page = Page(source, self.listener, hosts=hosts_of("127.0.0.1", self.port), control=control)
        self.browser: ssl.SSLContext | None = None
        """What a browser shows by TLS."""
        self.server = server_of(self.page)
        self._thread = threading.Thread(target=self.server.run, kwargs={"sockets": [self.listener]})
        self._thread.start()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}/?token={self.page.token}"

    def ask(self, path: str, content: object = None, **headers: str) -> tuple[int, bytes]:
        """Return status and answer; `headers` replace those of the page, bytes are sent as they are."""
        connection = (
            http.client.HTTPConnection("127.0.0.1", self.port, timeout=DEADLINE_S)
            if self.browser is None
            else http.client.HTTPSConnection("127.0.0.1", self.port, timeout=DEADLINE_S, context=self.browser)
        )
        body = content if content is None or isinstance(content, bytes) else json.dumps(content)
        given = {HEADER: self.page.token} | {name.replace("_", "-"): text for name, text in headers.items()}
        with closing(connection):
            connection.request("GET" if body is None else "POST", path, body, given)
            answer = connection.getresponse()
            return answer.status, answer.read()

    def look(self, **asked: object) -> Any:
        status, answer = self.ask("/look", asked)
        assert status == 200, answer
        return json.loads(answer)

    def close(self) -> None:
        """End it; once more does nothing."""
        self.server.should_exit = True
        self._thread.join()
        self.listener.close()
