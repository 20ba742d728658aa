"""Data module of the surface model: crops for training, whole clouds of other shapes for validation and test."""

from collections.abc import Iterable
from typing import Any, Literal

from pnu.data import shapes
from pnu.data.crops import LEAST, SMALLEST, Crops, WholeClouds, flattened, stacked_items
from pnu.data.mesh_scene import MeshScene
from pnu.data.patch_module import EpochDataModule, say_open
from pnu.geometry.mesh_topology import open_edges
from pnu.io import meshes_of, read_mesh


class ProjectionDataModule(EpochDataModule):
    """Crops of clouds drawn from meshes.

    Args:
        root: folder of closed meshes, beside the procedural shapes; null: those alone
        procedural: train on the procedural shapes
        validation: names of the meshes kept for validation and test
        normals: of the input: given, estimated from its points, or mixed
        sides: of estimated normals: from the truth, or found as at work
        scans: share of the clouds that are simulated scans
        blue: share of the other clouds whose points keep a distance, as blue noise
        least: points of the smallest clouds
        noise: largest standard deviation of the noise, in radii
        noisy: share of the clouds that has noise
        given: share of the crops that has given normals where they are mixed
        clouds: of an epoch, each drawn anew
        pool: clouds that are drawn at all, and used again and again; null: as many as are used; several
            workers draw them before the training
        size: points of a crop
        views: crops of a cloud
        batch_size: clouds of a batch, on each device
        points: points of a validation cloud
        workers: processes that draw crops; 0: the training's own
        seed: of all draws
        quiet: no progress bar while a pool is drawn
    """

    kind = "clouds"
    collate, collate_evaluation = staticmethod(flattened), staticmethod(stacked_items)

    def __init__(
        self, root: str | None = None, procedural: bool = True, validation: Iterable[str] = (),
        normals: Literal["given", "estimated", "mixed"] = "given", sides: Literal["truth", "found"] = "truth",
        scans: float = 0.0, blue: float = 0.15, least: int = LEAST,
        noise: float = 0.02, noisy: float = 0.5, given: float = 0.3, clouds: int = 6400, pool: int | None = None,
        size: int = 384, views: int = 2, batch_size: int = 8, points: int = 2048, workers: int = 0, seed: int = 0,
        quiet: bool = False,
    ) -> None:  # fmt: skip
        super().__init__(batch_size, workers, seed)
        if points < SMALLEST:
            raise ValueError(f"data.points={points}: expected at least {SMALLEST}")
        self.evaluation_batch_size = 1
        self.root, self.procedural, self.held_out = root, procedural, list(validation)
        self.scans, self.blue, self.least, self.noise, self.noisy = scans, blue, least, noise, noisy
        self.sides, self.given, self.pool = sides, given, pool
        self.normals, self.clouds, self.size, self.views, self.points = normals, clouds, size, views, points
        self.quiet = quiet
        self.truth: MeshScene | None = None

    @property
    def input_size(self) -> tuple[str, int]:
        """Those of a crop."""
        return "data.size", self.size

    def setup(self, stage: str | None = None) -> None:
        if self.truth is not None:
            return
        files = meshes_of(self.root) if self.root else {}
        meshes = {name: shapes.unit_mesh(read_mesh(path)) for name, path in files.items()}
        if self.process[0] == 0:
            say_open({name: open_edges(mesh) for name, mesh in meshes.items()})
        if self.procedural:
            meshes |= {name: shapes.make(name) for name in shapes.names()}
        missing = [name for name in self.held_out if name not in meshes]
        if missing:
            raise ValueError(f"data.validation: found no mesh {missing[0]} in data.root={self.root}")
        held_out = {name: meshes.pop(name) for name in self.held_out}
        if not meshes:
            raise ValueError(f"data.root={self.root}: expected meshes to train on, found none but those of validation")
        self.truth = MeshScene(list(meshes.values()))
        self.check_batch_size(self.clouds, f"data.clouds={self.clouds}")
        train = Crops(
            meshes,
            self.clouds,
            size=self.size,
            views=self.views,
            normals=self.normals,
            sides=self.sides,
            pool=self.pool,
            scans=self.scans,
            blue=self.blue,
            least=self.least,
            noise=self.noise,
            noisy=self.noisy,
            given=self.given,
            seed=self.seed,
        )
        if self.pool is not None and self.workers > 1:
            train.draw_pool(self.workers, quiet=self.quiet)
        clouds = {
            part: WholeClouds(held_out, self.points, normals=self.normals, sides=self.sides, seed=seed)
            for part, seed in (("val", 1), ("test", 2))
        }
        self.datasets = {"train": train, **clouds}

    def on_after_batch_transfer(self, batch: dict[str, Any], dataloader_idx: int) -> dict[str, Any]:
        """Adds what the loss asks for the closest surface points; here, so that no worker process has to send it."""
        return {**batch, "surface": self.truth} if "center" in batch else batch
