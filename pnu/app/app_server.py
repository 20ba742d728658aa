"""The requests of `pnu app`'s page."""

import json
import secrets
import shutil
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, unquote, urlsplit

from pnu.app.local_server import Handler, LocalServer, bound
from pnu.app.sessions import RESERVE, Session, Sessions
from pnu.report.offline_page import color_scale, gradient, render

CHUNK = 1 << 20
LARGEST = 1 << 16  # bytes of a request that is no upload


class AppServer(LocalServer):
    """Serves `pnu app`.

    Args:
        port: of 127.0.0.1.
        sessions: the users.
        limit: of an upload, in bytes.
    """

    def __init__(self, port: int, sessions: Sessions, limit: int) -> None:
        self.sessions, self.limit = sessions, limit
        self.page = app_page(limit)
        super().__init__(AppRequests, port)


def app_server(port: int | None, sessions: Sessions, limit: int) -> AppServer:
    """A server at a port, see `bound`."""
    server = bound(lambda number: AppServer(number, sessions, limit), port)
    assert isinstance(server, AppServer)
    return server


def app_page(limit: int) -> bytes:
    """The one page."""
    from markupsafe import Markup

    scale = color_scale()
    settings = {"limit": limit, "colors": [round(float(value), 4) for value in scale.ravel() / 255]}
    return render("app.html", settings=Markup(json.dumps(settings)), gradient=gradient(scale)).encode()


class AppRequests(Handler):
    """`/` is the page, `/sessions` makes a session, `/s/TOKEN/...` is that session's."""

    server: AppServer

    def do_GET(self) -> None:
        """The page, the state, what is shown, a file."""
        path = urlsplit(self.path).path
        if path == "/":
            self.answer(HTTPStatus.OK, self.server.page, "text/html")
            return
        self.within_session(path, {"state": self.send_state, "view": self.send_view, "file": self.send_file})

    def do_POST(self) -> None:
        """A new session; or start, stop, and forget."""
        path = urlsplit(self.path).path
        if path == "/sessions":
            self.answer_json({"token": self.server.sessions.new()})
            return
        self.within_session(path, {"make": self.make, "stop": self.stop, "ready": self.ready, "end": self.end_session})

    def do_PUT(self) -> None:
        """The scan."""
        self.within_session(urlsplit(self.path).path, {"scan": self.take_scan})

    def within_session(self, path: str, known: dict[str, Callable[[Session, str], None]]) -> None:
        """Call what a path names; a `ValueError` is a line for the page."""
        parts = [unquote(part) for part in path.split("/")]
        session = self.server.sessions.get(parts[2]) if len(parts) in (4, 5) and parts[1] == "s" else None
        if session is None or parts[3] not in known:
            self.close_connection = True  # what is left of the request is not read
            status = HTTPStatus.NOT_FOUND
            self.answer_json({"error": "this session has ended; reload the page"}, status)
            return
        try:
            known[parts[3]](session, parts[4] if len(parts) == 5 else "")
        except ValueError as error:
            self.answer_json({"error": str(error)}, HTTPStatus.BAD_REQUEST)

    def answer_json(self, value: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        """Send JSON."""
        self.answer(status, json.dumps(value).encode(), "application/json")

    def body(self) -> Any:
        """The JSON of a request.

        Raises:
            ValueError: it is none.
        """
        length = self.length()
        if length > LARGEST:
            self.close_connection = True
            raise ValueError("the request is too long")
        value = json.loads(self.rfile.read(length) or b"{}")
        if not isinstance(value, dict):
            raise ValueError("expected an object")
        return value

    def length(self) -> int:
        """Of the request's body.

        Raises:
            ValueError: it is not said.
        """
        text = self.headers.get("Content-Length", "")
        if not text.isdecimal():
            self.close_connection = True
            raise ValueError("the length of the request is missing")
        return int(text)

    def take_scan(self, session: Session, _: str) -> None:
        """Take an upload, piece by piece."""
        length = self.length()
        name = parse_qs(urlsplit(self.path).query).get("name", ["scan"])[0]
        self.close_connection = True  # unless all of it is read
        if length > self.server.limit:
            limit = f"{self.server.limit / 1e6:g} MB"
            raise ValueError(f"{name}: has {length / 1e6:.0f} MB, at most {limit} are taken; limit_mb= raises it")
        free = shutil.disk_usage(self.server.sessions.root).free
        if length + RESERVE > free:
            raise ValueError(f"{name}: has {length / 1e6:.0f} MB, the disk has no room for it")
        target = session.take(name)
        part = target.with_name(f".upload_{secrets.token_hex(4)}")
        try:
            with part.open("wb") as handle:
                left = length
                while left and (piece := self.rfile.read(min(CHUNK, left))):
                    handle.write(piece)
                    left -= len(piece)
            if left:
                raise ValueError(f"{name}: the upload ended early; drop it again")
            part.replace(target)
        except FileNotFoundError:
            raise ValueError(f"{name}: another file came meanwhile") from None
        finally:
            part.unlink(missing_ok=True)
        self.close_connection = False
        session.start_look()
        self.answer_json({})

    def make(self, session: Session, _: str) -> None:
        """Begin what the form asks for."""
        session.start_making(self.body())
        self.answer_json({})

    def stop(self, session: Session, _: str) -> None:
        """Stop it."""
        self.body()
        session.stop()
        self.answer_json({})

    def ready(self, session: Session, name: str) -> None:
        """Have a file ready to be downloaded."""
        self.body()
        session.file(name)
        self.answer_json({})

    def end_session(self, session: Session, _: str) -> None:
        """Remove all of a session."""
        self.body()
        self.server.sessions.end(unquote(urlsplit(self.path).path.split("/")[2]))
        self.answer_json({})

    def send_state(self, session: Session, _: str) -> None:
        """What the page shows."""
        self.answer_json(session.state())

    def send_view(self, session: Session, number: str) -> None:
        """The arrays of a view."""
        name = session.views.get(int(number)) if number.isdecimal() else None
        if name is None or not (session.folder / name).is_file():
            raise ValueError("no such view")
        self.send_path(session.folder / name, "")

    def send_file(self, session: Session, name: str) -> None:
        """A result."""
        self.send_path(session.file(name), name)

    def send_path(self, path: Path, name: str) -> None:
        """Send a file piece by piece, under a name to be kept by."""
        with path.open("rb") as handle:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "application/octet-stream")
            self.send_header("Content-Length", str(path.stat().st_size))
            if name:
                self.send_header("Content-Disposition", f"attachment; filename*=UTF-8''{quote(name)}")
            self.end_headers()
            shutil.copyfileobj(handle, self.wfile, CHUNK)
