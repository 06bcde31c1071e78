"""The inertial samples around a frame, brought to the rate and length a network was trained with.

V²-SfMLearner looks at 40 samples at 40 Hz, one second around the first frame of each item.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio.errors import ImuError
from vio.imu import ImuSamples, check_coverage, find_gaps

Array = NDArray[np.float64]


class ImuWindows:
    """Cuts windows of `count` samples at `rate_hz`, centred at any time, out of one IMU stream.

    A sample is the mean of the signal over its cell (the stamp is the cell's centre), so resampling
    averages what falls into each new cell: lower rates do not alias, equal rates give the samples
    themselves. Beyond its ends and across holes the stream holds its nearest sample.

    Args:
        samples: N samples in body axes.
        imu_t_s: (N,) their stamps on the frames' clock [s], strictly increasing.
        frame_t_s: (M,) frame times that the stream has to cover [s].
        count: samples per window; 0 for a predictor that asks nothing of the IMU.
        rate_hz: rate of the window's samples.

    Raises:
        ImuError: there are fewer than two samples, or a frame lies outside them.
    """

    def __init__(
        self, samples: ImuSamples, imu_t_s: ArrayLike, frame_t_s: ArrayLike, count: int, rate_hz: float
    ) -> None:
        t = np.asarray(imu_t_s, float)
        self.count, self.rate_hz = count, rate_hz
        if count == 0:
            return
        if len(t) < 2:
            raise ImuError(
                f"imu: {len(t)} samples, but the predictor looks at {count} around every frame; "
                "give the IMU log, or a predictor that needs none"
            )
        check_coverage(t, np.asarray(frame_t_s, float))
        self._gaps = np.array([(gap.start_s, gap.end_s) for gap in find_gaps(t)]).reshape(-1, 2)
        self._signal = np.column_stack([samples.gyro_rad_s, samples.accel_m_s2])
        self._edges = 0.5 * (t[1:] + t[:-1])  # between the cells; the outermost cells have no end
        steps = self._signal[1:-1] * np.diff(self._edges)[:, None]
        self._integral = np.concatenate([np.zeros((1, 6)), np.cumsum(steps, axis=0)])

    def at(self, centre_s: ArrayLike) -> Array:
        """Windows (B, count, 6) around times (B,) [s]: gyro xyz [rad/s], then specific force xyz [m/s²]."""
        centre = np.asarray(centre_s, float)
        if self.count == 0:
            return np.zeros((len(centre), 0, 6))
        t = centre[:, None] + (np.arange(self.count + 1) - 0.5 * self.count) / self.rate_hz
        cell = np.searchsorted(self._edges, t, "right")
        edge = np.maximum(cell - 1, 0)  # the first cell has no start: count back from its end
        integral = self._integral[edge] + (t - self._edges[edge])[..., None] * self._signal[cell]
        return np.asarray(np.diff(integral, axis=1) * self.rate_hz)

    def over_gap(self, centre_s: ArrayLike) -> NDArray[np.bool_]:
        """Which windows around times (B,) touch a hole of more than 0.5 s, and so hold a stale sample."""
        centre = np.asarray(centre_s, float)[:, None]
        if self.count == 0:
            return np.zeros(len(centre), bool)
        half = 0.5 * self.count / self.rate_hz
        touches = (centre - half < self._gaps[:, 1]) & (centre + half > self._gaps[:, 0])
        return np.asarray(touches.any(axis=1))
