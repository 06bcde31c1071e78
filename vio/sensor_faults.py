"""What goes wrong with a sensor, done on purpose: to measure how a result degrades, and to test that it is noticed.

Every function returns new samples and leaves its input as it is. Times are seconds after the first sample. Faults of
an IMU take `ImuSamples`; frames are dropped with `without_frames`, from the same kinds of holes in time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio.errors import CorruptionError
from vio.imu import ImuSamples
from vio.recording import NS, Recording

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Sensor = Literal["gyro", "accel"]


def outside_gap(t_s: ArrayLike, start_s: float, duration_s: float) -> Bools:
    """Which stamps (N,) [s] survive a hole of `duration_s` that opens at `start_s`.

    Raises:
        CorruptionError: a hole of negative or not finite length.
    """
    t = np.asarray(t_s, float)
    _check(np.isfinite(start_s) and np.isfinite(duration_s) and duration_s >= 0, "gap",
           f"from {start_s} s for {duration_s} s; give a finite start and a duration ≥ 0")
    return np.asarray((t < start_s) | (t >= start_s + duration_s))


def after_drops(count: int, share: float, rng: np.random.Generator) -> Bools:
    """Which of `count` stamps survive when each but the first and last is lost with probability `share`.

    Raises:
        CorruptionError: a share that is no probability.
    """
    _check(0 <= share <= 1, "drops", f"share is {share}, must be between 0 and 1")
    kept = np.asarray(rng.random(count) >= share)
    kept[:1] = kept[-1:] = True
    return kept


def with_gap(samples: ImuSamples, start_s: float, duration_s: float) -> ImuSamples:
    """The stream without its samples in [start_s, start_s + duration_s).

    Raises:
        CorruptionError: an impossible hole, or nothing would be left.
    """
    return _kept(samples, outside_gap(_seconds(samples), start_s, duration_s), "gap")


def with_drops(samples: ImuSamples, share: float, rng: np.random.Generator) -> ImuSamples:
    """The stream with single samples lost at random; its first and last stay.

    Raises:
        CorruptionError: a share that is no probability.
    """
    return _kept(samples, after_drops(len(samples), share, rng), "drops")


def with_time_shift(samples: ImuSamples, shift_s: float) -> ImuSamples:
    """The same measurements with stamps later by `shift_s`: a clock offset that the calibration does not know.

    Raises:
        CorruptionError: a shift that is not finite.
    """
    _check(np.isfinite(shift_s), "time shift", f"{shift_s} s; give a finite number")
    return replace(samples, t_ns=samples.t_ns + np.int64(round(shift_s / NS)))


def with_saturation(samples: ImuSamples, gyro_range_rad_s: float | None = None,
                    accel_range_m_s2: float | None = None) -> ImuSamples:
    """The stream of a sensor with a smaller full scale; None leaves that sensor as it is.

    Raises:
        CorruptionError: a full scale that is not positive.
    """
    for name, full in (("gyro", gyro_range_rad_s), ("accel", accel_range_m_s2)):
        _check(full is None or full > 0, "saturation", f"{name} full scale is {full}, must be positive")
    gyro, accel = samples.gyro_rad_s, samples.accel_m_s2
    return ImuSamples(samples.t_ns,
                      gyro if gyro_range_rad_s is None else np.clip(gyro, -gyro_range_rad_s, gyro_range_rad_s),
                      accel if accel_range_m_s2 is None else np.clip(accel, -accel_range_m_s2, accel_range_m_s2))


def with_dead_axis(samples: ImuSamples, sensor: Sensor, axis: int, value: float = 0.0) -> ImuSamples:
    """The stream with one axis (0, 1, 2 = x, y, z) stuck at `value` (rad/s or m/s²).

    Raises:
        CorruptionError: no such sensor or axis.
    """
    values = _values(samples, sensor, axis).copy()
    values[:, axis] = value
    return _with(samples, sensor, values)


def with_swapped_axes(samples: ImuSamples, sensor: Sensor, axis: int, other: int) -> ImuSamples:
    """The stream with two axes (0, 1, 2 = x, y, z) exchanged, as after a wiring mistake: a left-handed sensor.

    Raises:
        CorruptionError: no such sensor or axis, or twice the same axis.
    """
    values = _values(samples, sensor, axis, other).copy()
    _check(axis != other, "swapped axes", f"{axis} and {other} are the same; name two axes")
    values[:, [axis, other]] = values[:, [other, axis]]
    return _with(samples, sensor, values)


def with_bias_step(samples: ImuSamples, at_s: float, gyro_rad_s: ArrayLike = (0.0, 0.0, 0.0),
                   accel_m_s2: ArrayLike = (0.0, 0.0, 0.0)) -> ImuSamples:
    """The stream with a constant (3,) added to gyro and accelerometer from `at_s` on.

    Raises:
        CorruptionError: a step that is not three finite numbers.
    """
    gyro, accel = np.asarray(gyro_rad_s, float), np.asarray(accel_m_s2, float)
    for name, step in (("gyro", gyro), ("accel", accel)):
        _check(step.shape == (3,) and bool(np.isfinite(step).all()), "bias step",
               f"of the {name} is {step.tolist()}, must be three finite numbers")
    later = (_seconds(samples) >= at_s)[:, None]
    return ImuSamples(samples.t_ns, samples.gyro_rad_s + later * gyro, samples.accel_m_s2 + later * accel)


def with_bias_drift(samples: ImuSamples, gyro_rad_s: ArrayLike = (0.0, 0.0, 0.0),
                    accel_m_s2: ArrayLike = (0.0, 0.0, 0.0), time_constant_s: float = 600.0) -> ImuSamples:
    """The stream of a sensor that warms up: biases that grow as 1 - exp(-t / time constant) to a final (3,) each.

    Raises:
        CorruptionError: a final bias that is not three finite numbers, or a time constant that is not positive.
    """
    _check(np.isfinite(time_constant_s) and time_constant_s > 0, "bias drift",
           f"time constant is {time_constant_s} s, must be positive")
    final = with_bias_step(samples, 0.0, gyro_rad_s, accel_m_s2)
    share = (1 - np.exp(-_seconds(samples) / time_constant_s))[:, None]
    return ImuSamples(samples.t_ns, samples.gyro_rad_s + share * (final.gyro_rad_s - samples.gyro_rad_s),
                      samples.accel_m_s2 + share * (final.accel_m_s2 - samples.accel_m_s2))


def with_clock_jump(samples: ImuSamples, at_s: float, jump_s: float) -> ImuSamples:
    """The stream of a clock that jumps: stamps from `at_s` on are later by `jump_s` (negative: earlier).

    Raises:
        CorruptionError: a jump that is not finite.
    """
    _check(np.isfinite(jump_s), "clock jump", f"{jump_s} s; give a finite number")
    later = _seconds(samples) >= at_s
    return replace(samples, t_ns=samples.t_ns + later * np.int64(round(jump_s / NS)))


def without_frames(recording: Recording, kept: ArrayLike) -> Recording:
    """The recording with only those frames (N,) that `kept` marks; IMU and truth stay whole.

    Times count from the first frame, so losing it moves the zero; the truth is moved along.

    Raises:
        CorruptionError: one mark per frame is needed, and at least one frame.
    """
    mask = np.asarray(kept)
    _check(mask.dtype == np.bool_ and mask.shape == (len(recording),), "lost frames",
           f"{mask.dtype} {mask.shape} for {len(recording)} frames; give one True or False per frame")
    index = np.flatnonzero(mask)
    _check(len(index) > 0, "lost frames", f"none of {len(recording)} frames would be left; keep at least one")
    truth, moved_s = recording.truth, (recording.frame_t_ns[index[0]] - recording.frame_t_ns[0]) * NS
    return replace(
        recording, frame_t_ns=recording.frame_t_ns[index],
        frame_paths=tuple(recording.frame_paths[k] for k in index),
        depth_paths=tuple(recording.depth_paths[k] for k in index),
        truth=truth if truth is None else replace(truth, t_s=truth.t_s - moved_s))


def _seconds(samples: ImuSamples) -> Array:
    return np.asarray((samples.t_ns - samples.t_ns[:1]) * NS)


def _kept(samples: ImuSamples, mask: Bools, what: str) -> ImuSamples:
    _check(bool(mask.any()), what, f"none of {len(samples)} samples would be left; make the hole shorter")
    return ImuSamples(samples.t_ns[mask], samples.gyro_rad_s[mask], samples.accel_m_s2[mask])


def _values(samples: ImuSamples, sensor: Sensor, *axes: int) -> Array:
    _check(sensor in get_args(Sensor), "axis", f"sensor {sensor!r} is unknown; use gyro or accel")
    for axis in axes:
        _check(axis in (0, 1, 2), "axis", f"{axis!r} of the {sensor} does not exist; use 0, 1 or 2 for x, y or z")
    return samples.gyro_rad_s if sensor == "gyro" else samples.accel_m_s2


def _with(samples: ImuSamples, sensor: Sensor, values: Array) -> ImuSamples:
    return replace(samples, gyro_rad_s=values) if sensor == "gyro" else replace(samples, accel_m_s2=values)


def _check(fine: bool | np.bool_, what: str, problem: str) -> None:
    if not fine:
        raise CorruptionError(f"sensor fault, {what}: {problem}")
