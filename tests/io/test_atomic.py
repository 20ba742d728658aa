"""What lies at the name that is written to: links are written through, its mode stays, devices are no outputs."""

import os
import stat
from pathlib import Path

import numpy as np
import pytest

from pnu.io import atomic_path, check_writable, read_cloud, read_json, write_cloud, write_json


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_link_is_written_through(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    target, link = tmp_path / "store" / "real.json", tmp_path / "link.json"
    write_json(target, {"a": 1})
    link.symlink_to("store/real.json")
    (tmp_path / "twice.json").symlink_to(link)
    write_json(tmp_path / "twice.json", {"a": 2})
    assert link.is_symlink()
    assert (tmp_path / "twice.json").is_symlink()
    assert read_json(target) == {"a": 2}
    assert [path.name for path in target.parent.iterdir()] == ["real.json"]


def test_a_link_to_nothing_yet(tmp_path: Path) -> None:
    link = tmp_path / "link.json"
    link.symlink_to(tmp_path / "new.json")
    write_json(link, [])
    assert link.is_symlink()
    assert read_json(tmp_path / "new.json") == []
    link.unlink()
    link.symlink_to(tmp_path / "missing" / "new.json")
    with pytest.raises(ValueError, match=r"link\.json: the folder .*missing does not exist; create it first"):
        check_writable(link)
    link.unlink()
    link.symlink_to(link)
    with pytest.raises(ValueError, match=r"link\.json: is a link to itself; remove it"):
        write_json(link, [])


@pytest.mark.parametrize("kept", [0o600, 0o640, 0o664, 0o444])
def test_the_mode_of_an_existing_file_stays(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "secret.ply"
    path.write_text("old")
    path.chmod(kept)
    points = np.random.default_rng(0).normal(size=(20, 3))
    write_cloud(path, points)
    assert mode(path) == kept
    assert len(read_cloud(path).points) == 20


def test_nobody_else_reads_what_replaces_a_private_file(tmp_path: Path) -> None:
    path = tmp_path / "secret.txt"
    path.write_text("old")
    path.chmod(0o600)
    with atomic_path(path) as temporary:
        temporary.write_text("new")
        assert mode(temporary) == 0o600
    assert path.read_text() == "new"


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_a_new_file_has_the_mode_of_the_umask(tmp_path: Path, mask: int) -> None:
    before = os.umask(mask)
    try:
        write_json(tmp_path / "a.json", {})
    finally:
        os.umask(before)
    assert mode(tmp_path / "a.json") == 0o666 & ~mask


def test_a_device_is_no_output(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(ValueError, match=r"pipe\.json: is no regular file; give the name of a file to write"):
        write_json(tmp_path / "pipe.json", {})
    assert stat.S_ISFIFO((tmp_path / "pipe.json").stat().st_mode)
