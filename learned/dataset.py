"""Training items from recordings: three frames, the vibration around them, the gyro's rotations, the camera.

No item carries truth; `TripletDataset.truth` hands it out separately, for evaluation. Recordings may differ in their
cameras, in model too, for every item brings its own; frames within a recording may not, and are refused by name.

    dataset = TripletDataset(recordings, settings, "train", seed=1)
    sampler = DistributedSampler(dataset, 1, 0, seed=1)              # torch's own; shuffles by (seed, epoch)
    loader = DataLoader(dataset, 4, sampler=sampler, num_workers=4, collate_fn=collate)
    dataset.set_epoch(3); sampler.set_epoch(3)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from learned.camera_rays import CameraBatch, camera_batch
from learned.dihedral import SYMMETRIES, UPRIGHT, Symmetry
from learned.training_source import SourceSettings, TrainingSource
from learned.truth import Truth, truth_of
from vio.camera import Camera
from vio.errors import ConfigError, RecordingError
from vio.recording import Recording
from vio.trajectory import Trajectory

Split = Literal["train", "validation", "all"]
TRAIN_SHARE = 0.8


@dataclass(frozen=True)
class Triplet:
    """Three frames of one recording, `step` apart, and what the sensors say about them."""

    frames: Tensor
    """(3, 3, H, W) uint8, R, G, B."""
    usable: Tensor
    """(1, H, W) bool: neither vignette nor beyond the lens."""
    camera: Camera
    vibration: Tensor | None
    """(3, 6, n) float32, windows centred at each frame: gyro xyz [rad/s], specific force xyz [m/s²], body axes.
    The paper's one window per triplet is the first."""
    R_i_j_gyro: Tensor | None
    """(2, 3, 3) float32 integrated gyro from each frame to the next, camera axes."""
    step_s: Tensor
    """(2,) float32 seconds between the frames."""
    step_m: Tensor
    """(2,) float32 how far the camera moved between the frames according to a refined trajectory, NaN where no
    trajectory says."""
    recording: int
    """Number of the recording."""
    index: tuple[int, int, int]
    """Numbers of the frames in it."""


@dataclass(frozen=True)
class TripletBatch:
    """B triplets."""

    frames: Tensor
    """(B, 3, 3, H, W) uint8, R, G, B."""
    usable: Tensor
    """(B, 1, H, W) bool."""
    cameras: CameraBatch
    """B cameras."""
    vibration: Tensor | None
    """(B, 3, 6, n) float32."""
    R_i_j_gyro: Tensor | None
    """(B, 2, 3, 3) float32."""
    step_s: Tensor
    """(B, 2) float32."""
    step_m: Tensor
    """(B, 2) float32, NaN where no trajectory says."""
    recording: Tensor
    """(B,) int64."""
    index: Tensor
    """(B, 3) int64."""

    def __len__(self) -> int:
        return len(self.frames)

    @cached_property
    def images(self) -> Tensor:
        """(B, 3, 3, H, W) float32 in 0..1; made where the batch lies, so that bytes travel to a GPU as bytes."""
        return self.frames.float() / 255

    def to(self, device: torch.device | str, non_blocking: bool = False) -> TripletBatch:
        """The same batch on another device."""
        def move(value: Tensor) -> Tensor:
            return value.to(device, non_blocking=non_blocking)
        return replace(
            self, frames=move(self.frames), usable=move(self.usable), cameras=self.cameras.to(device),
            vibration=None if self.vibration is None else move(self.vibration),
            R_i_j_gyro=None if self.R_i_j_gyro is None else move(self.R_i_j_gyro),
            step_s=move(self.step_s), step_m=move(self.step_m), recording=move(self.recording), index=move(self.index))

    def pin_memory(self) -> TripletBatch:
        """The same batch in page-locked memory; called by torch's loader when it is asked to pin."""
        return replace(
            self, frames=self.frames.pin_memory(), usable=self.usable.pin_memory(),
            vibration=None if self.vibration is None else self.vibration.pin_memory(),
            R_i_j_gyro=None if self.R_i_j_gyro is None else self.R_i_j_gyro.pin_memory())


def collate(items: Sequence[Triplet]) -> TripletBatch:
    """Triplets as a batch, for torch's loader."""
    vibration = [item.vibration for item in items if item.vibration is not None]
    rotations = [item.R_i_j_gyro for item in items if item.R_i_j_gyro is not None]
    return TripletBatch(
        torch.stack([item.frames for item in items]), torch.stack([item.usable for item in items]),
        camera_batch([item.camera for item in items]),
        torch.stack(vibration) if vibration else None, torch.stack(rotations) if rotations else None,
        torch.stack([item.step_s for item in items]), torch.stack([item.step_m for item in items]),
        torch.tensor([item.recording for item in items]),
        torch.tensor([item.index for item in items]))


