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
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pnu.runtime.threads import thread_count, torch_if_loaded

Array = NDArray[Any]
Work = Callable[[Array], Array]
"""What is made of one part."""
Begin = Callable[[Any, Array], Work]
"""begin(network, cloud): the work on parts of this cloud; what all parts need, such as a tree, is made once."""


class Workers(Protocol):
    """Who works, each with a network."""

    def map(self, begin: Begin, cloud: Array, parts: Sequence[Array]) -> Iterator[Array]:
        """The work on each part of a cloud, in order. `begin` is the same object as long as the work is the same."""


class InProcess:
    """Works in this process."""

    def __init__(self, network: Any) -> None:
        self.network = network
        self.begun: tuple[Begin, Array] | None = None

    def map(self, begin: Begin, cloud: Array, parts: Sequence[Array]) -> Iterator[Array]:
        """See `Workers`."""
        if self.begun is None or self.begun[0] is not begin or self.begun[1] is not cloud:
            self.begun, self.work = (begin, cloud), begin(self.network, cloud)
        return map(self.work, parts)


class Processes:
    """Works in processes of their own, one for each of `devices`; a context.

    The network, which lies on the CPU, and what begins the work are pickled. Clouds go there through a file that all
    map, so they share its memory; parts and results through pipes. The threads are shared out. An error
    becomes a `ValueError` of one line. A process ends with this one, however that ends.
    """

    def __init__(self, network: Any, devices: Sequence[str]) -> None:
        self.devices = devices
        context = multiprocessing.get_context("spawn")  # CUDA and threads do not survive a fork
        names = context.SimpleQueue()
        for device in devices:
            names.put(device)
        share = max(1, thread_count() // len(devices))
        self.pool = ProcessPoolExecutor(len(devices), context, _start, (pickle.dumps(network), names, share))
        self.cloud: Array | None = None
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

    def map(self, begin: Begin, cloud: Array, parts: Sequence[Array]) -> Iterator[Array]:
        """See `Workers`; ValueError where a process ended amid its work."""
        if cloud is not self.cloud:
            self.cloud, self.path = cloud, Path(self.folder.name) / f"{next(self.number)}.npy"
            np.save(self.path, cloud)
        try:
            yield from self.pool.map(_work, repeat(pickle.dumps(begin)), repeat(str(self.path)), parts)
        except BrokenProcessPool:
            raise ValueError(
                f"devices={len(self.devices)}: a process ended amid its work; with too little memory, take fewer. "
                'A script calls this under `if __name__ == "__main__":`'
            ) from None


@contextmanager
def sigint_ignored() -> Iterator[None]:
    """Ctrl-C goes past this process, and those it starts."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _Worker:
    """What one of the processes has: a network on its device, and the work that came last."""

    def __init__(self, network: bytes, device: str) -> None:
        self.pickled, self.device = network, device
        self.network: Any = None
        self.begun = (b"", "")

    def __call__(self, begin: bytes, cloud: str, part: np.ndarray) -> np.ndarray:
        try:
            if self.network is None:
                self.network = pickle.loads(self.pickled)
                _settle_torch(int(os.environ["OMP_NUM_THREADS"]))
                self.network = self.network.to(self.device) if hasattr(self.network, "to") else self.network
            if (begin, cloud) != self.begun:
                self.work: Work = pickle.loads(begin)(self.network, np.load(cloud, mmap_mode="c"))
                self.begun = begin, cloud
            return self.work(part)
        except ValueError:
            raise
        except Exception as error:
            text = (str(error).splitlines() or [""])[0]
            raise ValueError(f"{self.device}: {type(error).__name__}: {text}") from None


_worker: _Worker


def _start(network: bytes, names: "SimpleQueue[str]", threads: int) -> None:
    global _worker
    _worker = _Worker(network, names.get())
    os.environ["OMP_NUM_THREADS"] = str(threads)  # what torch goes by too where it is loaded later
    _settle_torch(threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _settle_torch(threads: int) -> None:
    if torch := torch_if_loaded():
        torch.set_num_threads(threads)
        torch.set_grad_enabled(False)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(begin: bytes, cloud: str, part: np.ndarray) -> np.ndarray:
    return _worker(begin, cloud, part)
