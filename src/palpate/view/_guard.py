"""Who may speak to a page's port, and how much at once: what viser itself leaves open.

A browser lets any web site open a WebSocket to any port of this computer; only the server can refuse. And a web site's
own name may be made to mean this computer (DNS rebinding), so that its Origin and the page's address agree.
"""

from __future__ import annotations

import http
import ipaddress
import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

LARGEST = 1 << 20
"""of a message from a browser [bytes]; a click has some dozens, a goal some hundreds"""
_logger = logging.getLogger(__name__)


def allowed(origin: str | None, host: str | None, *, alone: bool) -> bool:
    """Whether a request may be answered.

    Args:
        origin: of the page that asks, as its browser says; None: no browser asks, or it asks for the page itself.
        host: the address that was asked for.
        alone: only this computer is listened to, so that no name but its own can be meant.
    """
    asked = urlsplit(f"//{host or ''}")
    try:
        name, port = asked.hostname or "", asked.port
    except ValueError:
        return False
    if alone and not _own(name):
        return False
    if origin is None:
        return True
    try:
        where = urlsplit(origin)
        return (where.hostname or "", where.port) == (name, port)
    except ValueError:
        return False


def _own(name: str) -> bool:
    """Whether this is a name that nobody else can give to this computer: an address, or what it calls itself."""
    here = socket.gethostname().lower()
    if name in ("localhost", here, f"{here}.local", socket.getfqdn().lower()):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextmanager
def guarded(listen: str) -> Iterator[None]:
    """Have a server that viser starts meanwhile at this address refuse strangers, and messages beyond `LARGEST`."""
    import websockets.asyncio.server as server
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    real, used = server.serve, False
    alone = listen in ("localhost", "::1") or listen.startswith("127.")

    def serve(*given: Any, **options: Any) -> Any:
        nonlocal used
        used = True
        answer: Callable[[Any, Any], Any] | None = options.get("process_request")

        def process(connection: Any, request: Any) -> Any:
            if not allowed(request.headers.get("Origin"), request.headers.get("Host"), alone=alone):
                return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", Headers(), b"not from here\n")
            return None if answer is None else answer(connection, request)

        return real(*given, **{**options, "process_request": process, "max_size": LARGEST})

    vars(server)["serve"] = serve  # viser takes no such options
    try:
        yield
    finally:
        vars(server)["serve"] = real
    if not used:
        _logger.warning(
            "this version of viser starts its server in another way: strangers' pages are not refused"
        )
