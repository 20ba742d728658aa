"""Work on the parts of a cloud: in this process, or in several that have a device each.

Results come in the order of the parts. They don't depend on the number of processes, because each part is worked on
alone and cut the same way everywhere.
"""

import multiprocessing
import os
import pickle
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import count, repeat
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from types import TracebackType
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Work = Callable[[Tensor], Tensor]
"""What is made of one part."""
Begin = Callable[[Tensor], Work]
"""begin(cloud): the work on parts of this cloud; what all parts need, such as a tree, is made once."""


class Workers(Protocol):
    def map(self, cloud: Tensor, parts: Sequence[Tensor]) -> Iterator[Tensor]:
        """The work on each part of a cloud, in order."""


class Here:
    """Works in this process."""

    def __init__(self, begin: Begin) -> None:
        self.begin = begin
        self.cloud: Tensor | None = None

    def map(self, cloud: Tensor, parts: Sequence[Tensor]) -> Iterator[Tensor]:
        if cloud is not self.cloud:
            self.cloud, self.work = cloud, self.begin(cloud)
        return map(self.work, parts)


class Processes:
    """Works in processes of their own, one for each of `devices`; a context.

    make(device) -> Begin is pickled and called in each. Clouds go there through a file that all map, so they share its
    memory; parts and results through pipes. The threads of torch are shared out. An error becomes a `ValueError` of one
    line. A process ends with this one, however that ends.
    """

    def __init__(self, make: Callable[[str], Begin], devices: Sequence[str]) -> None:
        self.devices = devices
        context = multiprocessing.get_context("spawn")  # CUDA and threads do not survive a fork
        names = context.SimpleQueue()
        for device in devices:
            names.put(device)
        share = max(1, torch.get_num_threads() // len(devices))
        self.pool = ProcessPoolExecutor(len(devices), context, _start, (pickle.dumps(make), names, share))
        self.cloud: Tensor | None = None
        self.path, self.number = Path(), count()

    def __enter__(self) -> "Processes":
        self.folder = tempfile.TemporaryDirectory(prefix="pnu-")
        with sigint_ignored():  # so are then the processes: Ctrl-C, which goes to all, is left to this one
            for _ in self.devices:
                self.pool.submit(os.getpid)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self.pool.shutdown(cancel_futures=True)
        self.folder.cleanup()

    def map(self, cloud: Tensor, parts: Sequence[Tensor]) -> Iterator[Tensor]:
        if cloud is not self.cloud:
            self.cloud, self.path = cloud, Path(self.folder.name) / f"{next(self.number)}.npy"
            np.save(self.path, cloud.cpu().numpy())
        try:
            tasks = (part.cpu().numpy() for part in parts)
            yield from map(torch.from_numpy, self.pool.map(_work, repeat(str(self.path)), tasks))
        except BrokenProcessPool:
            raise ValueError(
                f"devices={len(self.devices)}: a process ended amid its work; with too little memory, take fewer. "
                'A script calls this under `if __name__ == "__main__":`'
            ) from None


@contextmanager
def sigint_ignored() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _Worker:
    """What one of the processes has: a device, and the work on the cloud that came last."""

    def __init__(self, make: bytes, device: str) -> None:
        self.make, self.device = make, device
        self.begin: Begin | None = None
        self.cloud = ""

    def __call__(self, cloud: str, part: NDArray) -> NDArray:
        try:
            if self.begin is None:
                self.begin = pickle.loads(self.make)(self.device)
            if cloud != self.cloud:
                self.work: Work = self.begin(torch.from_numpy(np.load(cloud, mmap_mode="c")))
                self.cloud = cloud
            return self.work(torch.from_numpy(part)).cpu().numpy()
        except ValueError:
            raise
        except Exception as error:
            text = (str(error).splitlines() or [""])[0]
            raise ValueError(f"{self.device}: {type(error).__name__}: {text}") from None


_worker: _Worker


def _start(make: bytes, names: "SimpleQueue[str]", threads: int) -> None:
    global _worker
    _worker = _Worker(make, names.get())
    torch.set_num_threads(threads)
    torch.set_grad_enabled(False)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(cloud: str, part: NDArray) -> NDArray:
    return _worker(cloud, part)
