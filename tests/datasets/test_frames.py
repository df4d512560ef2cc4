"""Frames: lazy like they promise, in the right order, and clear about files that are damaged."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

import pftrack
from pftrack import video
from pftrack.datasets.frames import Dimmed, Frames, ImageFrames, VideoFrames, open_frames

N_FRAMES = 24


class Recorder(Frames):
    """Ten frames that remember which of them were read."""

    def __init__(self):
        self.reads = []

    def __len__(self):
        return 10

    def read(self, index):
        self.reads.append(index)
        return index


class Pictures(Frames):
    """Frames that are held in memory."""

    def __init__(self, pictures):
        self.pictures = pictures

    def __len__(self):
        return len(self.pictures)

    def read(self, index):
        return self.pictures[index]


def picture(index: int) -> np.ndarray:
    """A 48x64 picture that can be told from its neighbours even after lossy compression, and is not flat."""
    grain = np.random.default_rng(index).integers(-20, 21, (12, 16, 1)).repeat(4, 0).repeat(4, 1)
    return np.clip(np.full((48, 64, 3), 30 + 8 * index) + grain, 0, 255).astype(np.uint8)


def nearest(frame: np.ndarray) -> int:
    """Number of the picture that a decoded frame shows."""
    return int(np.argmin([np.abs(frame.astype(int) - picture(n)).mean() for n in range(N_FRAMES)]))


@pytest.fixture
def folder(tmp_path):
    """Five images, named so that their order is not that of their making."""
    for index in (3, 0, 4, 1, 2):
        assert cv2.imwrite(str(tmp_path / f"{index:03}.png"), picture(index))
    return tmp_path


def write_avi(path: Path) -> bytes:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, (64, 48))
    for index in range(N_FRAMES):
        writer.write(picture(index))
    writer.release()
    return path.read_bytes()


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    path = tmp_path_factory.mktemp("film") / "film.mp4"
    video.write(path, (picture(index) for index in range(N_FRAMES)), fps=12.5)
    return path


@pytest.fixture
def short_film(tmp_path):
    """A film that announces all its frames and holds only some of them."""
    path = tmp_path / "short.avi"
    data = write_avi(path)
    path.write_bytes(data[: len(data) * 6 // 10])
    return path


# ---------------------------------------------------------------------------------------------------------------------
# The list
# ---------------------------------------------------------------------------------------------------------------------


def test_asking_for_one_frame_reads_no_other():
    frames = Recorder()
    assert frames[7] == 7
    assert frames.reads == [7]


@pytest.mark.parametrize(
    "part",
    [slice(None), slice(2, 5), slice(-3, None), slice(None, None, -1), slice(1, 9, 3), slice(8, 2), slice(5, 99)],
    ids=str,
)
def test_a_slice_is_that_of_a_list_but_reads_only_what_is_asked(part):
    frames = Recorder()
    chosen = frames[part]
    assert len(chosen) == len(range(10)[part])
    assert frames.reads == []
    assert list(chosen) == list(range(10))[part]
    assert frames.reads == list(range(10))[part]


def test_a_slice_of_a_slice_is_lazy_and_right():
    frames = Recorder()
    chosen = frames[2:9][::-2]
    assert frames.reads == []
    assert list(chosen) == list(range(10))[2:9][::-2]
    assert chosen[-1] == list(range(10))[2:9][::-2][-1]


@pytest.mark.parametrize("index", [-1, -10, 0, 9, np.int64(4), np.int64(-4)])
def test_an_index_counts_from_either_end(index):
    assert Recorder()[index] == list(range(10))[index]


@pytest.mark.parametrize("index", [10, -11, 1000])
def test_an_index_beyond_either_end_raises_index_error(index):
    frames = Recorder()
    with pytest.raises(IndexError, match="of 10"):
        frames[index]
    assert frames.reads == []


def test_an_index_beyond_a_slice_does_not_reach_into_the_rest():
    with pytest.raises(IndexError, match="of 3"):
        Recorder()[2:5][3]


# ---------------------------------------------------------------------------------------------------------------------
# Fading light
# ---------------------------------------------------------------------------------------------------------------------


class Grey(Recorder):
    """Ten frames that are grey all over, as bright as 200."""

    def read(self, index):
        super().read(index)
        return np.full((4, 6, 3), 200, np.uint8)


def test_light_fades_evenly_from_all_to_what_is_left():
    frames = Dimmed(Grey(), 0.9)
    assert len(frames) == 10
    assert [int(frame[0, 0, 0]) for frame in frames] == [200, 180, 160, 140, 120, 100, 80, 60, 40, 20]
    assert {frame.shape for frame in frames} == {(4, 6, 3)}
    assert {frame.dtype for frame in frames} == {np.dtype(np.uint8)}


def test_a_part_of_a_dimmed_film_is_as_dark_as_in_the_whole_and_read_when_it_is_asked_for():
    grey = Grey()
    last = Dimmed(grey, 0.9)[-2:]
    assert grey.reads == []
    assert [int(frame.mean()) for frame in last] == [40, 20]
    assert grey.reads == [8, 9]


def test_light_that_does_not_fade_changes_nothing():
    pictures = np.random.default_rng(0).integers(0, 256, (3, 5, 7, 3), dtype=np.uint8)
    for frame, shown in zip(pictures, Dimmed(Pictures(pictures), 0.0), strict=True):
        np.testing.assert_array_equal(shown, frame)


@pytest.mark.parametrize("illumination", [-0.1, 1.0, np.nan])
def test_light_cannot_fade_by_more_than_there_is(illumination):
    with pytest.raises(ValueError, match="illumination"):
        Dimmed(Grey(), illumination)


# ---------------------------------------------------------------------------------------------------------------------
# Folders of images
# ---------------------------------------------------------------------------------------------------------------------


def test_images_come_in_the_order_of_their_names(folder):
    frames = open_frames(folder)
    assert len(frames) == 5
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame, picture(index))
    np.testing.assert_array_equal(frames[-1], picture(4))


def test_only_the_asked_image_is_decoded(folder):
    """All the others are damaged, which nobody notices."""
    for index in (0, 1, 3, 4):
        (folder / f"{index:03}.png").write_bytes(b"")
    frames = ImageFrames.from_folder(folder)
    np.testing.assert_array_equal(frames[2], picture(2))
    np.testing.assert_array_equal(frames[1:4][1], picture(2))
    with pytest.raises(ValueError, match="damaged"):
        frames[3]


def test_files_that_are_no_images_are_passed_over(folder):
    (folder / "notes.txt").write_text("not a frame")
    (folder / "truth.csv").write_text("0,1,2,3,4")
    cv2.imwrite(str(folder / "005.JPG"), picture(5))
    assert [path.name for path in open_frames(folder).paths] == [*(f"{n:03}.png" for n in range(5)), "005.JPG"]


@pytest.mark.parametrize(
    "stored",
    [picture(0)[:, :, 0], np.dstack([picture(0), picture(0)[:, :, :1]]), picture(0).astype(np.uint16) * 257],
    ids=["grey", "with transparency", "16 bit"],
)
def test_every_image_becomes_three_channels_of_uint8(tmp_path, stored):
    cv2.imwrite(str(tmp_path / "0.png"), stored)
    frame = open_frames(tmp_path)[0]
    assert frame.shape == (48, 64, 3)
    assert frame.dtype == np.uint8


def test_an_empty_folder_says_what_it_looked_for(tmp_path):
    (tmp_path / "readme.txt").write_text("no images here")
    with pytest.raises(FileNotFoundError, match=r"holds no images.*\.png"):
        open_frames(tmp_path)


def test_a_folder_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        ImageFrames.from_folder(tmp_path / "nowhere")


def test_no_paths_at_all_is_an_error():
    with pytest.raises(FileNotFoundError, match="no image files"):
        ImageFrames([])


def test_an_image_that_has_gone_is_named(folder):
    frames = open_frames(folder)
    (folder / "002.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"002\.png does not exist"):
        frames[2]


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".webp", ".tif"])
def test_an_image_cut_in_half_is_an_error_not_half_a_picture(tmp_path, suffix):
    path = tmp_path / f"0{suffix}"
    cv2.imwrite(str(path), picture(0))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=f"0{suffix} cannot be decoded.*damaged"):
        open_frames(tmp_path)[0]


@pytest.mark.parametrize("content", [b"", b"this is a text"], ids=["empty", "text"])
def test_a_file_that_only_calls_itself_an_image_is_named(tmp_path, content):
    (tmp_path / "0.jpg").write_bytes(content)
    with pytest.raises(ValueError, match=r"0\.jpg cannot be decoded"):
        open_frames(tmp_path)[0]


# ---------------------------------------------------------------------------------------------------------------------
# Videos
# ---------------------------------------------------------------------------------------------------------------------


def test_frame_i_of_a_video_is_the_ith_picture(film):
    frames = open_frames(film)
    assert len(frames) == N_FRAMES
    assert [nearest(frame) for frame in frames] == list(range(N_FRAMES))
    assert frames.fps == pytest.approx(12.5)
    assert frames.shape == frames[0].shape == (48, 64, 3)


def test_video_frames_in_random_order_equal_the_sequential_ones(film):
    frames = VideoFrames(film)
    in_order = list(frames)
    for index in np.random.default_rng(0).permutation(N_FRAMES):
        np.testing.assert_array_equal(frames[index], in_order[index])
    np.testing.assert_array_equal(frames[-1], in_order[-1])
    for frame, index in zip(frames[20:3:-5], range(20, 3, -5), strict=True):
        np.testing.assert_array_equal(frame, in_order[index])


def test_two_walks_through_one_video_do_not_disturb_each_other(film):
    frames = VideoFrames(film)
    in_order = list(frames)
    for n, (ahead, behind) in enumerate(zip(frames[3:], frames, strict=False)):
        np.testing.assert_array_equal(ahead, in_order[n + 3])
        np.testing.assert_array_equal(behind, in_order[n])


def test_threads_may_share_one_video(film):
    frames = VideoFrames(film)
    in_order = list(frames)
    wrong = []

    def walk(seed):
        for index in np.random.default_rng(seed).integers(N_FRAMES, size=20):
            if not np.array_equal(frames[index], in_order[index]):
                wrong.append(index)

    threads = [threading.Thread(target=walk, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_a_video_that_ends_early_stops_when_iterated(short_film):
    frames = VideoFrames(short_film)
    assert len(frames) == N_FRAMES
    shown = [nearest(frame) for frame in frames]
    assert 0 < len(shown) < N_FRAMES
    assert shown == list(range(len(shown)))


def test_a_slice_of_a_video_that_ends_early_stops_like_the_whole(short_film):
    frames = VideoFrames(short_film)
    n_real = len(list(frames))
    assert len(list(frames[2:])) == n_real - 2


def test_a_frame_beyond_the_real_end_is_an_error_and_the_others_stay_readable(short_film):
    frames = VideoFrames(short_film)
    n_real = len(list(frames))
    for index in (n_real, N_FRAMES - 1, -1):
        with pytest.raises(ValueError, match=rf"short\.avi ends before frame .* announces {N_FRAMES}"):
            frames[index]
    assert nearest(frames[n_real - 1]) == n_real - 1
    assert nearest(frames[0]) == 0
    with pytest.raises(IndexError):
        frames[N_FRAMES]


def test_a_stream_that_announces_no_length_is_counted(tmp_path):
    pictures = (cv2.imencode(".jpg", picture(index))[1].tobytes() for index in range(N_FRAMES))
    (tmp_path / "stream.mjpeg").write_bytes(b"".join(pictures))
    frames = open_frames(tmp_path / "stream.mjpeg")
    assert len(frames) == N_FRAMES
    assert [nearest(frame) for frame in frames] == list(range(N_FRAMES))


def test_a_missing_video_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no video file .*film\.mp4"):
        open_frames(tmp_path / "film.mp4")


@pytest.mark.parametrize("content", [b"", b"no video at all " * 100, None], ids=["empty", "text", "first half"])
def test_a_damaged_video_is_named(tmp_path, film, content):
    path = tmp_path / "bad.mp4"
    data = film.read_bytes()
    path.write_bytes(data[: len(data) // 8] if content is None else content)
    with pytest.raises(ValueError, match=r"bad\.mp4 cannot be decoded as a video; it may be damaged"):
        open_frames(path)


# ---------------------------------------------------------------------------------------------------------------------
# Memory
# ---------------------------------------------------------------------------------------------------------------------

MEASURE = """
import resource, sys
from pathlib import Path
import pftrack

