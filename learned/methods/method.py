"""A method: a depth network, a pose network and, where there is vibration, a branch that is fused into both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from learned.errors import NetworkInputError
from learned.methods.config import SIZE_STEP, SMALLEST_SIZE, MethodConfig
from learned.methods.output import DepthPyramid, MethodOutput
from learned.methods.parametrisation import typical_depth
from learned.networks.depth_network import DepthNetwork
from learned.networks.intrinsics_head import IntrinsicsHead
from learned.networks.pair_network import FlowNetwork, PairMotion, PairNetwork
from learned.networks.vibration_branch import VibrationBranch


@dataclass(frozen=True)
class Networks:
    """The vision networks of a method."""

    depth: DepthNetwork
    pose: PairNetwork
    optical_flow: FlowNetwork | None = None
    """Pixels of the second image → where they are in the first, (N, 2, h, w) per scale [px]; training only."""
    appearance_flow: FlowNetwork | None = None
    """What lighting adds to the second image to look like the first, (N, 3, h, w) per scale in -1..1; training only."""
    intrinsics: IntrinsicsHead | None = None
    intrinsics_from: str = "encoder"
    """Which map of the pose network the head reads: "encoder" or "decoder"."""


class Method(nn.Module):
    """Frames and vibration → depth and motion.

    All frames pass the depth network as one batch, and all pairs the pose network, so batch norms see them together.

    Args:
        config: the method's decisions.
        networks: its vision networks; branch and fusions are added here, after them, so that with one seed the vision
            starts the same with and without vibration.
    """

    def __init__(self, config: MethodConfig, networks: Networks) -> None:
        super().__init__()
        self.config = config
        self.depth, self.pose = networks.depth, networks.pose
        self.optical_flow, self.appearance_flow = networks.optical_flow, networks.appearance_flow
        self.intrinsics, self.intrinsics_from = networks.intrinsics, networks.intrinsics_from
        self.branch = VibrationBranch(config.branch) if config.vibration else None
        self.pose_branch = None if self.branch is None or config.shared_branch else VibrationBranch(config.branch)
        if self.branch is not None:
            self.depth.add_fusion(config.fusion, self.branch.features)
            self.pose.add_fusion(config.fusion, self.branch.features)

    def forward(
        self,
        frames: Tensor,
        vibration: Tensor | None = None,
        *,
        depth_frames: Sequence[int] | None = None,
        pairs: Sequence[tuple[int, int]] | None = None,
    ) -> MethodOutput:
        """Depth of frames and motions of pairs.

        Args:
            frames: (B, F, 3, H, W) in 0..1, channels R, G, B; F = 3 in training, 2 for a pair.
            vibration: (B, 6, 40) one window for all frames, or (B, F, 6, 40) one per frame; gyro [rad/s], then specific
                force [m/s²]. A pair uses the window of its earlier frame. None for a vision-only method.
            depth_frames: whose depth; None = as configured, `()` = none. Motions in depths (`PoseParametrisation`)
                bring the depth of their first frames with them.
            pairs: which T_i_j; None = as configured, `()` = none.

        Raises:
            NetworkInputError: shapes that do not fit, or vibration missing or not wanted.
        """
        depth_frames = self.config.depth_frames if depth_frames is None else tuple(depth_frames)
        pairs = self.config.pairs if pairs is None else tuple(pairs)
        self._check(frames, vibration, [*depth_frames, *(k for pair in pairs for k in pair)])
        of_depth, of_pose = self._vibration_features(vibration, frames.shape[1])
        if self.config.pose.in_depths:
            depth_frames = tuple(sorted({*depth_frames, *(i for i, _ in pairs)}))
        depth, snr_depth = self._depths(frames, of_depth, depth_frames)
        motions, snr_pose, intrinsics = self._motions(frames, of_pose, pairs, depth)
        return MethodOutput(depth, motions, snr_depth, snr_pose, intrinsics)

    def fit_vibration_normalisation(self, windows: Tensor) -> None:
        """Set the branch's normalisation from training windows (N, 6, 40).

        Raises:
            NetworkInputError: a vision-only method.
            ConfigError: a channel that is constant or not finite.
        """
        if self.branch is None:
            raise NetworkInputError(f"{self.config.name}: vision-only, there is no vibration to normalise")
        for branch in (self.branch, self.pose_branch):
            if branch is not None:
                branch.fit_normalisation(windows)

    def _depths(
        self, frames: Tensor, features: Tensor | None, wanted: Sequence[int]
    ) -> tuple[dict[int, DepthPyramid], dict[int, Tensor]]:
        if not wanted:
            return {}, {}
        count = (len(frames), len(wanted))
        chosen = None if features is None else features[:, list(wanted)].flatten(0, 1)
        disparity, snr, nearness = self.depth(frames[:, list(wanted)].flatten(0, 1), chosen)
        scales = [torch.unflatten(x, 0, count) for x in disparity]
        depth = {}
        for n, k in enumerate(wanted):
            of_frame = tuple(x[:, n] for x in scales)
            nearer = None if nearness is None else torch.unflatten(nearness, 0, count)[:, n]
            depth[k] = DepthPyramid(of_frame, tuple(self.config.depth_range.depth(x) for x in of_frame), nearer)
        snrs = {} if snr is None else {k: torch.unflatten(snr, 0, count)[:, n] for n, k in enumerate(wanted)}
        return depth, snrs

    def _motions(
        self, frames: Tensor, features: Tensor | None, pairs: Sequence[tuple[int, int]], depth: dict[int, DepthPyramid]
    ) -> tuple[dict[tuple[int, int], Tensor], dict[tuple[int, int], Tensor], dict[tuple[int, int], Tensor]]:
        if not pairs:
            return {}, {}, {}
        chosen = None if features is None else features[:, [min(pair) for pair in pairs]]
        out: PairMotion = self.pose(frames, [self.config.pose.images(i, j) for i, j in pairs], chosen)
        typical = {i: typical_depth(depth[i].depth[0]) for i, _ in pairs} if self.config.pose.in_depths else {}
        T = self.config.pose.motions(out.raw, pairs, typical)
        motions = {pair: T[:, n] for n, pair in enumerate(pairs)}
        snr = {} if out.snr is None else {pair: out.snr[:, n] for n, pair in enumerate(pairs)}
        return motions, snr, self._intrinsics(out, pairs, (frames.shape[-2], frames.shape[-1]))

    def _intrinsics(
        self, out: PairMotion, pairs: Sequence[tuple[int, int]], size: tuple[int, int]
    ) -> dict[tuple[int, int], Tensor]:
        maps = out.coarsest if self.intrinsics_from == "encoder" else out.hidden
        if self.intrinsics is None or maps is None:
            return {}
        K: Tensor = torch.unflatten(self.intrinsics(maps.flatten(0, 1), size), 0, maps.shape[:2])
        return {pair: K[:, n] for n, pair in enumerate(pairs)}

    def _vibration_features(self, vibration: Tensor | None, frames: int) -> tuple[Tensor | None, Tensor | None]:
        """Features (B, F, D) for the depth and for the pose network; every window passes a branch once."""
        if self.branch is None or vibration is None:
            return None, None
        of_depth = _per_frame(self.branch, vibration, frames)
        return of_depth, of_depth if self.pose_branch is None else _per_frame(self.pose_branch, vibration, frames)

    def _check(self, frames: Tensor, vibration: Tensor | None, used: Sequence[int]) -> None:
        name = self.config.name
        if frames.ndim != 5 or frames.shape[2] != 3 or not torch.is_floating_point(frames):
            raise NetworkInputError(f"{name}: frames of shape {tuple(frames.shape)}, {frames.dtype}; expected "
                                    "(B, F, 3, H, W) of floats in 0..1")
        height, width = frames.shape[-2:]
        if height % SIZE_STEP or width % SIZE_STEP or min(height, width) < SMALLEST_SIZE:
            raise NetworkInputError(f"{name}: frames of {width} x {height} pixels; both must be divisible by "
                                    f"{SIZE_STEP} and at least {SMALLEST_SIZE}, resize them")
        if any(not 0 <= k < frames.shape[1] for k in used):
            raise NetworkInputError(f"{name}: frames {sorted(set(used))} are wanted, there are {frames.shape[1]}")
        if self.branch is None and vibration is not None:
            raise NetworkInputError(f"{name}: vision-only, give no vibration or build it with vibration=True")
        if self.branch is not None and vibration is None:
            raise NetworkInputError(f"{name}: the vibration is missing; give IMU windows, or build it with "
                                    "vibration=False")
        if vibration is not None and (vibration.ndim not in (3, 4) or len(vibration) != len(frames)
                                      or (vibration.ndim == 4 and vibration.shape[1] != frames.shape[1])):
            raise NetworkInputError(f"{name}: vibration of shape {tuple(vibration.shape)} for frames of shape "
                                    f"{tuple(frames.shape)}; expected (B, 6, 40) or (B, F, 6, 40)")


def _per_frame(branch: VibrationBranch, vibration: Tensor, frames: int) -> Tensor:
    if vibration.ndim == 3:
        shared: Tensor = branch(vibration)
        return shared[:, None].expand(-1, frames, -1)
    each: Tensor = branch(vibration.flatten(0, 1))
    return torch.unflatten(each, 0, vibration.shape[:2])
