"""Frames of a recording as small JPEG pictures, without anything but pixels in them."""

from __future__ import annotations

from vio.recording import Recording

QUALITY = 80


def thumbnail(recording: Recording, frame: int, size: int = 160) -> bytes:
    """JPEG of frame `frame`, at most `size` pixels wide and high; smaller frames are kept as they are.

    Decoded and encoded anew, so that nothing a camera or a person wrote into the file comes along.

    Raises:
        RecordingError: no such frame, or its image is absent, cut off or undecodable.
    """
    import cv2  # heavy, and needed only once somebody looks at an image

    image = recording.frame(frame)
    height, width = image.shape[:2]
    factor = min(1.0, size / max(height, width))
    if factor < 1:
        small = (max(1, round(width * factor)), max(1, round(height * factor)))
        image = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
    if image.ndim == 3:
        image = image[..., ::-1]
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1])
