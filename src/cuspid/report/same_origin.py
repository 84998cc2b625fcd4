"""Who may talk to a server on this machine: pages that it served itself, not any page that a browser has open.

A page of another site may open a WebSocket to 127.0.0.1, and may come under a name of its own that it lets point there
(DNS rebinding). The one shows in the Origin of a request, the other in its Host.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from cuspid.runtime.errors import InputError, MissingDependencyError

Request = Any
"""``websockets.http11.Request``; it comes with viser, which may be missing."""
Answer = Callable[[Any, Request], Any]
"""What websockets calls first for each request: None goes on, a response ends it."""


def address(host: str, port: int) -> str:
    """Where a browser finds a server; addresses of IPv6 are in brackets."""
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def require_address(host: str) -> None:
    """Raise InputError where this machine cannot listen on an address."""
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as tried:
            tried.bind(place)
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(
            f"--host {host}: this machine cannot listen there ({why}); give one of its addresses"
        ) from error


def is_own(host: str | None, origin: str | None, bound: str) -> bool:
    """Whether a request with such headers comes from a page of the server that is bound to an address.

    Host must be an address, ``localhost``, this machine's name, or what the server is bound to: not a name that others
    hand out. Origin, which browsers send with every WebSocket, must be the same host and port.
    """
    try:
        name, page = urlsplit(f"//{host or ''}").hostname, urlsplit(origin or "").netloc
    except ValueError:  # brackets of an address that do not close
        return False
    return host is not None and _is_local(name, bound) and (origin is None or page.lower() == host.lower())


def _is_local(name: str | None, bound: str) -> bool:
    if name is None:
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name.lower() in {"localhost", bound.lower(), socket.gethostname().lower()}
    return True


@contextmanager
def only_own_pages(bound: str) -> Iterator[None]:
    """A viser server that is started in the block refuses (403) what :func:`is_own` refuses.

    viser has no setting for it, so that what it starts is replaced meanwhile. Raises MissingDependencyError where that
    was not what it started.
    """
    from websockets.asyncio import server

    serve, started = server.serve, []

    def serve_guarded(*given: Any, process_request: Answer, **options: Any) -> Any:
        started.append(bound)
        return serve(*given, process_request=_guard_handler(process_request, bound), **options)

    server.serve = serve_guarded  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]
    if not started:
        raise MissingDependencyError(
            "view: this version of viser cannot be shielded from other web pages; pip install 'viser==1.1.1'"
        )


def _guard_handler(answer: Answer, bound: str) -> Answer:
    def handle(connection: Any, request: Request) -> Any:
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) == 1 and len(origins) < 2 and is_own(hosts[0], next(iter(origins), None), bound):
            return answer(connection, request)
        return connection.respond(HTTPStatus.FORBIDDEN, "cuspid: only pages from this server may access it\n")

    return handle
