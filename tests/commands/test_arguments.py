"""What people type instead of key=value, and what they are told where it cannot be meant."""

from pathlib import Path

import pytest
from hydra._internal.utils import get_args_parser

from pnu.commands import _arguments
from pnu.commands._arguments import keyed
from pnu.commands.report import Report
from pnu.commands.scan import Scan
from pnu.commands.scan import main as scan
from pnu.commands.train import Train
from pnu.commands.upsample import Upsample
from pnu.commands.upsample import main as upsample
from pnu.commands.view import View
from tests.refusals import refused

TYPED = [
    ("scan.ply mesh.ply", Scan, "input=scan.ply output=mesh.ply"),
    ("scan.ply ratio=8 mesh.ply", Scan, "input=scan.ply output=mesh.ply ratio=8"),
    ("scan.ply output=mesh.ply", Scan, "input=scan.ply output=mesh.ply"),
    ("output=mesh.ply scan.ply", Scan, "input=scan.ply output=mesh.ply"),
    ("-i scan.ply -o mesh.ply", Scan, "input=scan.ply output=mesh.ply"),
    ("--input scan.ply --output=mesh.ply", Scan, "input=scan.ply output=mesh.ply"),
    ("--quiet --ratio 8 scan.ply", Scan, "input=scan.ply quiet=true ratio=8"),
    ("--quiet=false --viewpoint -1,2,3", Scan, 'quiet=false viewpoint="-1,2,3"'),
    ("--patch-size=64", Upsample, "patch_size=64"),
    ("--model apss", Upsample, "run=apss"),
    ("--run=outputs/a", Upsample, "run=outputs/a"),
    ("~/a.ply output=~/b.ply", Upsample, f"input={Path.home()}/a.ply output={Path.home()}/b.ply"),
    ("outputs/sweeps/w3", Report, "sweep=outputs/sweeps/w3"),
    ("a.ply b.ply --page both.html", View, "inputs=[a.ply,b.ply] page=both.html"),
    ("--loss.w3=0.1 -m --seed 0,1", Train, "loss.w3=0.1 -m seed=0,1"),
    ("--cfg job --info defaults -i", Train, "--cfg job --info defaults -i"),
    ("--help", Train, "--help"),
    ("~data.patches", Train, "~data.patches"),
]


@pytest.mark.parametrize(("typed", "schema", "meant"), TYPED)
def test_what_people_type_is_understood(typed: str, schema: type, meant: str) -> None:
    assert keyed(typed.split(), schema) == meant.split()


def test_a_file_of_an_awkward_name_stands_alone() -> None:
    assert keyed(["a b, c.ply"], Scan) == ['input="a b, c.ply"']


def test_the_options_of_hydra_are_known() -> None:
    actions = [action for action in get_args_parser()._actions if action.option_strings]
    options = {name: action.nargs != 0 for action in actions for name in action.option_strings}
    assert options == _arguments.HYDRA
    (info,) = (action for action in actions if action.dest == "info")
    assert tuple(info.choices) == _arguments.INFO


@pytest.mark.parametrize(
    ("typed", "line"),
    [
        ("a.ply b.ply c.ply", "cannot read 'c.ply': expected key=value; one for each of input, output can stand alone"),
        ("a.ply --outptu b.ply", "unknown option --outptu: keys are given as key=value, is output=... meant?"),
        ("a.ply --ratio", "--ratio: expected a value, ratio=..."),
        ("a.ply --ratio output=b.ply", "--ratio: expected a value, ratio=..."),
    ],
)
def test_what_cannot_be_meant_is_one_line(typed: str, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert refused(capsys, scan, typed.split()) == f"error: {line}"


def test_a_folder_is_no_cloud(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert refused(capsys, upsample, [str(tmp_path), "d.ply"]).startswith(
        f"error: {tmp_path}: is a folder; give the file of a point cloud"
    )
    cloud = tmp_path / "a.xyz"
    cloud.write_text("0 0 0\n")
    assert f"{tmp_path}: is a folder; give the name of a point cloud to write" in refused(
        capsys, upsample, [str(cloud), str(tmp_path)]
    )
    missing = refused(capsys, upsample, [f"{tmp_path}/scans/", "d.ply"])
    assert missing == f"error: {tmp_path}/scans: no such file; give the path of a point cloud"
