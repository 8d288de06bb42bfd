"""Pictures as PNG files, written and read by a few threads; only a few are in memory at a time."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from recorder.formats import FormatError

Image = npt.NDArray[np.uint8]

THREADS = 2
MAX_WAITING = 8
# Half the time of zlib's default strategy and smaller files: noise has no repeats to look for. OpenCV 4 has no filters.
FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
if hasattr(cv2, "IMWRITE_PNG_FILTER"):
    FAST += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG]

T = TypeVar("T")
R = TypeVar("R")


class PngWriter:
    """Writes PNG files behind the back of its user, who learns of an error with a later picture or at the end."""

    def __init__(self) -> None:
        """Nothing is open but the threads."""
        self._pool = ThreadPoolExecutor(THREADS)
        self._waiting: deque[Future[None]] = deque()

    def write(self, path: Path, image: Image) -> None:
        """Write one picture into a new file; waits when the others are far behind. Raises OSError."""
        if len(self._waiting) >= MAX_WAITING:
            self._waiting.popleft().result()
        self._waiting.append(self._pool.submit(_write, path, image))

    def __enter__(self) -> "PngWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._pool.shutdown(cancel_futures=error is not None)
        if error is None:
            for future in self._waiting:
                future.result()


def _write(path: Path, image: Image) -> None:
    with path.open("xb") as file:
        file.write(encode_png(image))


def encode_png(image: Image) -> bytes:
    """The bytes of a PNG file."""
    return cv2.imencode(".png", image, FAST)[1].tobytes()


def map_ahead(work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """`work` of each item in order, a few done ahead in threads."""
    with ThreadPoolExecutor(THREADS) as pool:
        waiting: deque[Future[R]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) >= MAX_WAITING:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def read_image(path: Path) -> Image:
    """A picture file: (height, width) gray or (height, width, 3) blue, green, red; of 16 bits the upper eight.

    Raises FormatError.
    """
    try:
        data = np.fromfile(path, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except (OSError, cv2.error) as error:
        raise FormatError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise FormatError(f"{path}: not a picture that can be read (PNG, 8 or 16 bit); is the file whole?")
    if image.dtype == np.uint16:
        image = image >> 8
    if image.ndim == 3:
        image = image[:, :, :3] if image.shape[2] >= 3 else image[:, :, 0]
    return np.ascontiguousarray(image, np.uint8)
