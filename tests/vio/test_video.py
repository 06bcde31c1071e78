"""Films: times that somebody measured, frames in any order, and films that decode only partly."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from tests.vio.samples import PATIENT, SECONDS, film, own_video, pictures
from vio import open_recording
from vio.conversion import convert_to_asl
from vio.errors import RecordingError
from vio.formats.declared import Declared
from vio.formats.video import _before_hole
from vio.video_frames import VideoFrames, presentation_times_s


def test_presentation_times_are_never_taken_for_capture_times(tmp_path: Path):
    film(tmp_path / "x.avi", pictures())
    with pytest.raises(RecordingError, match=r"^x\.avi: a film's presentation times are not .*add x\.csv.*--pres"):
        open_recording(tmp_path / "x.avi")
    np.testing.assert_allclose(presentation_times_s(tmp_path / "x.avi"), np.arange(6) / 30, atol=1e-3)
    told = open_recording(tmp_path / "x.avi", declared=Declared(presentation_times=True))
    np.testing.assert_allclose(told.frame_t_s, np.arange(6) / 30, atol=1e-3)
    (tmp_path / "x.csv").write_text("t_ms\n" + "".join(f"{1000 * s}\n" for s in SECONDS))
    measured = open_recording(tmp_path / "x.avi")
    np.testing.assert_array_equal(measured.frame_t_ns, np.array(SECONDS) * 1e9)
    with pytest.raises(RecordingError, match=r"x\.csv lists the times"):
        open_recording(tmp_path / "x.avi", declared=Declared(presentation_times=True))


def test_frames_come_in_any_order_and_from_other_processes(tmp_path: Path):
    images = pictures()
    film(tmp_path / "x.avi", images)
    frames = VideoFrames(tmp_path / "x.avi", 6)
    for k in (0, 1, 1, 4, 2, 5, 0):
        got = frames.read(k)
        np.testing.assert_array_equal(got, images[k])
        got[:] = 0  # the caller's copy
    again = pickle.loads(pickle.dumps(frames))
    np.testing.assert_array_equal(again.read(3), images[3])


def noisy_mjpeg(path: Path) -> None:
    film(path, np.random.default_rng(0).integers(0, 255, (20, 64, 64, 3), dtype=np.uint8), "MJPG")


def test_a_film_that_is_cut_off_names_the_usable_part(tmp_path: Path):
    noisy_mjpeg(tmp_path / "x.avi")
    content = (tmp_path / "x.avi").read_bytes()
    (tmp_path / "x.avi").write_bytes(content[: len(content) // 2])
    (tmp_path / "x.csv").write_text("t_s\n" + "".join(f"{k}\n" for k in range(20)))
    usable = len(presentation_times_s(tmp_path / "x.avi"))
    assert 5 < usable < 15
    with pytest.raises(RecordingError, match=rf"{usable} frames decode, but x\.csv lists 20 .* 0 to {usable - 1} "):
        open_recording(tmp_path / "x.avi")
    with pytest.raises(RecordingError, match=rf"^frame {usable}: .*frames 0 to {usable - 1} are usable"):
        VideoFrames(tmp_path / "x.avi", 20).read(17)


def test_a_film_damaged_after_it_was_opened_leaves_nothing_behind(tmp_path: Path, monkeypatch):
    made = own_video(tmp_path / "data")
    rate = presentation_times_s(made.root / "film.avi")
    (made.root / "frames.csv").write_text("t_s\n" + "".join(f"{k}\n" for k in range(9)))
    monkeypatch.setattr("vio.formats.video.presentation_times_s", lambda path: np.arange(9) * rate[1])
    with pytest.raises(RecordingError, match=r"^frame 6: .*film\.avi cannot be decoded from here on; frames 0 to 5"):
        convert_to_asl(made.root, tmp_path / "REC")
    assert [file.name for file in tmp_path.iterdir()] == ["data"]


def test_frames_lost_in_the_middle_end_the_usable_part_there():
    shown = np.arange(10) / 30
    assert _before_hole(shown) == 10 and _before_hole(shown[:1]) == 1
    assert _before_hole(np.delete(shown, [4])) == 4


@pytest.mark.parametrize("content", [b"", b"no film", b"RIFF\0\0\0\0AVI " + bytes(200)])
def test_what_is_no_film_is_refused_in_one_line(tmp_path: Path, capfd, content):
    (tmp_path / "x.avi").write_bytes(content)
    with pytest.raises(RecordingError, match=r"x\.avi: (not a film|no frame of this film)") as caught:
        open_recording(tmp_path / "x.avi")
    assert "\n" not in str(caught.value) and capfd.readouterr().err == ""


def test_two_films_in_a_folder_are_one_too_many(tmp_path: Path):
    made = own_video(tmp_path)
    film(made.root / "other.avi", pictures())
    with pytest.raises(RecordingError, match=rf"^{PATIENT}: 2 films; give a folder with one"):
        open_recording(made.root)
