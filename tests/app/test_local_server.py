"""The server answers the browser of this machine, and no page of elsewhere."""

import http.client
import socket
import threading
from collections.abc import Iterator

import pytest

from pnu.app.local_server import LocalServer, page_server


@pytest.fixture
def server() -> Iterator[LocalServer]:
    server = page_server(b"<p>here", 0)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()


def asked(server: LocalServer, path: str = "/", method: str = "GET", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    answer.text = answer.read()  # type: ignore[attr-defined]
    connection.close()
    return answer


def test_the_page_and_nothing_else(server: LocalServer) -> None:
    answer = asked(server)
    assert (answer.status, answer.text) == (200, b"<p>here")  # type: ignore[attr-defined]
    assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    assert asked(server, "/etc/passwd").status == 404
    assert asked(server, "/../../etc/passwd").status == 404
    assert asked(server, method="POST").status == 501
    assert asked(server, method="HEAD").text == b""  # type: ignore[attr-defined]


def test_only_its_own_name_is_answered(server: LocalServer) -> None:
    """A page of elsewhere may let its name lead to this machine, or send requests here."""
    port = server.server_port
    assert asked(server, Host=f"127.0.0.1:{port}").status == 200
    assert asked(server, Host=f"localhost:{port}", Origin=f"http://localhost:{port}").status == 200
    assert asked(server, Host="evil.example").status == 403
    assert asked(server, Host=f"evil.example:{port}").status == 403
    assert asked(server, Origin="http://evil.example").status == 403
    assert asked(server, Origin="null").status == 403


def test_it_listens_on_this_machine_alone(server: LocalServer) -> None:
    assert server.socket.getsockname()[0] == "127.0.0.1"


def test_a_port_that_is_taken() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(ValueError, match=f"port={port}: Address already in use; port=0 takes a free one"):
            page_server(b"", port)
