"""Several sightings of one lesion become one, with an error that counts what they share only once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.lesions.fixes import Fix

Array = NDArray[np.float64]

GAP_S = 60.0
"""Sightings further apart in time than this are never taken for one."""
CHI2_3_99 = 11.345
RECENT = 8
"""A new sighting is held against so many of the last ones."""
DEPTH_CORRELATION = 0.5
"""Neighbouring views of one place err alike in depth: this share of a sighting's own variance does not average out."""
IMAGE_MEMORY_S = 2.0
"""How long predicted maps stay off by one scale: length of a Matérn-3/2 correlation in time, which says 0.97, 0.78,
0.48 and 0.14 after 1/3, 1, 2 and 4 s; the bundled weights have 0.95, 0.71, 0.44 and 0.19 on calibration recordings."""


@dataclass(frozen=True)
class Place:
    """One lesion or landmark from one or several sightings."""

    fixes: tuple[Fix, ...]
    point_m: Array
    """(3,)"""
    cov_m2: Array
    """(3, 3)"""
    own_cov: Array
    """(3, 3) the part of it that comes from depth and pixels, the scales of whole maps included."""
    pixel_cov: Array
    """(3, 3) the same without the scales of whole maps."""
    image_m: Array
    """(F, 3) what one standard deviation of every map's own scale does to it."""
    image_s: Array
    """(F,) when those maps were seen."""
    common_m: Array
    """(S, 3) sampled errors from pose and scale."""

    @property
    def middle(self) -> Fix:
        """The sighting that stands for all: the one in the middle."""
        return self.fixes[(len(self.fixes) - 1) // 2]

    @property
    def with_depth(self) -> bool:
        """Whether the point is the lesion's own and not the camera's."""
        return any(fix.with_depth for fix in self.fixes)


def merge(fixes: list[Fix], t_s: Array) -> list[Place]:
    """Group sightings of the same label and kind that lie together in time and, within their errors, in space.

    Args:
        fixes: placed sightings in any order.
        t_s: (M,) times of the trajectory's frames.

    Returns:
        Places in order of time.
    """
    groups: list[list[Fix]] = []
    for fix in sorted(fixes, key=lambda f: f.index):
        home = next((group for group in reversed(groups) if _belongs(fix, group, t_s)), None)
        if home is None:
            groups.append([fix])
        else:
            home.append(fix)
    return sorted((_join(group, t_s) for group in groups), key=lambda place: place.middle.index)


def _belongs(fix: Fix, group: list[Fix], t_s: Array) -> bool:
    last = group[-1]
    same = fix.sighting.label.casefold() == last.sighting.label.casefold() and fix.sighting.kind == last.sighting.kind
    if not same or t_s[fix.index] - t_s[last.index] > GAP_S:
        return False
    place = _join(group[-RECENT:], t_s)
    apart = fix.point_m - place.point_m
    scales = np.vstack([fix.image_m, -place.image_m])
    cov = fix.own_cov + place.pixel_cov + _of_images(scales, np.r_[t_s[fix.index], place.image_s])
    if len(fix.common_m):
        between = fix.common_m - place.common_m
        cov = cov + between.T @ between / len(between)
    return float(apart @ np.linalg.solve(cov, apart)) <= CHI2_3_99


def _join(group: list[Fix], t_s: Array) -> Place:
    """Weight by what is each sighting's own; what they share stays. Without depth they count only among their like."""
    seen = [fix for fix in group if fix.with_depth] or group
    singles = [_single(fix, t_s) for fix in seen]
    best = min(singles, key=lambda place: float(np.trace(place.cov_m2)))
    joined = _mean(seen, t_s) if len(seen) > 1 else best
    if np.trace(best.cov_m2) < np.trace(joined.cov_m2):  # one clear view beats its mean with worse ones
        joined = best
    return replace(joined, fixes=tuple(group))


def _single(fix: Fix, t_s: Array) -> Place:
    own = fix.own_cov + np.outer(fix.image_m, fix.image_m)
    return Place((fix,), fix.point_m, _reported(fix, fix.pose_cov, own), own, fix.own_cov, fix.image_m[None],
                 t_s[[fix.index]], fix.common_m)


def _mean(seen: list[Fix], t_s: Array) -> Place:
    information = [np.linalg.inv(fix.own_cov) for fix in seen]
    independent = np.linalg.inv(np.sum(information, axis=0))
    weights = [independent @ part for part in information]
    mean_own = np.mean([fix.own_cov for fix in seen], axis=0)
    pixel = (1 - DEPTH_CORRELATION) * independent + DEPTH_CORRELATION * mean_own
    image, when = np.array([w @ fix.image_m for w, fix in zip(weights, seen, strict=True)]), _times(seen, t_s)
    own = pixel + _of_images(image, when)
    point = np.sum([w @ fix.point_m for w, fix in zip(weights, seen, strict=True)], axis=0)
    common = np.sum([fix.common_m @ w.T for w, fix in zip(weights, seen, strict=True)], axis=0)
    return Place(tuple(seen), point, _reported(seen[0], _shared(seen, common), own), own, pixel, image, when, common)


def _times(seen: list[Fix], t_s: Array) -> Array:
    return np.asarray(t_s[[fix.index for fix in seen]])


def _of_images(image_m: Array, when_s: Array) -> Array:
    """Covariance (3, 3) of the sum of (F, 3) errors by the scales of maps, which neighbours in time share."""
    apart = np.sqrt(3.0) * np.abs(when_s[:, None] - when_s) / IMAGE_MEMORY_S
    return np.asarray(image_m.T @ ((1 + apart) * np.exp(-apart)) @ image_m)


def _reported(fix: Fix, pose_cov: Array, own_cov: Array) -> Array:
    """Without depth the point is the camera's: how far the lesion is from it is unknown and not in its covariance."""
    return pose_cov + own_cov if fix.with_depth else pose_cov


def _shared(seen: list[Fix], common: Array) -> Array:
    """Covariance (3, 3) of a weighted mean's pose part: the middle sighting's, in the proportion that samples have."""
    middle = seen[(len(seen) - 1) // 2]
    if not len(common):
        return middle.pose_cov
    alone = float((middle.common_m**2).sum())
    return middle.pose_cov * (float((common**2).sum()) / alone if alone > 0 else 1.0)
