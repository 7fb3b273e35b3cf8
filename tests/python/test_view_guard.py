"""Who may speak to a page's port: its own browsers, in small messages."""

from __future__ import annotations

import gc
import socket
import urllib.error
import urllib.request

import numpy as np
import pytest

pytest.importorskip("viser", reason="the page needs the extra view")

from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from palpate import robots
from palpate.view import Page, ShownArm, Source
from palpate.view._guard import LARGEST, allowed
from palpate.view.scene import Badge, Channels


@pytest.mark.parametrize(
    ("origin", "host", "alone", "answer"),
    [
        (None, "127.0.0.1:8080", True, True),
        (None, "localhost:8080", True, True),
        (None, f"{socket.gethostname()}:8080", True, True),
        (None, "[::1]:8080", True, True),
        ("http://127.0.0.1:8080", "127.0.0.1:8080", True, True),
        ("http://localhost:8080", "localhost:8080", True, True),
        ("http://LOCALHOST:8080", "localhost:8080", True, True),
        ("http://localhost:8081", "localhost:8080", True, False),
        ("https://evil.example", "127.0.0.1:8080", True, False),
        ("http://evil.example:8080", "evil.example:8080", True, False),
        (None, "evil.example:8080", True, False),
        ("null", "127.0.0.1:8080", True, False),
        ("http://[", "127.0.0.1:8080", True, False),
        (None, "127.0.0.1:99999999", True, False),
        (None, None, True, False),
        ("http://robot.example:8080", "robot.example:8080", False, True),
        ("https://evil.example", "robot.example:8080", False, False),
    ],
)
def test_only_the_page_itself_may_ask(
    origin: str | None, host: str | None, alone: bool, answer: bool
) -> None:
    assert allowed(origin, host, alone=alone) is answer


class Still(Source):
    """An arm of which nothing is known."""

    def start(self):
        pass

    def stop(self):
        pass

    @property
    def arms(self):
        return (ShownArm("arm", robots.load("katana_450_6m90a"), {}, 0.1),)

    def reading(self, arm):
        return None

    def curves(self, arm, span):
        return np.zeros(0), np.zeros((0, Channels(self.arms[0].arm.n).count))

    @property
    def state(self):
        return Badge("still", "green")


@pytest.fixture
def page():
    made = Page(Still(), port=0)
    yield made
    made.close()


def asked(page: Page, **headers: str) -> int:
    request = urllib.request.Request(page.url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def opened(page: Page, **more: object) -> ClientConnection:
    import viser

    version = f"viser-v{viser.__version__}"
    return connect(
        page.url.replace("http", "ws"), subprotocols=[version], max_size=None, open_timeout=60, **more
    )


def test_strangers_are_refused(page: Page) -> None:
    assert asked(page) == 200
    assert asked(page, Host="evil.example") == 403
    assert asked(page, Origin="https://evil.example") == 403
    with pytest.raises(InvalidStatus, match="403"):
        opened(page, origin="https://evil.example")
    with opened(page, origin=page.url) as own:
        assert own.recv(timeout=60)


def test_hostile_messages_end_their_connection_and_nothing_else(page: Page) -> None:
    """Bytes that are no message, a string of 1 MB and more, an array of a thousand million numbers."""
    huge = b"\xdd" + (10**9).to_bytes(4, "big")  # MessagePack: an array of so many; none follows
    for message in (b"\xc1", b"\x93\x01\x02", huge, "text", bytes(LARGEST + 1), "a" * (LARGEST + 1)):
        with opened(page) as stranger:
            stranger.recv(timeout=60)
            try:
                stranger.send(message)
                for _ in range(1000):
                    stranger.recv(timeout=60)
            except ConnectionClosed:
                continue
            except TimeoutError:
                pass
    gc.collect()
    page.update()
    with opened(page) as own:
        assert own.recv(timeout=60), "others are still served"
