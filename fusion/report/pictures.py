"""What lesions look like: small pictures of the frames that show them, inside the page. Labels are escaped."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from vio.recording import Recording
from vio.thumbnails import thumbnail

MOST = 240
"""Pictures beyond so many are left out, and that is said: they would make the page slow to open."""


def picture_gallery(rows: Sequence[Mapping[str, Any]], recording: Recording) -> str:
    """One picture per lesion or landmark, of the frame in the middle of its sightings.

    Args:
        rows: of `lesions.json`.
        recording: the recording they were seen in; a frame without image file gets an empty place.

    Raises:
        RecordingError: an image that exists is cut off or undecodable.
    """
    shown = "".join(_picture(number, row, recording) for number, row in enumerate(rows[:MOST], 1))
    rest = f" The first {MOST} of {len(rows)} are shown." if len(rows) > MOST else ""
    return ('<section class="pictures"><h2>What was seen</h2><p class="caption">The frame in the middle of each '
            f"sighting; numbers as in the table.{rest}</p><ul>{shown}</ul></section>")


def _picture(number: int, row: Mapping[str, Any], recording: Recording) -> str:
    frame, label = int(row["frame"]), escape(str(row["label"]))
    if _has_image(recording, frame):
        source = base64.b64encode(thumbnail(recording, frame)).decode("ascii")
        image = f'<img alt="frame {frame}: {label}" src="data:image/jpeg;base64,{source}">'
    else:
        image = '<div class="absent">no image</div>'
    return f"<li>{image}<p><b>{number}</b> {label}<br><small>frame {frame:,}</small></p></li>"


def _has_image(recording: Recording, frame: int) -> bool:
    if recording.video is not None:
        return True
    path = recording.frame_paths[frame] if 0 <= frame < len(recording) else None
    return path is not None and path.is_file()
