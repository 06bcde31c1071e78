"""Other people's recordings into the layout that everything here reads: streaming, whole or nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from vio.errors import OutputError
from vio.formats import open_recording
from vio.formats.asl import write_asl
from vio.formats.asl_images import Progress
from vio.formats.declared import Declared
from vio.recording import Recording


def convert_to_asl(
    source: str | Path, out: str | Path, format: str | None = None, declared: Declared | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Read a recording in any known format and write it in ASL layout; the source is only read.

    Every frame is decoded once, so that a damaged one refuses the whole; image files are then copied byte for byte, one
    at a time. The recording takes the name of `out` and its images take the names of their stamps: nothing of the
    source's path enters the output. Stamps stay as they are, and image files keep whatever is written inside them.

    Args:
        source: folder or film.
        out: folder to write; replaced only if it was written by this library.
        format: a key of `vio.formats.READERS`; None recognises it.
        declared: what the files do not say.
        progress: called with (frames done, frames in all).

    Returns:
        The recording as read from the source.

    Raises:
        OutputError: `out` is the source, lies in it or holds it, exists and is not ours, or cannot be written.
        VioError: whatever reading raises.
    """
    source, out = Path(source), Path(out)
    ours, theirs = out.resolve(), source.resolve()
    if ours == theirs or ours.is_relative_to(theirs) or theirs.is_relative_to(ours):
        raise OutputError(f"{out.name}: the output would mix with the source, which stays untouched; choose a folder "
                          "elsewhere")
    recording = open_recording(source, format, declared)
    write_asl(replace(recording, name=out.name), out, check=True, progress=progress)
    return recording
