"""Every file of conf/ that changes a training: experiments, scales, ablations and their settings."""

import functools
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from omegaconf import OmegaConf

from pnu.commands.train import Train, main
from pnu.config.compose import check_keys, checked, compose_config, composer, config_folder, variations
from pnu.data import shapes
from pnu.io import write_mesh
from pnu.training.sweeps import parameters

OVERLAYS = [
    f"{group}={path.relative_to(config_folder() / group).with_suffix('')}"
    for group in ("experiment", "scale", "debug", "setting")
    for path in sorted((config_folder() / group).rglob("*.yaml"))
]
EXPERIMENTS = [overlay for overlay in OVERLAYS if overlay.startswith(("experiment", "scale"))]
UPSAMPLING = [overlay for overlay in EXPERIMENTS if overlay != "experiment=normals"]  # a task with data of its own


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_every_overlay_composes(overlay: str) -> None:
    group = overlay.removeprefix("setting=").partition("/")[0]
    base = [f"ablation={group}"] if group.startswith("surface") else []  # whose parts they leave out
    cfg = compose_config(Train, [*base, overlay])
    if not overlay.endswith(("=default", "=full")):  # it changes something
        assert OmegaConf.to_container(cfg) != plain_config(*base)


@functools.cache
def plain_config(*base: str) -> Any:
    """What a training has without the overlay, composed once for all tests: half a second each."""
    return OmegaConf.to_container(compose_config(Train, base))


@pytest.mark.parametrize("kind", [pytest.param("ablation", marks=pytest.mark.slow), "hparams_search"])
def test_every_sweep_composes_with_each_of_its_values(kind: str) -> None:
    for path in sorted((config_folder() / kind).glob("*.yaml")):
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper") if kind == "hparams_search" else None
        choice = [f"{kind}={path.stem}"]
        with composer("train") as compose:
            swept = parameters(choice, compose)
            assert swept
            for one in variations([*swept, *choice]):
                check_keys(one, Train, compose)
                checked(one, Train, compose)


# --- an overlay fits every source of data ---


@pytest.mark.parametrize(
    "overlay", ["experiment=quickstart", "scale=small", "scale=patch64", "scale=full", "debug=default"]
)
@pytest.mark.parametrize("source", ["synthetic", "patches", "meshes", "surface"])
def test_overlays_fit_every_source_of_data(overlay: str, source: str) -> None:
    cfg = compose_config(Train, [overlay, f"data={source}"])
    assert ("patches" in cfg.data) == (source in ("synthetic", "meshes"))
    assert ("input_points" in cfg.data) == (source != "surface")
    plain = plain_config(overlay)
    if overlay != "debug=default":  # which leaves the data as they are
        assert cfg.data.batch_size == plain["data"]["batch_size"]
    assert OmegaConf.to_container(cfg.trainer) == plain["trainer"]


def test_what_an_overlay_says_to_another_schedule_is_left_out() -> None:
    cfg = compose_config(Train, ["experiment=quickstart", "scheduler=cosine"])
    assert set(cfg.scheduler) == {"_target_", "_partial_", "eta_min"}
    assert cfg.trainer.max_steps == 900
    assert compose_config(Train, ["experiment=quickstart", "scheduler=none"]).scheduler == {}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["data=patches", "data.patches=3"],
            r"key 'data\.patches' has no use with this data: it is one of data=meshes or",
        ),
        (["scale=small", "data=surface", "data.input_points=64"], r"key 'data\.input_points' has no use"),
        (["setting=features/no_local", "model=punet"], r"key 'model\.local_features' has no use with this model"),
    ],
)
def test_what_is_asked_for_is_not_left_out(overrides: list[str], message: str) -> None:
    """A setting of an ablation that does nothing would make a run that is called what it is not."""
    with pytest.raises(ValueError, match=message):
        compose_config(Train, overrides)


@pytest.fixture
def patches(tmp_path: Path) -> Path:
    ball = np.random.default_rng(0).normal(size=(60, 256, 3))
    ball /= np.linalg.norm(ball, axis=-1, keepdims=True)
    with h5py.File(tmp_path / "own.h5", "w") as file:
        file["poisson_4096"] = np.concatenate([ball, ball], -1).astype(np.float32)
        file["name"] = np.array([f"ball_{i % 6}" for i in range(60)], dtype=h5py.string_dtype())
    return tmp_path / "own.h5"


def finished(run: Path) -> bool:
    return json.loads((run / "run.json").read_text())["status"] == "finished"


@pytest.mark.slow
def test_quickstart_takes_patches_of_ones_own(patches: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = patches.with_name("run")
    options = ["trainer.max_steps=1", "trainer.val_check_interval=1", "trainer.limit_val_batches=1", "threads=null"]
    main(["experiment=quickstart", "data=patches", f"data.path={patches}", f"run={run}", "model.local_features=false",
          "callbacks.pictures.clouds=0", "trainer.limit_test_batches=1", *options])  # fmt: skip
    assert finished(run)
    assert "left out, since nothing here takes them: data.patches (experiment=quickstart)" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("overlay", UPSAMPLING)
@pytest.mark.parametrize("source", ["own", "patches", "surface"])
def test_every_experiment_runs_a_step(overlay: str, source: str, patches: Path, tmp_path: Path) -> None:
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    write_mesh(meshes / "extra.ply", shapes.make("mug"))
    options: list[Any] = [
        "trainer.max_steps=1",
        "trainer.max_epochs=-1",
        "trainer.accelerator=cpu",
        "trainer.devices=1",
    ]
    options += ["trainer.limit_val_batches=1", "trainer.limit_test_batches=1", "trainer.check_val_every_n_epoch=null"]
    options += ["trainer.val_check_interval=1", "data.batch_size=4", "callbacks.pictures.clouds=0", "threads=null"]
    cfg = compose_config(Train, [overlay, *([] if source == "own" else [f"data={source}"])])
    if "clouds" in cfg.data:
        options += ["data.validation=[gear]", "data.clouds=8", "data.size=96", "data.points=128", "model=surface"]
        options += ["loss=surface", *(["weights=null"] if cfg.weights == "previous" else [])]
    else:
        options += ["model=pnu", "loss=compound", "data.input_points=64", "data.target_points=256"]
        options += (
            [f"data.path={patches}"] if "patches" not in cfg.data else ["data.patches=91", f"data.cache={tmp_path}"]
        )
        options += ["weights=null"]
    chosen = [] if source == "own" else [f"data={source}"]
    main([overlay, *chosen, *options, f"run={tmp_path / 'run'}", "quiet=true"])
    assert finished(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("model", ["pcpnet", "nestinet"])
def test_the_experiment_of_normals_runs_a_step(tmp_path: Path, model: str) -> None:
    data = ["data.clouds=2", "data.points=300", "data.queries=4", "data.batch_size=1"]
    steps = ["trainer.max_steps=1", "trainer.val_check_interval=1", "trainer.limit_val_batches=1"]
    run = tmp_path / "run"
    main(
        [
            "experiment=normals",
            f"model={model}",
            *data,
            *steps,
            "trainer.limit_test_batches=1",
            "threads=null",
            f"run={run}",
            "quiet=true",
        ]
    )
    assert finished(run)
