"""Tracks: which image point was seen where in which frame. The table between tracking and odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio.errors import TrackingError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Tracks:
    """O observations, sorted by frame and then by track. Made by `tracks_from_table`."""

    frame: Ints
    """(O,) frame index, 0 to n_frames - 1."""
    track: Ints
    """(O,) identity of the tracked point; at most one observation per frame."""
    pixel: Array
    """(O, 2) column and row."""
    n_frames: int
    """Length of the recording the frames belong to."""

    def __len__(self) -> int:
        return len(self.frame)

    def select_frames(self, index: ArrayLike) -> Tracks:
        """Only the observations in the given frames (increasing), which are renumbered 0, 1, 2, ...

        Raises:
            TrackingError: an index outside the recording, or indices that do not increase.
        """
        index = check_frame_indices(index, self.n_frames)
        new = np.full(self.n_frames, -1)
        new[index] = np.arange(len(index))
        keep = new[self.frame] >= 0
        return Tracks(new[self.frame[keep]], self.track[keep], self.pixel[keep], len(index))


def check_frame_indices(index: ArrayLike, n_frames: int) -> Ints:
    """Return the frame indices (K,) as int64.

    Raises:
        TrackingError: fewer than two, one outside 0..n_frames - 1, or not strictly increasing.
    """
    index = np.asarray(index)
    if index.ndim != 1 or not np.issubdtype(index.dtype, np.integer):
        raise TrackingError(f"frame indices: expected whole numbers of shape (K,), found {index.dtype} {index.shape}")
    if len(index) < 2:
        raise TrackingError(f"frame indices: {len(index)} given; a motion needs at least 2 frames")
    if index.min() < 0 or index.max() >= n_frames:
        raise TrackingError(f"frame indices reach from {index.min()} to {index.max()}; the tracks cover frames 0 to "
                            f"{n_frames - 1}")
    if (np.diff(index) <= 0).any():
        k = int(np.argmax(np.diff(index) <= 0)) + 1
        raise TrackingError(f"frame indices[{k}] = {index[k]} does not follow {index[k - 1]}; sort, drop duplicates")
    return index.astype(np.int64)


def tracks_from_table(frame: ArrayLike, track: ArrayLike, pixel: ArrayLike, n_frames: int | None = None) -> Tracks:
    """Tracks from any observation table, in any order; made here or by another tracker.

    Args:
        frame: (O,) frame indices.
        track: (O,) identities, any integers.
        pixel: (O, 2) column and row.
        n_frames: length of the recording; one more than the last frame seen when None.

    Raises:
        TrackingError: shapes disagree, a pixel is not finite, a frame lies outside the recording, or a track is seen
            twice in one frame.
    """
    frame, track, pixel = np.asarray(frame), np.asarray(track), np.asarray(pixel, float)
    n = len(frame) if frame.ndim == 1 else -1
    if frame.shape != (n,) or track.shape != (n,) or pixel.shape != (n, 2):
        raise TrackingError(f"tracks: shapes frame {frame.shape}, track {track.shape}, pixel {pixel.shape}; expected "
                            "(O,), (O,), (O, 2)")
    if n and not (np.issubdtype(frame.dtype, np.integer) and np.issubdtype(track.dtype, np.integer)):
        raise TrackingError(f"tracks: frame is {frame.dtype} and track {track.dtype}; both must be whole numbers")
    finite = np.isfinite(pixel).all(axis=1)
    if not finite.all():
        raise TrackingError(f"tracks: pixel of row {np.argmin(finite)} is not finite; drop that row")
    last = int(frame.max(initial=-1))
    n_frames = last + 1 if n_frames is None else n_frames
    if n and (frame.min() < 0 or last >= n_frames):
        raise TrackingError(f"tracks: frames {frame.min()} to {last} do not fit a recording of {n_frames} frames")
    order = np.lexsort((track, frame))
    frame, track, pixel = frame[order].astype(np.int64), track[order].astype(np.int64), pixel[order]
    twice = (np.diff(frame) == 0) & (np.diff(track) == 0)
    if twice.any():
        k = int(np.argmax(twice))
        raise TrackingError(f"tracks: track {track[k]} is seen twice in frame {frame[k]}; keep one of the two")
    return Tracks(frame, track, pixel, int(n_frames))
