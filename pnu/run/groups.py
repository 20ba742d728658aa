"""The groups of the config: each key of conf/<group>/*.yaml, its type and a line on it."""

from dataclasses import dataclass
from typing import Any

from pnu.run.schema import doc


@dataclass
class Augmentation:
    """Random changes of training samples; a part with range or sigma 0 is off."""

    rotation: bool = doc("turn input and target by a uniform random rotation")
    scale: list[float] = doc("lowest and highest factor of input and target")
    shift: float = doc("greatest offset of input and target along each axis, of the unit sphere's radius")
    jitter_sigma: float = doc("standard deviation of each coordinate of the input's points")
    jitter_clip: float = doc("greatest offset by jitter")
    tilt_sigma: float = doc("standard deviation of the angles of the input's small rotation, in radians")
    tilt_clip: float = doc("greatest of those angles")
    input_probability: float = doc("of jitter, and of the small rotation")


@dataclass
class Data:
    """conf/data: patches to train, validate and test with."""

    _target_: str = doc("class of pnu.data")
    path: str | None = doc("HDF5 file of patches (data=patches)")
    root: str | None = doc("folder of meshes: ply, off, obj, stl, glb, gltf, vtk, vtp (data=meshes)")
    kinds: list[str] = doc("of procedural shapes: organic, cad (data=synthetic)")
    patches: int = doc("cut from all shapes together")
    cache: str = doc("folder of the files of patches that are cut")
    shape_seed: int = doc("of where patches are cut and of their points")
    quiet: bool = doc("no progress bar while patches are cut")
    batch_size: int = doc("patches of a training step, on each device")
    workers: int = doc("processes that load; the data are the same with any number")
    seed: int = doc("of order, downsampling and augmentation")
    input_points: int = doc("points of an input patch")
    target_points: int = doc("points of a target patch; fewer than the file has take a smaller patch")
    downsampling: str = doc("of target to input: nonuniform, random, poisson (evenly), given (the file's)")
    evaluation: str | None = doc("downsampling of validation and test; null: the training's")
    strength: float = doc("nonuniform: centres are exp(strength) times denser than the farthest points; 0: uniform")
    centers: int = doc("nonuniform: dense places of a patch")
    val_share: float = doc("share of the shapes kept for validation")
    test_share: float = doc("share of the shapes kept for the test")
    procedural: bool = doc("train on the procedural shapes too (data=surface)")
    validation: list[str] = doc("meshes kept for validation and test (data=surface)")
    normals: str = doc("of the input: given, or estimated from its points (data=surface)")
    clouds: int = doc("of an epoch, each drawn anew (data=surface)")
    size: int = doc("points of a crop of a cloud (data=surface)")
    views: int = doc("crops of a cloud (data=surface)")
    points: int = doc("points of a validation cloud (data=surface)")
    augmentation: Augmentation = doc("Augmentation of training samples; null: none")


@dataclass
class Model:
    """conf/model: the network."""

    _target_: str = doc("class below pnu.networks")
    ratio: int = doc("points out for each point in: 2, 4, 8 or 16")
    input_normals: bool = doc("read the normals of the input")
    predict_normals: bool = doc("predict normals beside points")
    local_features: bool = doc("features of each point's neighbourhood")
    global_features: bool = doc("features of the whole patch")
    residual: bool = doc("predict what is added to the input point and normal; ours, not the paper's")
    neighbours: int = doc("input points that a seed looks at (model=surface, as the following)")
    reach: int = doc("rank of the farthest of them; beyond the 16 nearest they are thinned out")
    width: int = doc("of the network")
    rounds: int = doc("projections, in training")
    queries: int = doc("seeds of a crop, in training")
    seeds: float = doc("seeds for each point wanted")
    candidates: float = doc("of them, after thinning out to even spacing")
    shortlist: float = doc("of those, thinned out again after they moved to spheres")
    relaxation: int = doc("steps of even spacing; 0: none")
    refinements: int = doc("projections after the even spacing")
    reject: float = doc("share of points made too many; of doubtful neighbours the worst are dropped")
    sphere: bool = doc("start from the sphere that fits the neighbours, not from the seed")
    attention: bool = doc("weigh the neighbours; without it all count alike")


@dataclass
class Loss:
    """conf/loss: what training makes small."""

    _target_: str = doc("class of pnu.losses")
    w1: float = doc("weight of the point term: Chamfer distance (Eq. 1)")
    w2: float = doc("weight of point_knn: neighbours close (Eq. 3)")
    w3: float = doc("weight of normal: predicted against true normals (Eq. 4)")
    w4: float = doc("weight of normal_orth: normals orthogonal to the surface (Eq. 5)")
    w5: float = doc("weight of normal_knn: normals of neighbours alike (Eq. 6)")
    k: int = doc("neighbours of the three neighbourhood terms")
    reduction: str = doc("mean (released code) or sum (the paper's equations)")
    point_term: str = doc("of w1: chamfer, or emd (Eq. 2, many times slower)")
    point_knn_in: str = doc("where point_knn takes neighbours: prediction (released code) or target (Eq. 3)")
    normal_pairs: str = doc("target: each with its nearest prediction (released code); prediction: the other way")
    orth: str = doc("cosine of normal_orth: absolute (released code) or signed (Eq. 5)")
    unit_normals: bool = doc("normalise predicted normals before the loss; the released code does not")
    near_ties: str = doc("of the nearest prediction: released (its rounding decides) or exact")
    w_repulsion: float = doc("weight of repulsion (PU-Net, EC-Net)")
    h: float = doc("reach of repulsion for 4096 target points in the unit sphere: squared for PU-Net, plain for EC-Net")
    w_edge: float = doc("weight of the distance of edge points to the edges (EC-Net)")
    w_edge_distance: float = doc("weight of the regressed distance to the nearest edge (EC-Net)")
    near: float = doc("regressed distance below which a point belongs to an edge (EC-Net)")
    reach: float = doc("distances to edges are truncated there (EC-Net)")
    w_cd: float = doc("weight of the Chamfer distance (PUGeo-Net)")
    w_coarse: float = doc("weight of the coarse normals (PUGeo-Net)")
    w_normal: float = doc("weight of the refined (PUGeo-Net) or predicted (loss=surface) normals")
    w_drift: float = doc("weight of the way from the surface point closest to the seed (loss=surface)")
    w_error: float = doc("weight of predicted against true distance (loss=surface)")


