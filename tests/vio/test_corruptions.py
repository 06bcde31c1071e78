"""Image corruptions: same seed same bytes, worse where the table says so, and true to their definitions."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vio.corruptions import CORRUPTIONS, PARAMETERS, SEVERITIES, corrupt
from vio.errors import CorruptionError

GROWING = ("impulse_noise", "speckle_noise", "shot_noise", "gaussian_noise", "gaussian_blur", "defocus_blur",
           "brightness", "contrast")
"""Kinds whose only strength parameter grows (or shrinks) from severity to severity."""


def scene(height=48, width=64, seed=0):
    """Mid-grey to bright texture of several scales, nowhere near the ends of the range, in colour."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.random((height // s + 1, width // s + 1, 3)), (width, height)) for s in (2, 6, 20)]
    return np.rint(70 + 90 * np.mean(layers, axis=0)).astype(np.uint8)


def distance(image, other):
    return float(np.abs(image.astype(float) - other).mean())


@given(st.sampled_from(CORRUPTIONS), st.sampled_from(SEVERITIES), st.integers(1, 40), st.integers(1, 40),
       st.sampled_from(["hendrycks", "imagecorruptions"]), st.integers(0, 2**32))
@settings(max_examples=60)
def test_any_size_comes_back_with_the_same_bytes_for_the_same_seed(kind, severity, height, width, elastic, seed):
    image = scene(height, width)
    before = image.copy()
    once, again = (corrupt(image, kind, severity, np.random.default_rng(seed), elastic) for _ in range(2))
    assert once.dtype == np.uint8 and once.shape == image.shape
    np.testing.assert_array_equal(once, again)
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("kind", [*GROWING, "elastic_transform"])
def test_distance_from_the_clean_image_grows_with_severity(kind):
    image = scene(120, 160)
    far = [distance(image, corrupt(image, kind, s, np.random.default_rng(1), "imagecorruptions")) for s in SEVERITIES]
    assert far[0] > 0.3 and (np.diff(far) > 0).all(), far


def test_noise_has_the_strength_of_the_table():
    grey = np.full((200, 200, 3), 128, np.uint8)
    level = 128 / 255
    for severity in SEVERITIES:
        spread = {kind: (corrupt(grey, kind, severity, np.random.default_rng(2)) / 255.0).std()
                  for kind in ("speckle_noise", "shot_noise", "gaussian_noise")}
        sigma, photons = PARAMETERS["speckle_noise"][severity - 1], PARAMETERS["shot_noise"][severity - 1]
        assert spread["speckle_noise"] == pytest.approx(sigma * level, rel=0.1)  # the ends of the range cut a little
        assert spread["shot_noise"] == pytest.approx((level / photons) ** 0.5, rel=0.25 if photons < 10 else 0.1)
        if severity <= 2:
            assert spread["gaussian_noise"] == pytest.approx(PARAMETERS["gaussian_noise"][severity - 1], rel=0.05)
        hit = corrupt(grey, "impulse_noise", severity, np.random.default_rng(2))
        share = PARAMETERS["impulse_noise"][severity - 1]
        assert (hit == 0).mean() == pytest.approx(share / 2, rel=0.1) == pytest.approx((hit == 255).mean(), rel=0.1)


def test_blurs_spread_a_point_as_far_as_the_table_says():
    dot = np.zeros((61, 61, 3), np.uint8)
    dot[30, 30] = 255
    square = ((np.arange(61) - 30) ** 2)[:, None] + (np.arange(61) - 30) ** 2
    for severity in SEVERITIES:
        disk = corrupt(dot, "defocus_blur", severity, np.random.default_rng(0))[..., 0]
        radius = PARAMETERS["defocus_blur"][severity - 1][0]
        if radius < 8:  # fainter disks round to nothing
            assert disk[square <= (radius - 1) ** 2].min() > 0 == disk[square > (radius + 2) ** 2].max()
    bright = np.zeros((61, 61, 3), np.uint8)
    bright[28:33, 28:33] = 255
    for severity in (1, 2, 3):
        soft = corrupt(bright, "gaussian_blur", severity, np.random.default_rng(0))[..., 0].astype(float)
        per_axis = (soft * square).sum() / soft.sum() / 2
        of_square, sigma = 2, PARAMETERS["gaussian_blur"][severity - 1]
        assert per_axis == pytest.approx(of_square + sigma**2, rel=0.1)


