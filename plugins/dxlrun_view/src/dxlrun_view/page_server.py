"""Web server of `dxlrun view`: a separate process on 127.0.0.1 that only serves the user's own browser.

Each request must have a host name of this server (which prevents DNS rebinding), an origin of this page if it
has an origin, and the token of the page's address. STOP works without `--control`. On an address that is not
local, both ends need a certificate of `dxlrun keys`, and the role in the browser's certificate decides if it
may steer.
"""

from __future__ import annotations

import secrets
import socket
from collections.abc import Awaitable, Callable, Mapping
from contextlib import contextmanager
from importlib.resources import files
from ipaddress import IPv4Address
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import msgspec
import uvicorn
from msgspec.json import Decoder
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from dxlrun import DxlrunError, InputError
from dxlrun.tooling.live import Listener, Role, in_url, serve_clients
from dxlrun_view.actions import Action, ParameterListAction, perform_action
from dxlrun_view.curves import Curve, Moment
from dxlrun_view.shown import LiveEvent, SourceProperties, ViewSource, describe_error

if TYPE_CHECKING:
    from collections.abc import Iterator

PORT = 8765
ANY = str(IPv4Address(0))
"""Address 0.0.0.0, at which the server listens on all interfaces of this computer"""
HEADER = "X-Dxlrun-Token"
"""HTTP header in which the page's script sends the token of the page's address"""
MOST_POINTS = 4000
"""Largest number of points of a curve in a response"""
MOST_CURVES = 64
"""Largest number of curves of a plot in a response; further ones are omitted"""
MOST_BYTES = 1 << 16
"""Largest size of a request body, bytes"""
_TYPES = {"": "text/html", "page.js": "text/javascript", "page.css": "text/css"}
_SECURITY = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_MESHES = (".stl", ".dae", ".obj")


