"""Files that appear whole or not at all."""

import json
import math
import os
import re
import stat
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A new, empty file beside `path`, with its suffix; renamed to `path` on success, removed on failure.

    A link is written through. A file that is there keeps its mode; a new one gets that of the umask.

    Raises `ValueError` where the folder does not exist, `path` is a folder, or the system refuses to write.
    """
    path = Path(path)
    check_writable(path)
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.stem}.{uuid.uuid4().hex[:12]}{target.suffix}")
    try:
        kept = stat.S_IMODE(target.stat().st_mode) if target.exists() else None
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666 if kept is None else 0o600))
        yield temporary
        with temporary.open("rb+") as handle:
            os.fsync(handle.fileno())
        if kept is not None:
            temporary.chmod(kept)
        os.replace(temporary, target)
    except OSError as error:
        if error.filename not in (None, str(temporary), temporary):
            raise
        told = re.search(r"error message = '([^']+)'", str(error))  # by HDF5, among much else
        reason = error.strerror or (told[1] if told else str(error))
        raise ValueError(f"{path}: cannot be written ({reason}); free space or choose another folder") from error
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(folder: str | Path) -> None:
    """Remove what `atomic_path` left below a folder when its process was killed. Nothing else may write there."""
    for path in Path(folder).rglob(".*"):
        if re.fullmatch(r"\..+\.[0-9a-f]{12}(\.\w+)?", path.name) and path.is_file():
            path.unlink()


def check_writable(path: str | Path) -> None:
    """`ValueError` where a file of this name could not be written: to know it before the work, not after."""
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; give the name of a file to write")
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise ValueError(f"{path}: is a link to itself; remove it")
    if target.exists() and not target.is_file():
        raise ValueError(f"{path}: is no regular file; give the name of a file to write")
    folder = target.parent if path.is_symlink() else path.parent
    if not folder.is_dir():
        raise ValueError(f"{path}: the folder {folder} does not exist; create it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{path}: the folder {folder} cannot be written to; choose another one")


def write_json(path: str | Path, content: Any) -> None:
    """Write plain JSON, indented and atomically; NaN and infinity, which JSON does not know, become null."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(_plain(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: str | Path) -> Any:
    """Read a JSON file. Raises `ValueError` where there is none or it is not JSON."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file; expected JSON")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: is not JSON ({str(error).splitlines()[0]}); restore or remove it") from None


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # arrays, tensors and their scalars
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, bool | int | str | None) else str(value)