def test_glass_only_moves_pixels_before_it_blurs():
    """Mass is kept, and no light goes farther than all swaps and both blurs can carry it."""
    image = scene(60, 60)
    for severity in SEVERITIES:
        out = corrupt(image, "glass_blur", severity, np.random.default_rng(4))
        assert out.mean() == pytest.approx(image.mean(), abs=0.6)
        assert distance(image, out) > distance(image, corrupt(image, "gaussian_blur", 1, np.random.default_rng(4))) / 2
        sigma = PARAMETERS["glass_blur"][severity - 1][0]
        unmoved = cv2.GaussianBlur(image, (0, 0), sigma * 2**0.5)  # what both blurs do without the swaps
        assert distance(unmoved, out) > 0.5 * severity**0.5
    flat = np.full((30, 30, 3), 91, np.uint8)
    assert (corrupt(flat, "glass_blur", 5, np.random.default_rng(0)) == 91).all()


def test_colours_change_in_the_channel_of_their_name_only():
    image = scene(40, 40)
    hsv = cv2.cvtColor((image / 255).astype(np.float32), cv2.COLOR_RGB2HSV)
    for severity in SEVERITIES:
        rng = np.random.default_rng(0)
        factor, offset = PARAMETERS["saturate"][severity - 1]
        value, other = (cv2.cvtColor((corrupt(image, kind, severity, rng) / 255).astype(np.float32), cv2.COLOR_RGB2HSV)
                        for kind in ("brightness", "saturate"))
        lifted = np.clip(hsv[..., 2] + PARAMETERS["brightness"][severity - 1], 0, 1)
        np.testing.assert_allclose(value[..., 2], lifted, atol=0.003)
        np.testing.assert_allclose(other[..., 2], hsv[..., 2], atol=0.003)
        np.testing.assert_allclose(other[..., 1], np.clip(hsv[..., 1] * factor + offset, 0, 1), atol=0.02)
        flat = corrupt(image, "contrast", severity, rng).astype(float)
        mean, k = image.mean(axis=(0, 1)), PARAMETERS["contrast"][severity - 1]
        np.testing.assert_allclose(flat, (image - mean) * k + mean, atol=0.51)


def test_water_brightens_mud_covers_and_most_of_the_image_stays():
    image = scene(160, 160)
    for severity in SEVERITIES:
        out = corrupt(image, "spatter", severity, np.random.default_rng(6)).astype(int)
        changed = (out != image).any(axis=2)
        assert 0.001 < changed.mean() < 0.5
        assert (out - image >= 0).all() if severity <= 3 else (out - image)[changed].mean() < -20


def test_published_elastic_shakes_most_at_severity_two_and_scales_with_the_image():
    image = scene(120, 120)
    far = {s: np.mean([distance(image, corrupt(image, "elastic_transform", s, np.random.default_rng(k)))
                       for k in range(6)]) for s in SEVERITIES}
    assert far[2] == max(far.values()) and far[3] < far[4] < far[5]


@pytest.mark.parametrize(("change", "words"), [
    ({"kind": "fog"}, "unknown; use one of impulse_noise"), ({"severity": 0}, "severity is 0"),
    ({"severity": 6}, "from 1 to 5"), ({"elastic": "rubber"}, "rubber"),
    ({"image": np.zeros((8, 8), np.uint8)}, "repeat a grey image"), ({"image": np.zeros((8, 8, 3))}, "must be uint8"),
])
def test_what_cannot_be_corrupted_is_refused_in_one_line(change, words):
    given_ = {"image": scene(8, 8), "kind": "contrast", "severity": 1, "rng": np.random.default_rng(0)} | change
    with pytest.raises(CorruptionError, match=words) as caught:
        corrupt(**given_)
    assert "\n" not in str(caught.value)


def test_a_real_frame_survives_all_sixty(shared_data):
    path = shared_data / "endoslam_unitycam_stomach" / "frames" / "image_0100.png"
    image = cv2.resize(cv2.imread(str(path))[..., ::-1], (160, 160), interpolation=cv2.INTER_AREA)
    for kind in CORRUPTIONS:
        outs = [corrupt(image, kind, s, np.random.default_rng(9)) for s in SEVERITIES]
        assert all(0.2 < distance(image, out) < 90 for out in outs), kind
        assert len({out.tobytes() for out in outs}) >= 4, kind  # full saturation can be reached at severity 4