class Span(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Part of a `ViewRequest`: curves and span of time of one plot"""

    names: tuple[str, ...]
    """Names of the curves"""
    begin: float
    """First time, s on the clock of the curves"""
    end: float
    points: int = 600
    """Number of points to which each curve is downsampled"""


class ViewRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Request of the page's script for new data, sent at about 25 Hz"""

    time: float | None = None
    """Position of the time line of a log, s; None for the newest moment"""
    after: int = 0
    """Number of the last event that the page has; the response has those after it"""
    shown: bool = False
    """True if the page also requests the properties that rarely change"""
    spans: tuple[Span, ...] = ()
    """One for each plot"""


class ViewResponse(msgspec.Struct, frozen=True):
    """Response to a page's request `ViewRequest`: new data of the robot or the log"""

    moment: Moment
    """Values of all columns at the requested time"""
    events: tuple[LiveEvent, ...]
    """Events that the page does not have yet"""
    curves: tuple[tuple[Curve, ...], ...]
    """Curves of each plot"""
    shown: SourceProperties | None = None
    """Properties that rarely change; None if not requested"""
    errors: Mapping[str, str] = {}
    """Hardware errors in words, for each joint that has one"""


_LOOK: Decoder[ViewRequest] = Decoder(ViewRequest)
_ACTION: Decoder[Action] = Decoder(Action)
Message = TypeVar("Message")
Handler = Callable[[Request], Awaitable[Response]]


class Page:
    """Web application of `dxlrun view`, which shows one robot or one log to the browsers with its token"""

    def __init__(
        self, source: ViewSource, listener: Listener, *, hosts: tuple[str, ...], control: bool = False
    ) -> None:
        """Create the token of the page.

        Args:
            source: Robot or log.
            listener: Socket of the server.
            hosts: Host names of this server with its port, as browsers send them.
            control: Allow actions other than STOP.
        """
        self.source, self.control, self.listener = source, control, listener
        self.token = secrets.token_urlsafe(16)
        self._hosts = frozenset(hosts)
        self._origins = (None, *(f"{scheme_of(listener)}://{host}" for host in hosts))

    def app(self) -> Starlette:
        """Return the ASGI application with the paths of the page, its data and its actions."""
        return Starlette(
            routes=[
                Route("/", self._guarded(self.page)),
                Route("/page.js", self._guarded(self.page)),
                Route("/page.css", self._guarded(self.page)),
                Route("/look", self._guarded(self.serve_data, token=True), methods=["POST"]),
                Route("/act", self._guarded(self.handle_action, token=True), methods=["POST"]),
                Route("/urdf", self._guarded(self.serve_urdf, token=True)),
                Route("/mesh", self._guarded(self.mesh, token=True)),
            ]
        )

    def _guarded(self, handler: Handler, *, token: bool = False) -> Handler:
        async def answer_request(request: Request) -> Response:
            host = request.headers.get("host", "")
            origin = request.headers.get("origin")
            if host not in self._hosts or origin not in self._origins:
                return _refused(403, "this page accepts requests only from itself, not from other web sites")
            given = request.headers.get(HEADER, "")
            if token and not secrets.compare_digest(given.encode(), self.token.encode()):
                return _refused(401, "invalid token; open the address printed by `dxlrun view`")
            if token and request.client and self.listener.tls is None:
                self.listener.admit(request.client)
            try:
                response = await handler(request)
            except (DxlrunError, OSError) as error:  # OSError: a mesh is not readable
                response = _refused(409, str(error))
            response.headers.update(_SECURITY)
            return response

        return answer_request

    async def page(self, request: Request) -> Response:
        """Return page.html, page.js or page.css, which need no token: only the script's requests have it."""
        name = request.url.path.strip("/")
        where = files("dxlrun_view").joinpath("page", *(("build", name) if name else ("page.html",)))
        if not where.is_file():
            return _refused(
                404, "the page has no bundle; install it again: pip install ./plugins/dxlrun_view"
            )
        content = where.read_bytes()
        if not name:  # The page needs the kind of source before its first request has an answer.
            kind = b"live" if self.source.describe_page().live else b"log"
            content = content.replace(b'data-opens=""', b'data-opens="%s"' % kind)
        return Response(content, media_type=_TYPES[name])

    async def serve_data(self, request: Request) -> Response:
        """Answer a `ViewRequest` of the page with a `ViewResponse`: moment, events, curves."""
        asked = await _message(request, _LOOK)
        return _json(await run_in_threadpool(self._seen, asked, self._may_steer(request)))

    def _seen(self, asked: ViewRequest, may_steer: bool) -> ViewResponse:
        moment = self.source.moment_at(asked.time)
        found = self.source.describe_page()
        shown = msgspec.structs.replace(found, control=may_steer) if asked.shown else None
        return ViewResponse(
            moment,
            self.source.events(asked.after),
            tuple(self._curves(span) for span in asked.spans),
            shown,
            _hardware_errors(found, moment),
        )

    def _curves(self, span: Span) -> tuple[Curve, ...]:
        found: list[Curve] = []
        for name in span.names[:MOST_CURVES]:
            try:
                found.append(self.source.curve(name, span.begin, span.end, min(span.points, MOST_POINTS)))
            except KeyError:
                found.append(Curve(name, [], []))
        return tuple(found)

    async def serve_urdf(self, request: Request) -> Response:
        """Return the robot's URDF, or an empty body if it has none."""
        return Response(await run_in_threadpool(self.source.urdf), media_type="application/xml")

    async def mesh(self, request: Request) -> Response:
        """Return the file of a mesh that the URDF names, searched from the directory of the robot file."""
        name = request.query_params.get("name", "")
        path = await run_in_threadpool(self._mesh, name)
        if path is None:
            return _refused(404, f"mesh {name} not found next to the robot file")
        return Response(path.read_bytes(), media_type="application/octet-stream")

    def _mesh(self, name: str) -> Path | None:
        """Return the path of a mesh file, or None if it does not exist or the URDF does not name it."""
        if self.source.folder is None or f'"{name}"' not in self.source.urdf():
            return None
        found = mesh_file(self.source.folder, name)
        return found if found is not None and found.suffix.lower() in _MESHES else None

    async def handle_action(self, request: Request) -> Response:
        """Perform an action of the page. Without `--control`, only STOP and listing parameters are allowed.

        A browser with the role observe may only list parameters.
        """
        action = await _message(request, _ACTION)
        if not isinstance(action, ParameterListAction) and self._role(request) < Role.COMMAND:
            return _refused(
                403, "this browser's certificate has the role observe; use one with the role command"
            )
        if not action.always and not self.control:
            return _refused(403, "this page is read-only; start `dxlrun view --control` to control the robot")
        return _json(await run_in_threadpool(perform_action, self.source, action))

    def _may_steer(self, request: Request) -> bool:
        return self.control and self._role(request) >= Role.COMMAND

    def _role(self, request: Request) -> Role:
        """Return the role in a browser's certificate. A browser without TLS is local, and has all rights."""
        if self.listener.tls is None:
            return Role.ADMIN
        role: Role = request.scope["client"].role
        return role


def _hardware_errors(found: SourceProperties, moment: Moment) -> dict[str, str]:
    """Return the hardware errors of joints at a moment in words; joints without an error are omitted."""
    values = dict(zip(found.columns, moment.values, strict=False))  # no values before the first cycle
    errors = {name: int(values.get(f"{name}/hardware_error") or 0) for name in found.info.joints}
    servos = found.info.servos
    return {name: describe_error(servos.get(name), value) for name, value in errors.items() if value}


def mesh_file(folder: Path, name: str) -> Path | None:
    """Find the file of a mesh that a URDF names, or return None; `folder` is that of the robot file.

    `package://NAME/...` is searched in that directory and in all of its parents. Without NAME, it is searched
    in that directory and two of its parents.
    """
    if name.startswith("package://"):
        relative = Path(name.removeprefix("package://"))
        places = [above / relative for above in (folder, *folder.parents)]
        places += [above.joinpath(*relative.parts[1:]) for above in (folder, *folder.parents[:2])]
    else:
        places = [folder / name.removeprefix("file://"), folder / "urdf" / name]
    return next((place for place in places if place.is_file()), None)


def scheme_of(listener: Listener) -> str:
    """Return the URL scheme of a page: https if the listener has TLS, else http."""
    return "http" if listener.tls is None else "https"


def hosts_of(address: str, port: int, *others: str) -> tuple[str, ...]:
    """Return the host names with port under which a browser can reach a server.

    Args:
        address: Address of the listener.
        port: Port of the listener.
        others: Names in the certificate of the server.
    """
    names = [*others]
    if address in ("127.0.0.1", "localhost", ANY):
        names += ["localhost", "127.0.0.1"]
    if address == ANY:
        names.append(socket.gethostname())
        names += [str(one[4][0]) for one in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)]
    return tuple(f"{in_url(name)}:{port}" for name in dict.fromkeys([*names, address]))


