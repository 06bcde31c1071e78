"""An oracle for depth that shares nothing with the rasteriser: rays march through a tube until they meet its wall.

Torch, on any device, in double precision. A point belongs to the cross-section through it (found by iterating the foot
point on the centreline), where the wall's radius is bilinear in row and angle. Step lengths follow the gap to the wall;
the crossing is then bisected.
"""

import math

import numpy as np
import torch

from vio.simulation.wall_motion import WallState

FOOT_STEPS = 4
MARCH_STEPS = 600
BISECTIONS = 12
SHARE, SHORTEST_M, LONGEST_M = 0.45, 0.04e-3, 2.5e-3


def march(state: WallState, origin_m: np.ndarray, rays_world: np.ndarray, start_row: float, far_m: float = 0.12,
          device: str = "cpu") -> np.ndarray:
    """Distance [m] at which rays (n, 3) from a point inside meet the wall; NaN where they leave the stretch."""
    tube = _Tube(state, device)
    origin = torch.tensor(origin_m, dtype=torch.float64, device=device)
    rays = torch.tensor(rays_world, dtype=torch.float64, device=device)
    n = len(rays)
    t, before = torch.zeros(n, dtype=torch.float64, device=device), torch.zeros(n, dtype=torch.float64, device=device)
    row = torch.full((n,), start_row - state.first_row, dtype=torch.float64, device=device)
    live = torch.arange(n, device=device)
    low, high = torch.full_like(t, math.nan), torch.full_like(t, math.nan)
    hit_row = row.clone()
    for _ in range(MARCH_STEPS):
        gap, row[live] = tube.gap(origin + t[live, None] * rays[live], row[live])
        inside_wall = gap < 0
        hit = live[inside_wall]
        low[hit], high[hit], hit_row[hit] = before[hit], t[hit], row[hit]
        gone = (t[live] > far_m) | (row[live] <= 1e-6) | (row[live] >= tube.rows - 1 - 1e-6)
        keep = ~inside_wall & ~gone
        live, gap = live[keep], gap[keep]
        if not len(live):
            break
        before[live] = t[live]
        t[live] += (SHARE * gap).clamp(SHORTEST_M, LONGEST_M)
    found = torch.nonzero(~torch.isnan(high))[:, 0]
    for _ in range(BISECTIONS):
        middle = 0.5 * (low[found] + high[found])
        gap, _ = tube.gap(origin + middle[:, None] * rays[found], hit_row[found])
        high[found] = torch.where(gap < 0, middle, high[found])
        low[found] = torch.where(gap < 0, low[found], middle)
    return (0.5 * (low + high)).cpu().numpy()


class _Tube:
    """The wall as a function of space."""

    def __init__(self, state: WallState, device: str) -> None:
        def tensor(a: np.ndarray) -> torch.Tensor:
            return torch.tensor(a, dtype=torch.float64, device=device)

        self.centre, self.across, self.radius = tensor(state.centre_m), tensor(state.across), tensor(state.radius_m)
        self.along = torch.linalg.cross(self.across[:, 0], self.across[:, 1])
        self.step = (self.centre[1:] - self.centre[:-1]).norm(dim=1).clamp_min(1e-5)
        self.rows, self.columns = self.radius.shape

    def gap(self, points: torch.Tensor, row: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance to the wall across the lumen (n,) [m], negative outside, and the row (n,) of each point."""
        for k in range(FOOT_STEPS + 1):
            i = row.floor().long().clamp(0, self.rows - 2)
            a = (row - i)[:, None]
            offset = points - ((1 - a) * self.centre[i] + a * self.centre[i + 1])
            if k < FOOT_STEPS:
                along = (1 - a) * self.along[i] + a * self.along[i + 1]
                move = (offset * along).sum(1) / self.step[i]
                row = (row + move.clamp(-40, 40)).clamp(0, self.rows - 1)
        across = (1 - a[:, None]) * self.across[i] + a[:, None] * self.across[i + 1]
        u, v = (offset * across[:, 0]).sum(1), (offset * across[:, 1]).sum(1)
        angle = torch.remainder(torch.atan2(v, u) / (2 * math.pi) * self.columns, self.columns)
        j = angle.floor().long() % self.columns
        b = angle - angle.floor()
        a = a[:, 0]
        next_j = (j + 1) % self.columns
        near = (1 - b) * self.radius[i, j] + b * self.radius[i, next_j]
        far = (1 - b) * self.radius[i + 1, j] + b * self.radius[i + 1, next_j]
        return (1 - a) * near + a * far - torch.hypot(u, v), row
