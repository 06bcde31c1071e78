"""The number that training makes small, for every method: networks, then the method's own loss or the paper's.

No truth enters. What the gyro says about rotation is a measurement; it may take the network's place in the warp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.camera_rays import CameraBatch
from learned.dataset import TripletBatch
from learned.errors import NetworkInputError
from learned.lie import halfway, inverse, so3_log, transform
from learned.losses.appearance_flow import (
    AF_SFM,
    ENDODAC,
    AppearanceFlow,
    Registered,
    appearance_loss,
    flow_loss,
    register,
)
from learned.losses.consistency import ENDOSFM, MEASURED, PAPER, Consistency, consistency_loss
from learned.losses.masks import visible_from
from learned.losses.nearness import nearness_difference, search_nearness
from learned.losses.priors import depth_like_light, rotation_from_gyro
from learned.losses.resolution_adaptive import ResolutionAdaptive, resolution_adaptive_loss, scale_views
from learned.losses.snippet import Snippet, both_directions
from learned.losses.step_lengths import length_difference, told_by, with_length
from learned.losses.terms import LossTerms
from learned.methods import Method, MethodOutput, snr_summary
from learned.train_config import TrainConfig
from vio.errors import ConfigError

TARGET, SOURCES = 1, (0, 2)
FRAMES = (0, 1, 2)
SMALLEST_PYRAMID_PX = 32


class Objective(nn.Module):
    """A method together with its loss; `forward` is one stage of one training step.

    Args:
        method: what is trained.
        config: which loss, whose rotation, which weights.
    """

    def __init__(self, method: Method, config: TrainConfig) -> None:
        super().__init__()
        self.method, self.config = method, config
        native = config.loss == "native"
        self.with_flows = native and method.optical_flow is not None
        self.stages: tuple[str, ...] = ("flow", "motion") if self.with_flows else ("motion",)
        """Losses of one training step, in order; their weights are disjoint."""
        if config.needs_lengths and self._motion_loss() != self._consistency:
            raise ConfigError(f"training: refined lengths do not go with the loss of {config.method.name}; take "
                              "loss='paper', or length_from='network' and length_weight=0")
        if config.nearness_weight and (config.length_from != "refined" or method.depth.nearness is None):
            raise ConfigError("training: nearness_weight needs steps of known length (length_from='refined') and a "
                              "depth network with one number per image (whole_image); set it to 0, or give both")

    def train(self, mode: bool = True) -> Objective:
        """Train or eval mode; frozen batch norms stay in eval mode."""
        super().train(mode)
        if self.config.freeze_batch_norm:
            for module in self.modules():
                if isinstance(module, nn.modules.batchnorm._BatchNorm):
                    module.eval()
        return self

    def forward(self, batch: TripletBatch, step: int = 0, stage: str = "motion") -> tuple[Tensor, dict[str, Tensor]]:
        """The loss and its parts.

        Args:
            batch: triplets.
            step: number of the training step, for what fades in and for drawn views.
            stage: of `stages`.

        Raises:
            NetworkInputError: the batch lacks the inertial samples that the run needs.
        """
        if self.config.needs_imu and batch.R_i_j_gyro is None:
            raise NetworkInputError("training: the items carry no inertial samples; read recordings with an IMU "
                                    "(SourceSettings.imu), or train vision-only with rotation_from='network'")
        if stage == "flow":
            terms = self._flow(batch)
            return terms.total, dict(terms.parts)
        terms = self._motion_loss()(batch, step)
        return terms.total, dict(terms.parts)

    def _motion_loss(self) -> Callable[[TripletBatch, int], LossTerms]:
        if self.config.loss == "native":
            if self.with_flows:
                return self._appearance
            if self.config.method.name == "ra-depth":
                return self._resolution_adaptive
        return self._consistency

    def run(self, batch: TripletBatch, depth_frames: tuple[int, ...], pairs: tuple[tuple[int, int], ...] | None
            ) -> MethodOutput:
        """The networks on a batch, in the precision of the run."""
        vibration = batch.vibration if self.config.method.vibration else None
        device = batch.frames.device.type
        with torch.autocast(device, torch.bfloat16, enabled=self.config.precision == "bfloat16"):
            out: MethodOutput = self.method(batch.images, vibration, depth_frames=depth_frames, pairs=pairs)
        return out

    def _consistency(self, batch: TripletBatch, step: int) -> LossTerms:
        """L_p, L_s and L_g over all directed neighbours, the gyro's share, and the start from light."""
        out = self.run(batch, FRAMES, None)
        depth = torch.stack([out.depth[k].depth[0] for k in FRAMES], 1)
        motions = out.T_i_j if len(out.T_i_j) == 4 else both_directions(out.T_i_j)
        rotation = self._rotation_loss(out, batch)
        in_warp = {pair: self._in_warp(T.float(), pair, batch) for pair, T in motions.items()}
        in_warp = tied(in_warp) if self.config.tied_motions else in_warp
        if self.config.length_from == "refined":
            unit_m = self.config.length_unit_m
            in_warp = {pair: with_length(T, batch.step_m[:, min(pair)], unit_m) for pair, T in in_warp.items()}
        usable = batch.usable[:, None].expand(-1, 3, -1, -1, -1)
        snippet = Snippet(batch.images, depth, in_warp, batch.cameras, usable)
        settings = self._consistency_settings(batch)
        terms = consistency_loss(snippet, settings)
        parts = dict(terms.parts) | _snr(out) | {"gyro_rotation": rotation.detach(), "step_length": _length(motions)}
        total = terms.total + self.config.rotation_weight * rotation
        if self.config.length_weight:
            apart = self._length_loss(motions, depth, batch)
            total, parts["step_lengths"] = total + self.config.length_weight * apart, apart.detach()
        if self.config.nearness_weight:
            apart, parts["nearness_found"] = self._nearness_loss(snippet, out, batch, settings)
            total, parts["nearness"] = total + self.config.nearness_weight * apart, apart.detach()
        share = 1 - step / self.config.light_start_steps if self.config.light_start_steps else 0.0
        if share > 0 and self.training:
            light = depth_like_light(depth.flatten(0, 1), batch.images.flatten(0, 1))
            total, parts["light"] = (1 - share) * total + share * light, light.detach()
        return LossTerms(total, parts)

    def _consistency_settings(self, batch: TripletBatch) -> Consistency:
        settings = PAPER
        if self.config.loss == "native":
            settings = {"endosfmlearner": ENDOSFM, "gyro-correlation": MEASURED}.get(self.config.method.name, PAPER)
        if settings.levels > 1:
            size, levels = min(batch.frames.shape[-2:]), settings.levels
            while levels > 1 and (size >> (levels - 1) < SMALLEST_PYRAMID_PX):
                levels -= 1
            settings = replace(settings, levels=levels)
        return replace(settings, depth_kind=self.config.depth_kind, unit_depth_weight=self.config.unit_depth_weight)

    def _in_warp(self, T: Tensor, pair: tuple[int, int], batch: TripletBatch) -> Tensor:
        if self.config.rotation_from == "network":
            return T
        return transform(gyro_rotation(batch, pair), T[:, :3, 3].float())

    def _rotation_loss(self, out: MethodOutput, batch: TripletBatch) -> Tensor:
        """Mean L1 distance [rad] of the predicted rotations from the gyro's; 0 where there is none."""
        if batch.R_i_j_gyro is None:
            return batch.step_s.new_zeros(())
        each = [rotation_from_gyro(so3_log(T[:, :3, :3]), gyro_rotation(batch, pair)) for pair, T in out.T_i_j.items()]
        return torch.stack(each).mean()

    def _length_loss(self, motions: dict[tuple[int, int], Tensor], depth: Tensor, batch: TripletBatch) -> Tensor:
        """How far the network's step lengths are from the refined ones; depth (B, 3, 1, H, W)."""
        pairs = list(motions)
        depth_i = torch.cat([depth[:, i] for i, _ in pairs]) if self.config.method.pose.in_depths else None
        return length_difference(torch.cat([motions[pair] for pair in pairs]),
                                 torch.cat([batch.step_m[:, min(pair)] for pair in pairs]),
                                 self.config.length_unit_m, depth_i)

    def _nearness_loss(self, snippet: Snippet, out: MethodOutput, batch: TripletBatch, settings: Consistency
                       ) -> tuple[Tensor, Tensor]:
        """How far the images' nearness is from what a search finds, and the mean weight of what it found."""
        numbers = [out.depth[k].nearness for k in FRAMES]
        told = told_by(batch.step_m)
        found = search_nearness(snippet, {pair: told[:, min(pair)] for pair in snippet.motions}, settings)
        return nearness_difference(torch.stack([x for x in numbers if x is not None], 1), found), found.weight.mean()

    def _resolution_adaptive(self, batch: TripletBatch, step: int) -> LossTerms:
        generator = torch.Generator().manual_seed(1_000_003 * self.config.seed + step)
        images = batch.images
        views = scale_views(images[:, TARGET], images[:, list(SOURCES)], batch.cameras, generator, batch.usable)
        out = self.run(batch, (TARGET,), None)
        outs = [self.run(_of_view(batch, view.target), (0,), ()).depth[0] for view in (views[0], views[2])]
        depths = (outs[0].depth[0], out.depth[TARGET].depth[0], outs[1].depth[0])
        disparities = (outs[0].disparity[0], out.depth[TARGET].disparity[0], outs[1].disparity[0])
        settings = ResolutionAdaptive(depth_kind=self.config.depth_kind)
        terms = resolution_adaptive_loss(views, disparities, depths, self._from_target(out, batch), settings)
        return LossTerms(terms.total, dict(terms.parts) | _snr(out))

    def _flow(self, batch: TripletBatch) -> LossTerms:
        target, sources = batch.images[:, TARGET], batch.images[:, list(SOURCES)]
        return flow_loss(target, sources, self._flows(sources, target, True), self._appearance_settings())

    def _appearance(self, batch: TripletBatch, step: int) -> LossTerms:
        settings = self._appearance_settings()
        target, sources = batch.images[:, TARGET], batch.images[:, list(SOURCES)]
        with torch.no_grad():
            there, back = self._flows(sources, target, True)[0], self._flows(sources, target, False)[0]
            visible = visible_from(_full(back.flatten(0, 1), sources.shape[-2:])).view(
                *sources.shape[:2], 1, *sources.shape[-2:])
            registered = Registered(register(sources, there, settings), visible)
        out = self.run(batch, (TARGET,), None)
        pyramid = out.depth[TARGET]
        size = target.shape[-2:]
        terms = appearance_loss(
            target, sources, [_full(depth, size) for depth in pyramid.depth], pyramid.disparity,
            self._from_target(out, batch), _cameras(out, batch), self._light_changes(registered.image, target),
            registered, batch.usable, settings)
        return LossTerms(terms.total, dict(terms.parts) | _snr(out))

    def _appearance_settings(self) -> AppearanceFlow:
        base = ENDODAC if self.config.method.name == "endodac" else AF_SFM
        return replace(base, depth_kind=self.config.depth_kind)

    def _flows(self, sources: Tensor, target: Tensor, from_target: bool) -> list[Tensor]:
        """Per scale (B, S, 2, h, w): where pixels of the target lie in the sources, or the sources' in the target."""
        flat, wide = sources.flatten(0, 1), target.repeat_interleave(sources.shape[1], 0)
        assert self.method.optical_flow is not None
        maps = self.method.optical_flow(flat, wide) if from_target else self.method.optical_flow(wide, flat)
        return [torch.unflatten(x, 0, sources.shape[:2]) for x in maps]

    def _light_changes(self, registered: Tensor, target: Tensor) -> list[Tensor]:
        assert self.method.appearance_flow is not None
        flat, wide = registered.flatten(0, 1), target.repeat_interleave(registered.shape[1], 0)
        return [torch.unflatten(_full(x, target.shape[-2:]), 0, registered.shape[:2])
                for x in self.method.appearance_flow(flat, wide)]

    def _from_target(self, out: MethodOutput, batch: TripletBatch) -> Tensor:
        """`T_target_source` (B, S, 4, 4)."""
        both = both_directions(out.T_i_j)
        return torch.stack([self._in_warp(both[TARGET, source], (TARGET, source), batch) for source in SOURCES], 1)


