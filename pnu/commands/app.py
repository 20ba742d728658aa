"""Densify scans in the browser, with what was found and made in 3D: `pnu app`."""

import signal
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnu.commands._entry import command
from pnu.config.schema import doc


@dataclass
class App:
    """Drop a scan into a page of this machine: see it, densify it, make its surface, download the results."""

    port: int | None = doc("of 127.0.0.1 where the browser finds it; 0: any; null: 8321 or the next that is free")
    open: bool = doc("start the browser; false: only say the address")
    limit_mb: float = doc("size that a scan may have, in MB")
    quiet: bool = doc("print nothing but errors and the address")


def app(cfg: Any) -> None:
    """Serve the page until Ctrl+C."""
    if not cfg.limit_mb > 0:
        raise ValueError(f"limit_mb={cfg.limit_mb:g}: expected a number above 0")
    from pnu.app.app_server import app_server
    from pnu.app.jobs import WorkerPool
    from pnu.app.local_server import serve
    from pnu.app.sessions import Sessions

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # files are removed then too
    with tempfile.TemporaryDirectory(prefix="pnu-app-", ignore_cleanup_errors=True) as folder:
        workers = WorkerPool()
        try:
            server = app_server(cfg.port, Sessions(Path(folder), workers), round(1e6 * cfg.limit_mb))
            print(f"open:   {server.address} (Ctrl+C ends)", flush=True)
            if not cfg.quiet:
                print(f"files:  {folder}, removed at the end", flush=True)
            serve(server, browse=cfg.open)
        finally:
            workers.end()


main = command(app, App)

if __name__ == "__main__":
    main()