def peak():  # in MB, of this process alone where the system tells; ru_maxrss may still hold the parent's peak
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.is_file() else []
    own = [int(line.split()[1]) for line in lines if line.startswith("VmHWM")]
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return own[0] / 2**10 if own else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit

tracker = pftrack.ColorParticleFilter(n_particles=5, seed=0)
frames = pftrack.datasets.open_frames(sys.argv[1])
for t, estimate in enumerate(pftrack.follow(tracker, frames, (300, 200, 40, 100))):
    if t == 50:
        early = peak()
print(t + 1, early, peak())
"""


def test_memory_does_not_grow_with_the_length_of_the_film(tmp_path):
    """Decoded, the 600 frames of 768x576 would take 760 MB; the pictures are many names for three files."""
    grain = np.random.default_rng(0).integers(0, 256, (72, 96, 3), dtype=np.uint8)
    folder = tmp_path / "long"
    folder.mkdir()
    for n in range(3):
        cv2.imwrite(str(tmp_path / f"{n}.jpg"), cv2.resize(np.roll(grain, n, axis=1), (768, 576)))
    for n in range(600):
        os.link(tmp_path / f"{n % 3}.jpg", folder / f"{n:04}.jpg")
    environment = {**os.environ, "PYTHONPATH": str(Path(pftrack.__file__).parents[1])}
    result = subprocess.run(
        [sys.executable, "-c", MEASURE, str(folder)], capture_output=True, text=True, env=environment, check=False
    )
    assert result.returncode == 0, result.stderr
    n_frames, early, late = map(float, result.stdout.split())
    assert n_frames == 600
    assert late - early < 20
    assert late < 400