class ViewServer(uvicorn.Server):
    """uvicorn server without signal handlers. A listener with TLS accepts its own connections."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to serve the sockets that were given to `run`."""
        secured = [one for one in sockets or () if isinstance(one, Listener) and one.tls]
        for listener in secured:
            await serve_clients(listener, self.config, self.server_state)
        await super().startup([one for one in sockets or () if one not in secured])

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Install no signal handlers: the command `view` has its own."""
        yield


def server_of(page: Page) -> ViewServer:
    """Return a web server for a page; its `run(sockets=[...])` serves until `should_exit` is set."""
    config = uvicorn.Config(
        page.app(),
        ws="none",
        lifespan="off",
        log_config=None,
        log_level="critical",
        access_log=False,
        proxy_headers=False,
        server_header=False,
        timeout_graceful_shutdown=1,
    )
    return ViewServer(config)


async def _message(request: Request, decoder: Decoder[Message]) -> Message:
    """Decode the JSON body of a request. Raises InputError if it is invalid or exceeds MOST_BYTES."""
    data = b""
    async for piece in request.stream():
        data += piece
        if len(data) > MOST_BYTES:
            raise InputError(f"the request exceeds {MOST_BYTES} bytes")
    try:
        return decoder.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InputError(f"invalid request: {error}") from error


def _json(content: object) -> Response:
    return Response(msgspec.json.encode(content), media_type="application/json")


def _refused(status: int, why: str) -> Response:
    content: Mapping[str, str] = {"refused": why}
    return Response(msgspec.json.encode(content), status, _SECURITY, "application/json")
