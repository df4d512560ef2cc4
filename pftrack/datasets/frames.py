"""Frames of a sequence, read one at a time, so that memory does not grow with the length of the film.

Every class here behaves like a list of ``(H, W, 3)`` uint8 pictures in BGR order: it has a length, an index (also
negative), slices (which are lazy too) and iteration.
"""

from __future__ import annotations

import os
import threading
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm"}


class EndOfFilm(ValueError):
    """A video ended before the number of frames that it announces."""


class Frames(Sequence):
    """A lazy list of frames; subclasses say how many there are and how to read one."""

    def __iter__(self) -> Iterator[np.ndarray]:
        """Read the frames in order; a video that ends early ends the iteration."""
        for index in range(len(self)):
            try:
                frame = self.read(index)
            except EndOfFilm:
                return
            yield frame

    @abstractmethod
    def read(self, index: int) -> np.ndarray:
        """Return the frame at a non-negative index below the length."""

    def __getitem__(self, index):
        """Return one frame, or a lazy view for a slice."""
        if isinstance(index, slice):
            return Selection(self, range(len(self))[index])
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        return self.read(index % len(self))


class Selection(Frames):
    """Some of the frames of another list, by their indices; still read one at a time."""

    def __init__(self, frames: Frames, indices: range):
        self.frames, self.indices = frames, indices

    def __len__(self) -> int:
        return len(self.indices)

    def read(self, index: int) -> np.ndarray:
        """Read the frame that the selection holds at this index."""
        return self.frames.read(self.indices[index])


def light(index: int, n_frames: int, illumination: float) -> float:
    """Return what is left of the light in a frame, when it fades evenly from 1 to ``1 - illumination``."""
    return 1 - illumination * index / max(n_frames - 1, 1)


class Dimmed(Frames):
    """The frames of another list in fading light; still read one at a time.

    Parameters
    ----------
    frames : Frames
        The frames as they are.
    illumination : float
        Share of the light that is gone by the last frame, from 0 to below 1; it goes evenly.

    Raises
    ------
    ValueError
        If `illumination` is out of its range.
    """

    def __init__(self, frames: Frames, illumination: float):
        if not 0 <= illumination < 1:
            raise ValueError(f"illumination must lie in [0, 1), got {illumination}")
        self.frames, self.illumination = frames, illumination

    def __len__(self) -> int:
        return len(self.frames)

    def read(self, index: int) -> np.ndarray:
        """Read a frame and darken it."""
        return cv2.convertScaleAbs(self.frames.read(index), alpha=light(index, len(self), self.illumination))


def image_paths(folder: Path) -> list[Path]:
    """List the image files of a folder in the order of their names; nothing if there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)


class ImageFrames(Frames):
    """Frames stored as one image file each.

    Parameters
    ----------
    paths : sequence of path
        The files, in order.

    Raises
    ------
    FileNotFoundError
        If there are none.
    """

    def __init__(self, paths):
        self.paths = [Path(path) for path in paths]
        if not self.paths:
            raise FileNotFoundError("there are no image files to read")

    @classmethod
    def from_folder(cls, folder: str | os.PathLike) -> ImageFrames:
        """Take all image files of a folder, in the order of their names.

        Raises
        ------
        FileNotFoundError
            If the folder does not exist or holds no images.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise FileNotFoundError(f"there is no folder {folder}")
        paths = image_paths(folder)
        if not paths:
            raise FileNotFoundError(f"the folder {folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))})")
        return cls(paths)

    def __len__(self) -> int:
        return len(self.paths)

    def read(self, index: int) -> np.ndarray:
        """Decode one image file.

        Raises
        ------
        FileNotFoundError
            If the file has gone.
        ValueError
            If it is not an image or is damaged.
        """
        path = self.paths[index]
        if not path.is_file():
            raise FileNotFoundError(f"the frame {path} does not exist")
        data = path.read_bytes()
        is_jpeg = data.startswith(b"\xff\xd8")  # OpenCV would fill the rest of a half JPEG with grey
        whole = not is_jpeg or data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda")  # the end follows the last scan
        frame = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data and whole else None
        if frame is None:
            raise ValueError(f"{path} cannot be decoded as an image; it may be damaged or incomplete")
        return frame


class VideoFrames(Frames):
    """Frames of a video file, decoded in order; going back starts again from the beginning.

    Containers seek to inexact positions, so frames are reached by decoding up to them: walking forward is cheap,
    jumping back is slow, and frame `i` is always the `i`-th picture of the film.

    Parameters
    ----------
    path : path
        Any file that OpenCV can decode.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it cannot be opened as a video, or not a single frame can be decoded.

    Notes
    -----
    The length is what the file announces. A film may end before it; iteration then simply stops, and reading a frame
    beyond the real end raises :class:`EndOfFilm`, a ``ValueError``.
    """

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"there is no video file {self.path}")
        self._lock = threading.Lock()
        self._capture = None
        self._rewind()
        first = self._decode()
        if first is None:
            raise ValueError(f"{self.path} cannot be decoded as a video; it may be damaged or no video at all")
        self.shape = first.shape
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        self.fps = float(fps) if np.isfinite(fps) and 0 < fps <= 1000 else 25.0
        announced = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self._length = int(announced) if 0 < announced < 1e9 else self._count()

    def _rewind(self) -> None:
        if self._capture is not None:
            self._capture.release()
        self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        self._next = 0

    def _decode(self) -> np.ndarray | None:
        decoded, frame = self._capture.read()
        self._next += 1
        return frame if decoded else None

    def _count(self) -> int:
        """Count the frames of a stream that announces no number, by decoding them all once."""
        self._rewind()
        n_frames = 0
        while self._capture.grab():
            n_frames += 1
        self._rewind()
        return n_frames

    def __len__(self) -> int:
        return self._length

    def read(self, index: int) -> np.ndarray:
        """Decode up to a frame and return it.

        Raises
        ------
        EndOfFilm
            If the film ends before that frame. It is a ``ValueError``.
        """
        with self._lock:
            if index < self._next:
                self._rewind()
            while self._next < index:
                self._next += 1
                if not self._capture.grab():
                    break
            frame = self._decode()
            if frame is None:
                self._rewind()
                raise EndOfFilm(f"{self.path} ends before frame {index}, though it announces {len(self)}")
            return frame


def open_frames(source: str | os.PathLike) -> ImageFrames | VideoFrames:
    """Open a folder of images or a video file.

    Parameters
    ----------
    source : path
        A folder (its images in name order) or a video file.

    Raises
    ------
    FileNotFoundError
        If there is nothing at that path, or the folder holds no images.
    ValueError
        If the file is no video.
    """
    path = Path(source)
    if path.is_dir():
        return ImageFrames.from_folder(path)
    return VideoFrames(path)
