"""Tags in a stream of pictures, found in several processes once there are many pictures."""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from itertools import islice

import numpy as np

from alidade.pipelines.parallel import allowed
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.tags import Detections, Picture, detect

UNREADABLE = "picture does not decode"

# Pictures below which starting processes, a second or so, is not worth while.
_MANY = 100
# Pictures under way for each process: memory does not grow with their number.
_AHEAD = 4


def detections(
    images: Iterable[tuple[int, bytes]], family: str = "36h11", camera: Camera | None = None
) -> Iterator[tuple[int, Detections | None]]:
    """Stamps and what `detect` finds, in the order of the pictures; None where one does not decode.

    Raises InputError as `detect` does.
    """
    stream = iter(images)
    first = list(islice(stream, _MANY + 1)) if (jobs := allowed()) > 1 else []
    if len(first) <= _MANY:
        for t_ns, encoded in [*first, *stream] if first else stream:
            yield t_ns, _find(encoded, family, camera)
        return
    pool = ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _prepare)
    under_way: deque[tuple[int, Future[Detections | None]]] = deque()
    try:
        for part in (first, stream):
            for t_ns, encoded in part:
                under_way.append((t_ns, pool.submit(_find, encoded, family, camera)))
                if len(under_way) >= _AHEAD * jobs:
                    t, found = under_way.popleft()
                    yield t, found.result()
        while under_way:
            t, found = under_way.popleft()
            yield t, found.result()
    finally:
        pool.shutdown(cancel_futures=True)


def decode(encoded: bytes) -> Picture | None:
    """The grey picture in a PNG, JPEG, ... file; None when it does not decode."""
    import cv2

    data = np.frombuffer(encoded, dtype=np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    return None if picture is None else np.asarray(picture)


def _prepare() -> None:
    """One thread a process; an interruption is for the main process to handle."""
    import cv2

    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _find(encoded: bytes, family: str, camera: Camera | None) -> Detections | None:
    picture = decode(encoded)
    return None if picture is None else detect(picture, family, camera)
