"""A run folder read frame by frame: however long the recording, only a block of it is in memory.

Compressed arrays are inflated as they are read; trajectories in text are parsed line by line.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import islice, pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from fusion.frame_blocks import FrameBlock
from fusion.result import Refinement
from fusion.run_folder import read_summary
from fusion.run_states import AGAIN, SHAPES, read_header
from vio import se3
from vio.alignment import associate
from vio.calibration import short_name
from vio.errors import FormatError, TrajectoryError, VioError
from vio.motions import UNREADABLE
from vio.trajectory import Trajectory

Array = NDArray[np.float64]

ROWS = {"t": (), "T_world_body": (4, 4), "cov": (6, 6), **SHAPES}
"""What `trajectory.npz` holds of every frame."""
MATCH_S = 0.01
"""Truth this near to a frame in time is that frame's (`vio.alignment.associate`)."""
READ_BYTES = 1 << 20
QUATERNION_LENGTH = 1e-3


class RunFrames:
    """The frames of a run folder.

    Raises:
        FormatError: a file is missing, damaged, or not what it claims; also while blocks are read.
    """

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)
        self._name = short_name(self._folder / "trajectory.npz")
        summary = read_summary(self._folder)
        with ExitStack() as stack:
            self._count = _NpzRows(stack, self._folder / "trajectory.npz", self._name).count
        self._header = read_header(self._folder, summary, next(self.blocks((0, 1))), self._count)

    @property
    def header(self) -> Refinement:
        """The refinement's conclusions, with the states of the first frame alone."""
        return self._header

    @property
    def has_truth(self) -> bool:
        """Whether the run holds truth."""
        return (self._folder / "truth.tum").is_file()

    def __len__(self) -> int:
        return self._count

    def blocks(self, edges: Sequence[int]) -> Iterator[FrameBlock]:
        """Blocks between consecutive edges, which rise from 0 to the number of frames."""
        with ExitStack() as stack:
            rows = _NpzRows(stack, self._folder / "trajectory.npz", self._name)
            motions = _TumRows(stack, self._folder / "motions_only.tum")
            truth = _TumRows(stack, self._folder / "truth.tum") if self.has_truth else None
            last, waiting = -np.inf, None
            for first, end in pairwise(edges):
                values = rows.read(end - first)
                refined = self._trajectory(values)
                if not refined.t_s[0] > last:
                    raise FormatError(f"{self._name}: frame {first} is not later than the one before; {AGAIN}")
                last = float(refined.t_s[-1])
                only = motions.read(end - first)
                if only is None or len(only) != end - first:
                    raise FormatError(f"{motions.name}: ends before frame {end - 1} of {self._name}; {AGAIN}")
                covered, matched = np.zeros(0, np.int64), None
                if truth is not None:
                    waiting = truth.until(waiting, last + MATCH_S)
                    covered, matched, waiting = _matched(refined, waiting)
                yield FrameBlock(first, refined, only, values["gyro_bias"], values["accel_bias"], values["log_scale"],
                                 values["log_scale_sd"], covered, matched)

    def _trajectory(self, values: Mapping[str, Array]) -> Trajectory:
        try:
            return Trajectory(values["t"], values["T_world_body"], values["cov"])
        except VioError as error:
            raise FormatError(f"{self._name}: {error}; {AGAIN}") from None