@dataclass
class Optimizer:
    """conf/optimizer: a class of torch.optim."""

    _target_: str = doc("class of torch.optim")
    _partial_: bool = doc("true: training adds the parameters")
    lr: float = doc("learning rate; the released code's is 5e-4")
    weight_decay: float = doc("pull of the weights to zero")
    betas: list[float] = doc("decay of the running means of gradient and square")
    momentum: float = doc("share of the last step that is kept")


@dataclass
class Scheduler:
    """conf/scheduler: a class of torch.optim.lr_scheduler, stepped after every training step."""

    _target_: str = doc("class of torch.optim.lr_scheduler")
    _partial_: bool = doc("true: training adds the optimizer, and total_steps or T_max where the class has it")
    max_lr: float = doc("highest learning rate")
    pct_start: float = doc("share of the steps in which the learning rate rises")
    div_factor: float = doc("highest over first learning rate")
    final_div_factor: float = doc("first over last learning rate")
    cycle_momentum: bool = doc("lower the momentum where the learning rate is high")
    eta_min: float = doc("last learning rate")
    step_size: int = doc("steps between two drops of the learning rate")
    gamma: float = doc("factor of a drop of the learning rate")


@dataclass
class Trainer:
    """conf/trainer: options of Lightning's Trainer."""

    _target_: str = doc("class of lightning.pytorch")
    max_epochs: int = doc("epochs at most; -1: no limit")
    max_steps: int = doc("training steps at most; -1: no limit")
    max_time: str | None = doc("time at most, days:hours:minutes:seconds, such as 00:12:00:00")
    accelerator: str = doc("cpu, gpu, auto ...")
    devices: Any = doc("number of devices, list of their numbers, or auto")
    num_nodes: int = doc("machines")
    strategy: str = doc("auto, ddp, ddp_spawn ...")
    precision: str = doc("32-true, bf16-mixed, 16-mixed, 64-true ...")
    sync_batchnorm: bool = doc("batch statistics over all devices")
    accumulate_grad_batches: int = doc("batches for one step of the optimizer")
    gradient_clip_val: float | None = doc("largest norm of the gradient; null: no limit")
    limit_train_batches: int | float = doc("batches of an epoch: number, or share")
    limit_val_batches: int | float = doc("validation batches: number, or share")
    limit_test_batches: int | float = doc("test batches: number, or share")
    check_val_every_n_epoch: int | None = doc("epochs from one validation to the next; null: count steps instead")
    val_check_interval: int | float = doc("steps from one validation to the next, or share of an epoch")
    overfit_batches: int | float = doc("train and validate on the same few batches; 0: off")
    deterministic: bool = doc("refuse operations that are not deterministic (GPU)")
    benchmark: bool = doc("let cuDNN choose the fastest kernels (GPU)")
    detect_anomaly: bool = doc("find the operation that made a NaN; slow")
    profiler: str | None = doc("simple, advanced, pytorch")


@dataclass
class Checkpoints:
    """Saves checkpoints/last.ckpt at intervals and checkpoints/best.ckpt when validation is best."""

    _target_: str = doc("class of pnu.callbacks")
    every_n_steps: int = doc("training steps between two last.ckpt; 0: count time only")
    every_minutes: float = doc("minutes between two last.ckpt; 0: count steps only")
    monitor: str = doc("validation value that is best when smallest")


@dataclass
class Pictures:
    """Shows the same few validation clouds as 3D clouds and pictures."""

    _target_: str = doc("class of pnu.callbacks")
    clouds: int = doc("validation clouds, each of another shape; 0: none")
    points: int = doc("points of a cloud in TensorBoard's 3D view at most")
    every: int = doc("validations from one picture to the next; the last one is always drawn")
    size: int = doc("pixels of a picture's side")


@dataclass
class EarlyStopping:
    """Stops when validation no longer gets better."""

    _target_: str = doc("class of lightning.pytorch.callbacks")
    monitor: str = doc("validation value that shall get smaller")
    patience: int = doc("validations without a better value before it stops")
    min_delta: float = doc("smallest change that counts as better")
    check_on_train_epoch_end: bool = doc("false: look after each validation")


@dataclass
class Callbacks:
    """conf/callbacks: what happens beside the training steps."""

    checkpoints: Checkpoints = doc("Checkpoints")
    pictures: Pictures = doc("Pictures of validation clouds")
    early_stopping: EarlyStopping = doc("Early stopping")


@dataclass
class Logger:
    """conf/logger: where curves go."""

    _target_: str = doc("class of lightning.pytorch.loggers")
    name: str = doc("folder between the run's folder and version")
    version: str = doc("folder of the events in the run's folder")
    default_hp_metric: bool = doc("false: the final metrics are the hyperparameters' metrics")
