"""Which refined runs may teach a depth network how deep things are: those whose scale their accelerometer measured."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fusion.run_folder import read_run
from vio.errors import UsageError
from vio.recording import Recording
from vio.trajectory import Trajectory


def teaching_trajectories(recordings: Sequence[Recording], runs: Sequence[Path]) -> list[Trajectory | None]:
    """Refined trajectories for `learned.training.train`; None where scale was not "free".

    A run whose scale is the network's own prior would teach the network what it said.

    Args:
        recordings: to train on.
        runs: folders that `capsule-vio refine` wrote, one for each recording, in their order.

    Raises:
        UsageError: another number of runs than of recordings, or of another recording's time, or none is "free".
        FormatError: a run that cannot be read.
    """
    if len(runs) != len(recordings):
        raise UsageError(f"--refined: {len(runs)} runs for {len(recordings)} recordings; give one for each, in order")
    found: list[Trajectory | None] = []
    for recording, folder in zip(recordings, runs, strict=True):
        run = read_run(folder)
        t, times = recording.frame_t_s, run.refined.t_s
        if times[0] > t[-1] or times[-1] < t[0] or len(times) > len(t):
            raise UsageError(f"--refined: {folder.name} is not a refinement of {recording.name} ({len(times)} poses, "
                             f"{times[0]:.3f} to {times[-1]:.3f} s); give runs in the order of the recordings")
        found.append(run.refined if run.summary["scale"]["policy"] == "free" else None)
    if all(path is None for path in found):
        raise UsageError("--refined: no run has the scale policy \"free\", so none has measured lengths to teach with; "
                         "train without --refined")
    return found
