"""Loops: motions between frames far apart in time that show the same place, and what became of the other proposals.

File: `loops.npz`, the keys of `motions.npz` (of no row where nothing was found), `proposed`, and `refused` as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from vio.atomic import atomic_write
from vio.errors import MotionsError
from vio.motions import UNREADABLE, RelativeMotions


@dataclass(frozen=True)
class Loops:
    """What a search for loops found, before any graph has judged it.

    Raises:
        MotionsError: counts that contradict each other.
    """

    motions: RelativeMotions | None
    """One motion per loop, from the earlier frame to the later; None where nothing was found."""
    proposed: int
    """Pairs of frames that looked alike."""
    refused: Mapping[str, int] = field(default_factory=dict)
    """How many of these were not verified, by reason in words."""

    def __post_init__(self) -> None:
        if self.proposed < 0 or any(count < 0 for count in self.refused.values()):
            raise MotionsError(f"loops: {self.proposed} proposed, {dict(self.refused)} refused; counts cannot be "
                               "negative")

    def __len__(self) -> int:
        return 0 if self.motions is None else len(self.motions)

    def save(self, path: str | Path) -> None:
        """Write `loops.npz` atomically."""
        arrays = {} if self.motions is None else self.motions.arrays()
        arrays |= {"proposed": np.int64(self.proposed), "found": np.int64(len(self)),
                   "refused": np.array(json.dumps(dict(self.refused), sort_keys=True))}
        with atomic_write(path) as file:
            np.savez_compressed(file, **arrays)


def load_loops(path: str | Path) -> Loops:
    """Read `loops.npz`.

    Raises:
        MotionsError: the file is missing, is no npz, or lacks a key; or its contents break the contract.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            arrays = dict(np.load(file, allow_pickle=False))
        motions = None
        if int(arrays["found"]) > 0:
            motions = RelativeMotions(arrays["t_i"], arrays["t_j"], arrays["T_i_j"], arrays["cov"],
                                      float(arrays["scale_log_mean"]), float(arrays["scale_log_sd"]),
                                      meta=json.loads(str(arrays["meta"])))
        return Loops(motions, int(arrays["proposed"]), json.loads(str(arrays["refused"])))
    except OSError as error:
        raise MotionsError(f"{path.name}: cannot be read ({error.strerror or error}); write it with `capsule-vio "
                           "predict --loops`") from None
    except KeyError as error:
        raise MotionsError(f"{path.name}: missing key {error}; write it with `capsule-vio predict --loops`") from None
    except UNREADABLE as error:
        reason = (str(error).split(". ")[0] or type(error).__name__)[:120]
        raise MotionsError(f"{path.name}: not a readable file of loops ({reason}); write it with `capsule-vio predict "
                           "--loops`") from None