def tied(motions: Mapping[tuple[int, int], Tensor]) -> dict[tuple[int, int], Tensor]:
    """One motion a pair: `T_i_j` (B, 4, 4) half-way between itself and the inverse of `T_j_i`, for both directions."""
    forward = {(i, j): halfway(T, inverse(motions[j, i])) for (i, j), T in motions.items() if i < j}
    return forward | {(j, i): inverse(T) for (i, j), T in forward.items()}


def gyro_rotation(batch: TripletBatch, pair: tuple[int, int]) -> Tensor:
    """`R_i_j` (B, 3, 3) of neighbouring frames i and j of the triplets, integrated from the gyro."""
    assert batch.R_i_j_gyro is not None
    forward = batch.R_i_j_gyro[:, min(pair)]
    return forward if pair[0] < pair[1] else forward.transpose(1, 2)


def _of_view(batch: TripletBatch, target: Tensor) -> TripletBatch:
    """A batch of one frame per item: the target as another view shows it."""
    vibration = None if batch.vibration is None else batch.vibration[:, [TARGET]]
    view = replace(batch, frames=target[:, None], vibration=vibration)
    view.__dict__["images"] = target[:, None]
    return view


def _cameras(out: MethodOutput, batch: TripletBatch) -> CameraBatch:
    """The calibrated cameras, or with the intrinsics that the network estimates, mean over the pairs."""
    if not out.intrinsics:
        return batch.cameras
    K = torch.stack(list(out.intrinsics.values())).mean(0)
    return batch.cameras.with_intrinsics(torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], 1).float())


def _full(values: Tensor, size: torch.Size) -> Tensor:
    if values.shape[-2:] == size:
        return values
    return F.interpolate(values, tuple(size), mode="bilinear", align_corners=False)


def _snr(out: MethodOutput) -> dict[str, Tensor]:
    return {name: torch.tensor(value) for name, value in snr_summary(out).items()}


def _length(motions: dict[tuple[int, int], Tensor]) -> Tensor:
    return torch.stack([T[:, :3, 3].detach().float().norm(dim=1).mean() for T in motions.values()]).mean()
