"""Pictures of something that runs, in a browser on this machine."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType

from ..errors import InputError

_PAGE = """<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body{{margin:0;background:#222;color:#eee;font:15px system-ui,sans-serif;text-align:center}}
img{{max-width:100%;max-height:calc(100vh - 60px)}}
button{{font:inherit;margin:10px 6px;padding:.4em 1.4em;border-radius:8px;border:1px solid #888;background:#333;
color:#eee}}</style></head><body><img src="/pictures" alt="{title}"><div>{buttons}</div><script>
document.querySelectorAll("button").forEach(b=>b.onclick=()=>fetch("/do/"+b.id,{{method:"POST"}}))
</script></body></html>"""


class LivePage:
    """A page at an address of this machine alone that shows the newest picture, with buttons.

    Args:
        title: of the page.
        actions: what the buttons do, by name; called from another thread.
        port: 0: a free one.

    Raises:
        InputError: the port cannot be had.
    """

    def __init__(self, title: str, actions: Mapping[str, Callable[[], None]], port: int = 0) -> None:
        self._new = threading.Condition()
        self._jpeg = b""
        self._count = 0
        self._ended = False
        buttons = "".join(f'<button id="{name}">{name}</button>' for name in actions)
        html = _PAGE.format(title=title, buttons=buttons).encode()
        page = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path == "/":
                    self._answer("text/html; charset=utf-8", html)
                elif self.path == "/pictures":
                    page._stream(self)
                else:
                    self.send_error(404)

            def do_POST(self) -> None:
                # another site's script may send a request, but not without saying that it comes from there
                if self.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
                    self.send_error(403)
                    return
                action = actions.get(self.path.removeprefix("/do/"))
                if action is None:
                    self.send_error(404)
                    return
                action()
                self._answer("text/plain", b"ok")

            def _answer(self, kind: str, body: bytes) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: object) -> None:
                """Say nothing."""

        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"no page can be served at port {port}: {error}") from None
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def show(self, jpeg: bytes) -> None:
        """The newest picture."""
        with self._new:
            self._jpeg, self._count = jpeg, self._count + 1
            self._new.notify_all()

    def _stream(self, handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "multipart/x-mixed-replace; boundary=picture")
        handler.end_headers()
        seen = 0
        try:
            while True:
                with self._new:
                    while not self._ended and self._count == seen:
                        self._new.wait()
                    if self._count == seen:
                        return
                    jpeg, seen = self._jpeg, self._count
                head = f"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                handler.wfile.write(head.encode() + jpeg + b"\r\n")
        except ConnectionError:  # the browser has gone
            return

    def __enter__(self) -> LivePage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._new:
            self._ended = True
            self._new.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
