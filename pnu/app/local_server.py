"""A web server for the browser on this machine, and for nobody else."""

import errno
import threading
import webbrowser
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

HOST = "127.0.0.1"
PORT = 8321  # the first that is tried
TRIED = 20
POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Handler(BaseHTTPRequestHandler):
    """Answers that name what they are, to requests that name this server: a page of elsewhere cannot reach it by a
    name of its own that leads here."""

    protocol_version = "HTTP/1.1"
    server_version = "pnu"
    sys_version = ""
    timeout = 60.0

    def parse_request(self) -> bool:
        """Refuse what another page asks."""
        if not super().parse_request():
            return False
        here = {f"{HOST}:{self.server.server_port}", f"localhost:{self.server.server_port}"}  # type: ignore[attr-defined]
        origin = self.headers.get("Origin")
        if self.headers.get("Host") in here and (origin is None or urlsplit(origin).netloc in here):
            return True
        self.close_connection = True
        self.answer(HTTPStatus.FORBIDDEN, b"not for you", "text/plain")
        return False

    def answer(self, status: HTTPStatus, body: bytes, kind: str, **more: str) -> None:
        """Send an answer of a type; more: headers, `_` for `-`."""
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        for name, value in more.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def end_headers(self) -> None:
        """What holds for every answer."""
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Cache-Control", "no-store")
        if self.close_connection:
            self.send_header("Connection", "close")
        super().end_headers()

    def log_message(self, format: str, *arguments: object) -> None:
        """Nothing: what is worth a line is said by the command."""


class LocalServer(ThreadingHTTPServer):
    """Serves with a handler; `address` is what a browser opens."""

    daemon_threads = True
    allow_reuse_address = False

    def __init__(self, handler: type[Handler], port: int) -> None:
        super().__init__((HOST, port), handler)

    @property
    def address(self) -> str:
        """Of the first page."""
        return f"http://{HOST}:{self.server_port}/"


def bound(make: Callable[[int], LocalServer], port: int | None) -> LocalServer:
    """A server at a port; None: 8321 or one of the next that is free, 0: any.

    Raises:
        ValueError: no port, or one that is taken.
    """
    if port is not None and not 0 <= port < 1 << 16:
        raise ValueError(f"port={port}: expected a number from 0 to 65535, or null")
    for number in [*range(PORT, PORT + TRIED), 0] if port is None else [port]:
        try:
            return make(number)
        except OSError as error:
            if port is not None or error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise ValueError(f"port={number}: {error.strerror}; port=0 takes a free one") from None
    raise AssertionError("port 0 is always free")


def page_server(page: bytes, port: int | None) -> LocalServer:
    """A server of one page."""

    class OnePage(Handler):
        def do_GET(self) -> None:
            if self.path == "/":
                self.answer(HTTPStatus.OK, page, "text/html")
            else:
                self.answer(HTTPStatus.NOT_FOUND, b"no such page", "text/plain")

        do_HEAD = do_GET

    return bound(lambda number: LocalServer(OnePage, number), port)


def serve(server: LocalServer, *, browse: bool) -> None:
    """Serve until Ctrl+C; browse: open the page in the user's browser."""
    if browse:
        threading.Thread(target=webbrowser.open, args=(server.address,), daemon=True).start()
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        server.server_close()
