"""`inspect --html`: verdicts with what to do, and pictures of what they rest on, as one page of words and SVG."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
from numpy.typing import NDArray

from fusion.report import words
from fusion.report.charts import Chart, Curve, chart_svgs
from vio.atomic import atomic_write
from vio.imu import GRAVITY_M_S2
from vio.inertial_levels import InertialLevels, inertial_levels
from vio.inspection import Inspection
from vio.recording import Recording
from vio.sensor_verdicts import Check
from vio.spectrum import Spectrum
from vio.visual_sync import SyncQuality

Array = NDArray[np.float64]

MARKS = {"ok": ("good", "fine"), "warning": ("plain", "look at this"), "error": ("bad", "cannot be used")}


@dataclass(frozen=True)
class _Picture:
    title: str
    caption: str
    chart: Chart


def write_inspection(recording: Recording, inspection: Inspection, path: str | Path) -> None:
    """Write the page, atomically; it fetches nothing and runs nothing.

    Raises:
        OutputError: the file cannot be written.
    """
    folder = files(__package__)
    page = Template(folder.joinpath("inspection.html").read_text(encoding="utf-8")).substitute(
        name=escape(recording.name), style=folder.joinpath("page.css").read_text(encoding="utf-8"),
        facts=escape(_facts(inspection)), tone="good" if inspection.usable else "bad",
        verdict=escape(_verdict(inspection)), checks="".join(_check(check) for check in inspection.checks),
        figures="".join(_figure(picture) for picture in _pictures(recording, inspection)),
    )
    with atomic_write(path) as file:
        file.write(page.encode())


def _facts(inspection: Inspection) -> str:
    facts = inspection.facts
    rate = facts["frame_rate_hz"]
    frames = f"{facts['frames']:,} frames" + (f" at {rate:.3g} Hz" if rate else "")
    imu = f"{facts['imu_samples']:,} inertial samples" + (
        f" at {facts['imu_rate_hz']:.4g} Hz" if facts["imu_rate_hz"] else "")
    return f"{frames} · {words.duration(facts['duration_s'])} · {imu}"


def _verdict(inspection: Inspection) -> str:
    if not inspection.usable:
        return "This recording cannot be refined as it is; what to do stands below."
    warned = sum(check.level == "warning" for check in inspection.checks)
    if warned:
        return f"This recording can be refined. {warned} of {len(inspection.checks)} checks deserve a look."
    unjudged = sum(not check.judged for check in inspection.checks)
    if unjudged:
        return f"This recording can be refined. {unjudged} of {len(inspection.checks)} checks could not be made."
    return "This recording can be refined; every check is fine."


def _check(check: Check) -> str:
    tone, word = MARKS[check.level] if check.judged else ("none", "not judged")
    remedy = f'<p class="remedy"><b>What to do:</b> {escape(check.remedy)}</p>' if check.remedy else ""
    return (f'<dt>{escape(check.name)} <span class="mark {tone}">{word}</span></dt>'
            f"<dd>{escape(check.text)}{remedy}</dd>")


def _figure(picture: _Picture) -> str:
    svg = chart_svgs(picture.chart, picture.title)
    return f"<figure><h2>{escape(picture.title)}</h2><figcaption>{escape(picture.caption)}</figcaption>{svg}</figure>"


def _pictures(recording: Recording, inspection: Inspection) -> list[_Picture]:
    out = []
    if len(recording) > 1:
        t = recording.frame_t_s
        out.append(_Picture("Frame intervals", "Every interval as stamped; peaks are holes.",
                            Chart([Curve("refined", t[1:], 1e3 * np.diff(t))], "time [s]", "interval [ms]", zero=True)))
    if len(recording.imu) > 1:
        t = recording.imu_t_s
        out.append(_Picture("Intervals of inertial samples", "Peaks are holes; a step is a change of rate.",
                            Chart([Curve("refined", t[1:], 1e3 * np.diff(t))], "time [s]", "interval [ms]", zero=True)))
        levels = inertial_levels(recording.imu, t)
        out += [] if levels is None else _levels(levels)
    out += [] if inspection.spectrum is None else _spectra(recording, inspection.spectrum)
    out += [] if inspection.sync is None else _sync(inspection.sync)
    return out


def _levels(levels: InertialLevels) -> list[_Picture]:
    t = levels.t_s
    gravity = Curve("motions", t[[0, -1]], np.full(2, GRAVITY_M_S2), "gravity")
    return [
        _Picture("Gravity", "Length (rms) of the specific force: it should keep to the line, whatever the attitude.",
                 Chart([gravity, Curve("refined", t, levels.force_m_s2, "measured")], "time [s]", "force [m/s²]")),
        _Picture("Turning", "Root mean square of the angular rate.",
                 Chart([Curve("refined", t, np.rad2deg(levels.rate_rad_s))], "time [s]", "rate [°/s]", zero=True)),
        _Picture("Vibration", "Specific force less its slow part, root mean square.",
                 Chart([Curve("refined", t, levels.vibration_m_s2)], "time [s]", "vibration [m/s²]", zero=True)),
    ]


def _spectra(recording: Recording, spectrum: Spectrum) -> list[_Picture]:
    noise, out = recording.calibration.imu_noise, []
    for title, density, white, unit in (
        ("Spectrum of the accelerometer", spectrum.accel, noise.accel_density_m_s2_rthz, "m/s²/√Hz"),
        ("Spectrum of the gyro", spectrum.gyro, noise.gyro_density_rad_s_rthz, "rad/s/√Hz"),
    ):
        level = Curve("motions", spectrum.frequency_hz[[0, -1]], np.full(2, np.sqrt(6) * white), "calibrated noise")
        out.append(_Picture(title, "Square root of the density over all axes, on the longest stretch without a hole.",
                            Chart([level, Curve("refined", spectrum.frequency_hz, np.sqrt(density), "measured")],
                                  "frequency [Hz]", unit, log=True)))
    return out


def _sync(sync: SyncQuality) -> list[_Picture]:
    liveliest = int(np.argmax(sync.gyro_rad.std(axis=0)))
    curves = [Curve("motions", sync.t_s, np.rad2deg(sync.visual_rad[:, liveliest]), "images"),
              Curve("refined", sync.t_s, np.rad2deg(sync.gyro_rad[:, liveliest]), "gyro")]
    return [
        _Picture("Camera against gyro", f"Turn between neighbouring frames about the body's {'xyz'[liveliest]}, where "
                 "it turns most; less the mean.", Chart(curves, "time [s]", "turn [°]")),
        _Picture("Clocks", "Correlation of the two over time offsets of the IMU beyond the declared one; the peak "
                 "should lie at 0.", Chart([Curve("refined", 1e3 * sync.offset_s, sync.correlation)], "offset [ms]",
                                           "correlation")),
    ]
