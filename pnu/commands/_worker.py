"""A process of `pnu app`: waits for one order, runs the commands that it names, and tells how far they are."""

import contextlib
import io
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pnu.cleaning import Cleaned
    from pnu.io import Cloud

Tell = Callable[..., None]


def run_order(order: Mapping[str, Any], tell: Tell) -> Any:
    """What an order asks for.

    Args:
        order: `folder`, the paths are in it; `work`: look, make or write, see below; and what that needs.
        tell: called with line=, or with stage=, done= and total=.

    Raises:
        ValueError: in one line, what is wrong.
    """
    from pnu.runtime.progress import heard

    os.chdir(order["folder"])
    work = {"look": look, "make": run_commands, "write": write_file}[order["work"]]
    with heard(lambda stage, done, total: tell(stage=stage, done=done, total=total)):
        return work(order, tell)


def look(order: Mapping[str, Any], tell: Tell) -> Any:
    """See what a scan is like: `scan`, its file; `view`, the file for what is shown."""
    from pnu.app.scan_look import look_at_scan

    tell(stage="reading", done=0, total=1)
    before, cleaned = read_and_clean(order["scan"], {})
    tell(stage="looking", done=0, total=1)
    return look_at_scan(order["scan"], before, cleaned, order["view"])


def run_commands(order: Mapping[str, Any], tell: Tell) -> Any:
    """Run `commands`, a list of [verb, argument ...]; then show `scan`, `cloud` and, if there is one, `mesh`."""
    from pnu.app.scan_look import show_result

    for verb, *arguments in order["commands"]:
        run_command(verb, arguments, tell)
    tell(stage="picture", done=0, total=1)
    before, cleaned = read_and_clean(order["scan"], order["keys"])
    return show_result(order["scan"], before, cleaned, order["cloud"], order.get("mesh"), order["view"])


def write_file(order: Mapping[str, Any], tell: Tell) -> Any:
    """Write `source`, a cloud or a mesh, as `target`; or a page of all files in `shown`."""
    from pnu import io
    from pnu.config.quoting import override
    from pnu.geometry.mesh_topology import vertex_normals

    tell(stage="writing", done=0, total=1)
    if "shown" in order:
        shown = [override("inputs", order["shown"]), override("page", order["target"]), "quiet=true"]
        run_command("view", shown, tell)
        return {}
    if order["kind"] == "mesh":
        mesh = io.read_mesh(order["source"])
        return {"notes": io.write_mesh(order["target"], mesh, vertex_normals=vertex_normals(mesh))}
    cloud = io.read_cloud(order["source"], minimum=1)
    return {"notes": io.write_cloud(order["target"], cloud.points, cloud.normals, cloud.attributes)}


def read_and_clean(scan: str, keys: Mapping[str, Any]) -> tuple["Cloud", "Cleaned"]:
    """A scan as it is read, and as `pnu upsample` with these keys cleans it."""
    from pnu import io
    from pnu.commands import _sides
    from pnu.commands.upsample import Upsample
    from pnu.config.compose import compose_config
    from pnu.config.quoting import override

    given = [override(key, value) for key, value in ({"input": scan, "output": "dense.ply"} | dict(keys)).items()]
    cfg = compose_config(Upsample, given)
    before = io.read_cloud(scan, normals=cfg.normals != "estimate", columns=cfg.columns)
    cleaned, cloud = _sides.cleaned(cfg, before, outliers=cfg.outliers, lines=cfg.lines, noise=cfg.noise)
    return before, cleaned._replace(cloud=cloud)


def run_command(verb: str, arguments: list[str], tell: Tell) -> None:
    """Run a command as `pnu VERB ...` does; its lines are told, its error is raised.

    Raises:
        ValueError: the command's one line.
    """
    import importlib

    main = importlib.import_module(f"pnu.commands.{verb}").main
    errors = io.StringIO()
    with contextlib.redirect_stdout(Lines(tell)), contextlib.redirect_stderr(errors):
        try:
            main(arguments)
        except SystemExit as end:
            if end.code:
                said = errors.getvalue().strip().splitlines() or [f"pnu {verb} ended with {end.code}"]
                raise ValueError(said[-1].removeprefix("error: ")) from None
    for line in errors.getvalue().splitlines():
        if line.startswith("warning: "):
            tell(line=line)


class Lines(io.TextIOBase):
    """A stream that tells each of its lines."""

    def __init__(self, tell: Tell) -> None:
        self.tell_line, self.left = tell, ""

    def write(self, text: str) -> int:
        """See `io.TextIOBase`."""
        *lines, self.left = (self.left + text).split("\n")
        for line in lines:
            self.tell_line(line=line)
        return len(text)


def end_with_server() -> None:
    """End this process and its own when the server is gone, which closes the pipe of orders."""
    sys.stdin.read()
    if hasattr(os, "killpg"):
        os.killpg(os.getpid(), signal.SIGKILL)  # it leads a session of its own
    os._exit(1)


def main() -> None:
    """Load what takes long, wait for the order, do it."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print is no answer

    def tell(**message: Any) -> None:
        answers.write(json.dumps(message) + "\n")
        answers.flush()

    import pnu.commands.reconstruct
    import pnu.commands.upsample
    import pnu.networks.checkpoints
    import pnu.upsamplers.whole_clouds  # noqa: F401

    order = sys.stdin.readline()
    if not order:
        return
    threading.Thread(target=end_with_server, daemon=True).start()
    try:
        tell(result=run_order(json.loads(order), tell))
    except (ValueError, OSError) as error:
        from pnu.config.compose import one_line

        tell(error=one_line(error))
    except MemoryError:
        tell(error="the memory is not enough; take fewer points")
    answers.close()
    os._exit(0)  # threads that libraries left do not keep it


if __name__ == "__main__":
    main()
