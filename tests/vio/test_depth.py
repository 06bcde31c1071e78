"""Depth encodings: formulas there and back, what is unknown stays 0, other images are refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vio.depth import LinearDepth, PointMapDepth, RelativeInverseDepth, ReversedZDepth, to_counts
from vio.errors import RecordingError

PLANES = st.tuples(st.floats(1e-4, 0.1), st.floats(1.5, 1000)).map(lambda p: (p[0], p[0] * p[1]))


@given(PLANES)
def test_reversed_z_is_affine_in_inverse_depth_between_its_planes(planes):
    near, far = planes
    z = ReversedZDepth(near, far).depth_m(np.arange(256, dtype=np.uint8)[None], "x")[0].astype(float)
    assert z[0] == 0 and z[255] == pytest.approx(near, rel=1e-5) and z[1] < far
    np.testing.assert_allclose(1 / z[1:], 1 / far + np.arange(1, 256) / 255 * (1 / near - 1 / far), rtol=1e-5)


@given(st.floats(1e-7, 1e-2), st.integers(0, 65535))
def test_counts_there_and_back(unit_m, largest):
    counts = np.array([[0, 1, largest, 65535]], np.uint16)
    encoding = LinearDepth(unit_m, largest)
    known = np.where(counts > largest, 0, counts)
    np.testing.assert_array_equal(to_counts(encoding.depth_m(counts, "x"), unit_m), known)
    np.testing.assert_array_equal(encoding.counts(counts, "x"), known)


def test_points_know_their_z_and_their_half():
    image = np.zeros((4, 2, 3), np.float32)
    image[:2, :, 0] = [[50, np.nan], [-1, np.inf]]  # z, in the order of decoded channels
    image[:, :, 2] = 9
    np.testing.assert_allclose(PointMapDepth(1e-3, stacked=True).depth_m(image, "x"), [[0.05, 0], [0, 0]])
    assert PointMapDepth(1e-3).depth_m(image, "x").shape == (4, 2)
    assert to_counts(np.array([[1.0, -1.0, 0.65535]]), 1e-5).tolist() == [[0, 0, 65535]]


@pytest.mark.parametrize(("encoding", "image"), [
    (LinearDepth(1e-3), np.zeros((4, 4), np.uint8)),
    (LinearDepth(1e-3), np.zeros((4, 4, 3), np.uint16)),
    (ReversedZDepth(0.01, 1), np.zeros((4, 4), np.uint16)),
    (ReversedZDepth(0.01, 1), np.arange(48, dtype=np.uint8).reshape(4, 4, 3)),
    (PointMapDepth(1e-3), np.zeros((4, 4), np.float32)),
    (PointMapDepth(1e-3), np.zeros((4, 4, 3), np.uint8)),
    (RelativeInverseDepth(), np.zeros((4, 4), np.uint8)),
])
def test_images_of_another_kind_are_refused_in_one_line(encoding, image):
    with pytest.raises(RecordingError, match=r"^depth of frame 3 (is .* with shape|holds inverse)") as caught:
        encoding.depth_m(image, "depth of frame 3")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("planes", [(0, 1), (1, 1), (2, 1), (0.1, np.inf), (np.nan, 1)])
def test_impossible_planes(planes):
    with pytest.raises(RecordingError, match="0 < near < far"):
        ReversedZDepth(*planes)
