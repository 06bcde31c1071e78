"""The cameras of a batch in torch: from points to pixels and back, differentiable, pinhole and fisheye side by side.

Same models and pixel convention as `vio.camera`. Both are written as one: a direction is a vector q in the image
plane whose length s is the tangent of the angle to the optical axis (pinhole) or the angle itself (fisheye), and the
lens moves q to `q (1 + k1 s² + k2 s⁴ + ...)` plus the pinhole's tangential terms. So a batch may mix both models.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from vio.camera import Camera
from vio.errors import CameraError

KNOTS = 512
NEWTON_STEPS = 6
UNDISTORTED_TO = 1e-4  # how far a ray, projected again, may miss its pixel, in focal lengths: beyond, none reaches it
NEAREST = 1e-12  # points closer than this to the camera's centre, or to a pinhole's plane, have no direction
ON_AXIS = 1e-10  # squared tangent to the optical axis below which a series replaces the ratio angle / radius


@dataclass(frozen=True)
class CameraBatch:
    """B cameras with images of one size.

    Points and rays are (B, 3, ...), pixels (B, 2, ...): columns first, centres at whole coordinates.
    """

    fisheye: Tensor
    """(B,) bool: equidistant fisheye, else pinhole."""
    intrinsics: Tensor
    """(B, 4) fx, fy, cx, cy [pixels]; may carry gradients."""
    radial: Tensor
    """(B, 4) k1, k2, ... of the radial polynomial, zeros where the model has fewer."""
    tangential: Tensor
    """(B, 2) p1, p2; zeros for a fisheye."""
    reach: Tensor
    """(B,) largest s that maps one-to-one to an image radius (`Camera.reach`)."""
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.fisheye)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> CameraBatch:
        """The same cameras on another device, or in another floating type."""
        return self._each(lambda value: value.to(device) if value.dtype == torch.bool else value.to(device, dtype))

    def select(self, index: Tensor | Sequence[int]) -> CameraBatch:
        """The cameras at the given indices, repeats allowed."""
        rows = torch.as_tensor(index, device=self.fisheye.device)
        return self._each(lambda value: value[rows])

    def repeated(self, times: int) -> CameraBatch:
        """The whole batch, `times` after each other; rays that are known already are not computed again."""
        batch = self._each(lambda value: torch.cat([value] * times))
        rays, valid = self.pixel_rays
        batch.__dict__["pixel_rays"] = (torch.cat([rays] * times), torch.cat([valid] * times))
        return batch

    def with_intrinsics(self, intrinsics: Tensor) -> CameraBatch:
        """The same lenses with intrinsics (B, 4) from elsewhere: a network that learns them."""
        return replace(self, intrinsics=intrinsics)

    def resized(self, width: int, height: int) -> CameraBatch:
        """The cameras of the same images scaled to another size."""
        return replace(self, intrinsics=self._scaled(width / self.width, height / self.height),
                       width=width, height=height)

    @cached_property
    def halved(self) -> CameraBatch:
        """The cameras of the same images at half the size."""
        return self.resized(self.width // 2, self.height // 2)

    def cropped(self, left: Tensor, top: Tensor, width: int, height: int) -> CameraBatch:
        """The cameras of a window of `width` x `height` pixels whose upper left pixel is (left, top), (B,) each."""
        fx, fy, cx, cy = self.intrinsics.unbind(1)
        return replace(self, intrinsics=torch.stack([fx, fy, cx - left, cy - top], 1), width=width, height=height)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (B, 2, ...) of points (B, 3, ...) in camera axes, and which of them (B, ...) the model can see.

        Points it cannot see (see `vio.Camera.project`) get the optical axis's pixel and no gradient.
        A seen point may still lie off the image: ask `contains`.
        """
        extra = points.dim() - 2
        fisheye, reach = _spread(self.fisheye, extra), _spread(self.reach, extra)
        x, y, z = points.unbind(1)
        square, front = (x * x + y * y).detach(), z.detach() > NEAREST
        axis = front & (square <= ON_AXIS * z.detach() ** 2)
        usable = torch.isfinite(points.detach()).all(1) & torch.where(fisheye, axis | (square > NEAREST**2), front)
        x, y, z = (torch.where(usable, value, torch.full_like(value, fill)) for value, fill in
                   ((x, 0.0), (y, 0.0), (z, 1.0)))
        axis = axis | ~usable
        forward = torch.where(fisheye & ~axis, torch.ones_like(z), z)  # what a pinhole divides by
        radius = torch.where(axis, torch.ones_like(x), x * x + y * y).sqrt()
        bent = torch.where(fisheye & ~axis, torch.atan2(radius, z) / radius, 1 / forward)
        q = torch.stack([x, y], 1) * bent[:, None]
        s = (q.detach() * q.detach()).sum(1).sqrt()
        valid = usable & (s < reach)
        q = torch.where(valid[:, None], q, torch.zeros_like(q))
        return self._to_pixels(self._distort(q)), valid

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Unit rays (B, 3, ...) of pixels (B, 2, ...), and which of them (B, ...) a ray reaches.

        Differentiable in pixels, intrinsics and distortion: the inverse of the lens is found without gradients,
        and one last Newton step carries them (implicit function theorem). Where no ray arrives: the optical axis.
        """
        extra = pixels.dim() - 2
        fx, fy, cx, cy = (_spread(value, extra) for value in self.intrinsics.unbind(1))
        planar = torch.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy], 1)
        q, valid = planar, (planar.detach() ** 2).sum(1).sqrt() < _spread(self.reach, extra)
        if bool((self.radial != 0).any()) or bool((self.tangential != 0).any()):
            q, valid = self._undistort(planar)
        q = torch.where(valid[:, None], q, torch.zeros_like(q))
        return _rays(q, _spread(self.fisheye, extra)), valid

    @cached_property
    def pixel_rays(self) -> tuple[Tensor, Tensor]:
        """Unit rays (B, 3, H, W) of all pixels, and which of them (B, H, W) a ray reaches."""
        return self.unproject(self.pixel_grid.expand(len(self), -1, -1, -1))

    @property
    def pixel_grid(self) -> Tensor:
        """(2, H, W) column and row of every pixel."""
        return pixel_grid(self.height, self.width, self.intrinsics)

    def contains(self, pixels: Tensor) -> Tensor:
        """Which pixels (B, 2, ...) have four neighbours to interpolate between: within the outermost centres."""
        x, y = pixels.unbind(1)
        return (x >= 0) & (x <= self.width - 1) & (y >= 0) & (y <= self.height - 1)

    def _each(self, change: Callable[[Tensor], Tensor]) -> CameraBatch:
        return CameraBatch(change(self.fisheye), change(self.intrinsics), change(self.radial), change(self.tangential),
                           change(self.reach), self.width, self.height)

    def _scaled(self, x: float, y: float) -> Tensor:
        fx, fy, cx, cy = self.intrinsics.unbind(1)
        return torch.stack([fx * x, fy * y, (cx + 0.5) * x - 0.5, (cy + 0.5) * y - 0.5], 1)

    def _to_pixels(self, planar: Tensor) -> Tensor:
        fx, fy, cx, cy = (_spread(value, planar.dim() - 2) for value in self.intrinsics.unbind(1))
        return torch.stack([planar[:, 0] * fx + cx, planar[:, 1] * fy + cy], 1)

    def _stretch(self, square: Tensor) -> tuple[Tensor, Tensor]:
        """1 + k1 s² + k2 s⁴ + ..., and its derivative over s², for s² of shape (B, ...)."""
        value, slope = torch.zeros_like(square), torch.zeros_like(square)
        for k in reversed(self.radial.unbind(1)):
            slope = slope * square + value
            value = value * square + _spread(k, square.dim() - 1)
        return 1 + value * square, slope * square + value

    def _distort(self, q: Tensor) -> Tensor:
        x, y = q.unbind(1)
        square = x * x + y * y
        p1, p2 = (_spread(p, square.dim() - 1) for p in self.tangential.unbind(1))
        stretch = self._stretch(square)[0]
        return torch.stack([x * stretch + 2 * p1 * x * y + p2 * (square + 2 * x * x),
                            y * stretch + 2 * p2 * x * y + p1 * (square + 2 * y * y)], 1)

    def _undistort(self, planar: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            q, reached = self._radial_guess(planar)
            for _ in range(NEWTON_STEPS):
                q = q - self._newton(q, self._distort(q) - planar)
            miss = (self._distort(q) - planar).abs().amax(1)
            valid = reached & torch.isfinite(q).all(1) & (miss < UNDISTORTED_TO * (1 + planar.abs().amax(1)))
            q = torch.where(valid[:, None], q, torch.zeros_like(q))
        off = torch.where(valid[:, None], self._distort(q) - planar, torch.zeros_like(planar))
        return q - self._newton(q, off), valid

    def _radial_guess(self, planar: Tensor) -> tuple[Tensor, Tensor]:
        """q as the radial part alone would give it, from a table per camera; False beyond the table."""
        radius = (planar * planar).sum(1).sqrt()
        # Denser towards the axis: a pinhole reaches 89 degrees, where its tangent is 100.
        knots = self.reach[:, None] * torch.linspace(0, 1, KNOTS, dtype=radius.dtype, device=radius.device) ** 2
        table = knots * self._stretch(knots * knots)[0]
        flat = radius.flatten(1)
        cell = torch.searchsorted(table, flat.contiguous(), right=True).clamp(1, KNOTS - 1)
        low, high = table.gather(1, cell - 1), table.gather(1, cell)
        share = ((flat - low) / (high - low)).clamp(0, 1)
        s = torch.lerp(knots.gather(1, cell - 1), knots.gather(1, cell), share).view_as(radius)
        ratio = torch.where(radius > 0, s / torch.where(radius > 0, radius, torch.ones_like(radius)),
                            torch.ones_like(radius))
        return planar * ratio[:, None], (flat <= table[:, -1:]).view_as(radius)

    def _newton(self, q: Tensor, off: Tensor) -> Tensor:
        """`off` divided by the (symmetric) 2 x 2 derivative of `_distort` at q; no gradient through that."""
        with torch.no_grad():
            x, y = q.unbind(1)
            square = x * x + y * y
            p1, p2 = (_spread(p, square.dim() - 1) for p in self.tangential.unbind(1))
            stretch, slope = self._stretch(square)
            xx = stretch + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x
            yy = stretch + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x
            xy = 2 * slope * x * y + 2 * p1 * x + 2 * p2 * y
            size = xx * yy - xy * xy
        u, v = off.unbind(1)
        return torch.stack([(yy * u - xy * v) / size, (xx * v - xy * u) / size], 1)


def pixel_grid(height: int, width: int, like: Tensor) -> Tensor:
    """(2, H, W) column and row of every pixel, in the type and on the device of `like`."""
    rows, columns = (torch.arange(size, dtype=like.dtype, device=like.device) for size in (height, width))
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"))


def camera_batch(cameras: Sequence[Camera], dtype: torch.dtype = torch.float32) -> CameraBatch:
    """The cameras (B of them) as tensors on the CPU.

    Raises:
        CameraError: no camera, or images of different sizes.
    """
    if not cameras:
        raise CameraError("cameras: none given; a batch needs at least one")
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        raise CameraError(f"cameras: images of {' and '.join(f'{w} x {h}' for w, h in sorted(sizes))} pixels in one "
                          "batch; resize them to one size")
    rows = [_coefficients(camera) for camera in cameras]
    return CameraBatch(
        torch.tensor([camera.model == "equidistant" for camera in cameras]),
        torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras], dtype=dtype),
        torch.tensor([radial for radial, _ in rows], dtype=dtype),
        torch.tensor([tangential for _, tangential in rows], dtype=dtype),
        torch.tensor([camera.reach for camera in cameras], dtype=dtype),
        cameras[0].width, cameras[0].height)


def _coefficients(camera: Camera) -> tuple[tuple[float, ...], tuple[float, float]]:
    """Radial polynomial, four coefficients, and tangential terms."""
    k = camera.distortion
    if camera.model == "equidistant":
        return k, (0.0, 0.0)
    return (k[0], k[1], k[4] if len(k) == 5 else 0.0, 0.0), (k[2], k[3])


def _rays(q: Tensor, fisheye: Tensor) -> Tensor:
    """Unit rays (B, 3, ...) of undistorted q (B, 2, ...)."""
    square = (q * q).sum(1)
    small = square < ON_AXIS
    s = torch.where(small, torch.ones_like(square), square).sqrt()
    sine = torch.where(small, 1 - square / 6, s.sin() / s)
    cosine = torch.where(small, 1 - square / 2, s.cos())
    along = torch.where(fisheye, cosine, torch.rsqrt(1 + square))
    across = torch.where(fisheye, sine, torch.rsqrt(1 + square))
    return torch.cat([q * across[:, None], along[:, None]], 1)


def _spread(value: Tensor, extra: int) -> Tensor:
    """(B,) as (B, 1, ...) with `extra` axes, to meet (B, ...)."""
    return value.view(-1, *[1] * extra)