class _NpzRows:
    """Rows of several arrays of an npz, read side by side."""

    def __init__(self, stack: ExitStack, path: Path, name: str) -> None:
        self.name, self.count = name, 0
        try:
            archive = stack.enter_context(zipfile.ZipFile(path))
            self._members = {key: self._open(stack, archive, key, shape) for key, shape in ROWS.items()}
        except FileNotFoundError:
            raise FormatError(f"{name}: no such file; give a folder written by `capsule-vio refine`") from None
        except (OSError, *UNREADABLE) as error:
            raise _unreadable(name, error) from None

    def _open(self, stack: ExitStack, archive: zipfile.ZipFile, key: str, shape: tuple[int, ...]
              ) -> tuple[IO[bytes], np.dtype[Any], tuple[int, ...]]:
        if f"{key}.npy" not in archive.NameToInfo:
            raise FormatError(f"{self.name}: missing key '{key}'; {AGAIN}")
        member = stack.enter_context(archive.open(f"{key}.npy"))
        version = np.lib.format.read_magic(member)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        found, fortran, dtype = read(member)
        self.count = self.count or (found[0] if found else 0)
        if found != (self.count, *shape) or self.count == 0 or dtype.kind != "f" or (fortran and len(found) > 1):
            raise FormatError(f"{self.name}: {key} has shape {found} of {dtype}, expected one entry of shape {shape} "
                              f"per frame; {AGAIN}")
        return member, dtype, shape

    def read(self, count: int) -> dict[str, Array]:
        """The next `count` rows of every array."""
        return {key: self._read(key, *member, count) for key, member in self._members.items()}

    def _read(self, key: str, member: IO[bytes], dtype: np.dtype[Any], shape: tuple[int, ...], count: int) -> Array:
        size = count * int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        data = bytearray()
        try:
            while len(data) < size and (part := member.read(min(READ_BYTES, size - len(data)))):
                data += part
        except (OSError, *UNREADABLE) as error:
            raise _unreadable(self.name, error) from None
        if len(data) < size:
            raise FormatError(f"{self.name}: {key} is cut off; {AGAIN}")
        values = np.frombuffer(data, dtype).reshape(count, *shape).astype(float)
        if not np.isfinite(values).all():
            raise FormatError(f"{self.name}: {key} holds numbers that are not finite; {AGAIN}")
        return values


class _TumRows:
    """Poses of a TUM file, in order."""

    def __init__(self, stack: ExitStack, path: Path) -> None:
        self.name = short_name(path)
        try:
            file = stack.enter_context(path.open(encoding="utf-8"))
        except OSError:
            raise FormatError(f"{self.name}: no such file; give a folder written by `capsule-vio refine`") from None
        self._lines = (line for line in file if line.strip() and not line.startswith("#"))

    def read(self, count: int) -> Trajectory | None:
        """At most `count` more poses; None at the end."""
        try:
            rows = list(islice(self._lines, count))
            if not rows:
                return None
            values = np.loadtxt(rows, ndmin=2)
            if values.shape[1] != 8:
                raise ValueError(f"{values.shape[1]} columns instead of 8")
            off = np.abs(np.linalg.norm(values[:, 4:], axis=1) - 1)
            if not (off < QUATERNION_LENGTH).all():
                raise ValueError("a quaternion is not of unit length")
            return Trajectory(values[:, 0], se3.transform(se3.matrix_from_quat_xyzw(values[:, 4:]), values[:, 1:4]))
        except (ValueError, VioError) as error:
            raise FormatError(f"{self.name}: {str(error).splitlines()[0]}; {AGAIN}") from None

    def until(self, waiting: Trajectory | None, time_s: float, count: int = 1024) -> Trajectory | None:
        """What waits already, and more, until the last pose is later than a time or there are no more."""
        parts = [] if waiting is None else [waiting]
        while not parts or parts[-1].t_s[-1] <= time_s:
            more = self.read(count)
            if more is None:
                break
            parts.append(more)
        if not parts:
            return None
        return Trajectory(np.concatenate([p.t_s for p in parts]), np.concatenate([p.T_world_body for p in parts]))


def _matched(refined: Trajectory, waiting: Trajectory | None
             ) -> tuple[NDArray[np.int64], Trajectory | None, Trajectory | None]:
    """Frames that truth covers, truth at them, and truth that later frames may need."""
    nothing: NDArray[np.int64] = np.zeros(0, np.int64)
    if waiting is None:
        return nothing, None, None
    later = np.flatnonzero(waiting.t_s > refined.t_s[-1])
    rest = waiting.select(later) if len(later) else None
    try:
        found, truth = associate(refined, waiting, MATCH_S)
    except TrajectoryError:  # truth does not reach these frames
        return nothing, None, rest
    return np.searchsorted(refined.t_s, found.t_s).astype(np.int64), truth, rest


def _unreadable(name: str, error: BaseException) -> FormatError:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return FormatError(f"{name}: not a readable npz without pickles ({reason}); {AGAIN}")