class TripletDataset(Dataset[Triplet]):
    """All triplets of some recordings.

    The same (seed, epoch, number) gives the same item, in whatever process. Triplets across a hole of the IMU stream
    are left out when items carry an IMU (`left_out` counts them), for their rotation is not known.

    Args:
        recordings: with images and calibrated cameras.
        settings: size, IMU, distance of the frames.
        split: the first 80 % of every recording's frames, the other 20 %, or all; the two share no frame.
        seed: of the augmentation.
        augment: show each item as one of its eight mirror images and quarter turns, drawn anew in every epoch;
            four where width and height differ. Images, intrinsics and inertial samples change together.
        trajectories: refined, of the body, one for each recording or None for it; None = none for any.

    Raises:
        RecordingError: a recording that cannot be trained on, or no triplet in all of them.
        ImuError: the IMU is absent or does not cover the frames.
        TrajectoryError: a trajectory of another time.
    """

    def __init__(self, recordings: Sequence[Recording], settings: SourceSettings | None = None,
                 split: Split = "train", seed: int = 0, augment: bool = True,
                 trajectories: Sequence[Trajectory | None] | None = None) -> None:
        if split not in get_args(Split):
            raise ConfigError(f"training data: split {split!r} is unknown; use one of {', '.join(get_args(Split))}")
        self.settings, self.seed, self.augment = settings or SourceSettings(), seed, augment
        if trajectories is not None and len(trajectories) != len(recordings):
            raise ConfigError(f"training data: {len(trajectories)} trajectories for {len(recordings)} recordings; give "
                              "one for each, None where there is none")
        paths = trajectories or [None] * len(recordings)
        self.sources = [TrainingSource(recording, self.settings, path)
                        for recording, path in zip(recordings, paths, strict=True)]
        self.left_out: Counter[str] = Counter()
        rows = []
        for number, source in enumerate(self.sources):
            middle, left_out = source.triplets(*frames_of_split(len(source.recording), split))
            self.left_out.update(left_out)
            rows.append(np.column_stack([np.full(len(middle), number), middle]))
        self._rows: NDArray[np.int64] = np.concatenate(rows) if rows else np.zeros((0, 2), np.int64)
        if len(self._rows) == 0:
            reasons = ", ".join(f"{count} for {reason}" for reason, count in self.left_out.items()) or "none left out"
            raise RecordingError(f"training data: no triplet in the {split} part of {len(self.sources)} recordings "
                                 f"({reasons}); give longer recordings")
        # In shared memory: loader workers that live on see the epoch change.
        self._epoch = torch.zeros((), dtype=torch.int64)
        self._epoch.share_memory_()  # type: ignore[no-untyped-call]

    def __len__(self) -> int:
        return len(self._rows)

    def set_epoch(self, epoch: int) -> None:
        """Draw the augmentation of another epoch; call it before iterating over a loader."""
        self._epoch.fill_(epoch)

    def __getitem__(self, number: int) -> Triplet:
        source, index = self._at(number)
        change = self.symmetry(number)
        vibration, rotations = None, None
        if self.settings.imu:
            windows = change.imu(source.vibration(index), source.R_body_camera)
            vibration = torch.from_numpy(windows).float().transpose(1, 2).contiguous()
            rotations = torch.from_numpy(change.rotation(source.rotations(index))).float()
        lengths = source.lengths(index)
        step_m = torch.full((2,), torch.nan) if lengths is None else torch.from_numpy(lengths).float()
        return Triplet(
            change.image(source.frames(index)).contiguous(), change.image(source.usable).contiguous(),
            change.camera(source.camera), vibration, rotations,
            torch.from_numpy(np.diff(source.recording.frame_t_s[index])).float(), step_m, int(self._rows[number, 0]),
            (int(index[0]), int(index[1]), int(index[2])))

    def windows(self, number: int) -> Tensor:
        """Vibration windows (3, 6, n) float32 of item `number`, as recorded: what a normalisation is fitted to."""
        source, index = self._at(number)
        return torch.from_numpy(source.vibration(index)).float().transpose(1, 2).contiguous()

    def symmetry(self, number: int) -> Symmetry:
        """How item `number` is shown in this epoch."""
        if not self.augment:
            return SYMMETRIES[0]
        rng = np.random.default_rng([self.seed, int(self._epoch), number])
        choices = SYMMETRIES if self.settings.width == self.settings.height else UPRIGHT
        return choices[rng.integers(len(choices))]

    def truth(self, number: int) -> Truth:
        """What is true of item `number` as it is shown in this epoch; for evaluation, never for training.

        Raises:
            RecordingError: the recording has no truth, or a depth image cannot be read.
            TrajectoryError: the truth does not cover the frames.
        """
        source, index = self._at(number)
        return truth_of(source.recording, index, source.camera).changed(self.symmetry(number))

    def _at(self, number: int) -> tuple[TrainingSource, NDArray[np.int64]]:
        if not 0 <= number < len(self):
            raise IndexError(f"item {number} of {len(self)}")
        recording, middle = self._rows[number]
        return self.sources[recording], middle + self.settings.step * np.array([-1, 0, 1])


def frames_of_split(frames: int, split: Split) -> tuple[int, int]:
    """First frame and end (exclusive) of a part of a recording: contiguous, and no frame in both."""
    cut = round(TRAIN_SHARE * frames)
    return {"train": (0, cut), "validation": (cut, frames), "all": (0, frames)}[split]
