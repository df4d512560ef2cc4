"""Video that plays in a browser, files that appear only when complete, and pictures drawn on."""

import weakref

import av
import numpy as np
import pytest

from pftrack import datasets, video
from pftrack.multi import Track


def ramp(n_frames=8, size=(48, 64)):
    """Frames of growing grey with a coloured corner; each can be told from the next."""
    for n in range(n_frames):
        frame = np.full((*size, 3), 20 + 25 * n % 200, dtype=np.uint8)
        frame[: size[0] // 2, : size[1] // 2] = (200, 60, 30)
        yield frame


def decode(path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]


# ---------------------------------------------------------------------------------------------------------------------
# Encoding
# ---------------------------------------------------------------------------------------------------------------------


def test_a_written_film_has_the_codec_that_browsers_play(tmp_path):
    video.write(tmp_path / "film.mp4", ramp(), fps=12.5)
    with av.open(str(tmp_path / "film.mp4")) as container:
        (stream,) = container.streams
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert (stream.codec_context.width, stream.codec_context.height) == (64, 48)
        assert float(stream.average_rate) == pytest.approx(12.5)
        assert float(stream.duration * stream.time_base) == pytest.approx(8 / 12.5)
    data = (tmp_path / "film.mp4").read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")  # the index comes first, so it plays while it loads


def test_all_frames_are_there_in_order_and_look_alike(tmp_path):
    video.write(tmp_path / "film.mp4", ramp(), fps=25, quality=18)
    decoded = decode(tmp_path / "film.mp4")
    assert len(decoded) == 8
    for original, copy in zip(ramp(), decoded, strict=True):
        assert np.abs(original.astype(int) - copy).mean() < 4


def test_encode_gives_the_same_film_in_memory(tmp_path):
    (tmp_path / "film.mp4").write_bytes(video.encode(ramp(), fps=25))
    assert len(decode(tmp_path / "film.mp4")) == 8
    assert video.encode(ramp(), fps=25) == video.encode(ramp(), fps=25)


def test_a_higher_rate_factor_gives_a_smaller_file():
    frames = list(datasets.synthetic.scene(n_frames=6).frames)
    assert len(video.encode(frames, fps=25, quality=40)) < len(video.encode(frames, fps=25, quality=18)) / 2


@pytest.mark.parametrize("size", [(47, 63), (48, 63), (47, 64), (3, 5)], ids=str)
def test_odd_sizes_lose_a_row_or_a_column_at_the_end(tmp_path, size):
    frames = list(ramp(size=size))
    video.write(tmp_path / "film.mp4", frames, fps=25, quality=18)
    decoded = decode(tmp_path / "film.mp4")
    height, width = size[0] // 2 * 2, size[1] // 2 * 2
    assert [frame.shape for frame in decoded] == [(height, width, 3)] * 8
    if height > 10:
        assert np.abs(frames[0][:height, :width].astype(int) - decoded[0]).mean() < 4


def test_frames_that_are_not_contiguous_are_written_as_they_look(tmp_path):
    video.write(tmp_path / "film.mp4", (frame[:, ::-1] for frame in ramp()), fps=25, quality=18)
    for original, copy in zip(ramp(), decode(tmp_path / "film.mp4"), strict=True):
        assert np.abs(original[:, ::-1].astype(int) - copy).mean() < 4


@pytest.mark.parametrize("frames", [[], iter(())], ids=["list", "iterator"])
def test_no_frames_are_an_error_and_no_file(tmp_path, frames):
    with pytest.raises(ValueError, match="no frames to write"):
        video.encode([], fps=25)
    with pytest.raises(ValueError, match="no frames to write"):
        video.write(tmp_path / "film.mp4", frames, fps=25)
    assert list(tmp_path.iterdir()) == []


def test_frames_without_two_rows_and_columns_are_an_error_and_no_file(tmp_path):
    with pytest.raises(ValueError, match=r"size|rows|pixels|64x1"):
        video.write(tmp_path / "film.mp4", ramp(size=(1, 64)), fps=25)
    assert list(tmp_path.iterdir()) == []


def test_frames_of_a_generator_are_held_one_at_a_time(tmp_path):
    alive, most = weakref.WeakSet(), 0

    class Frame(np.ndarray):
        __hash__ = object.__hash__

    def frames():
        nonlocal most
        for frame in ramp(n_frames=50):
            frame = frame.view(Frame)
            alive.add(frame)
            most = max(most, len(alive))
            yield frame

    video.write(tmp_path / "film.mp4", frames(), fps=25)
    assert len(decode(tmp_path / "film.mp4")) == 50
    assert most <= 3


# ---------------------------------------------------------------------------------------------------------------------
# Files that appear only when they are complete
# ---------------------------------------------------------------------------------------------------------------------


def test_a_film_replaces_an_older_one(tmp_path):
    (tmp_path / "film.mp4").write_text("old")
    video.write(tmp_path / "film.mp4", ramp(), fps=25)
    assert len(decode(tmp_path / "film.mp4")) == 8
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


@pytest.mark.parametrize("error", [ValueError, OSError, KeyboardInterrupt, GeneratorExit])
def test_a_film_that_breaks_off_leaves_the_old_one_and_nothing_else(tmp_path, error):
    def frames():
        yield from ramp()
        raise error("stop")

    (tmp_path / "film.mp4").write_text("old")
    with pytest.raises(error, match="stop"):
        video.write(tmp_path / "film.mp4", frames(), fps=25)
    assert (tmp_path / "film.mp4").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


def test_a_missing_folder_is_named_before_any_work(tmp_path):
    def frames():
        pytest.fail("a frame was asked for")
        yield

    with pytest.raises(FileNotFoundError, match=r"cannot write .*film\.mp4: the folder .*nowhere does not exist"):
        video.write(tmp_path / "nowhere" / "film.mp4", frames(), fps=25)


# ---------------------------------------------------------------------------------------------------------------------
# Drawing
# ---------------------------------------------------------------------------------------------------------------------

VERMILION, YELLOW, BLUE, ORANGE = (0, 94, 213), (66, 228, 240), (178, 114, 0), (0, 159, 230)  # BGR


@pytest.fixture
def frame():
    return np.random.default_rng(0).integers(60, 190, (120, 160, 3)).astype(np.uint8)


def changed(before, after) -> np.ndarray:
    assert after.shape == before.shape
    assert after.dtype == np.uint8
    return (before != after).any(axis=2)


def band(box, inner: int, outer: int, shape=(120, 160)) -> np.ndarray:
    """Pixels from `inner` inside to `outer` outside the outline of a box."""
    x, y, w, h = box
    mask = np.zeros(shape, dtype=bool)
    mask[max(y - outer, 0) : y + h + outer, max(x - outer, 0) : x + w + outer] = True
    mask[y + inner : y + h - inner, x + inner : x + w - inner] = False
    return mask


def test_annotate_leaves_its_input_alone(frame):
    copy, particles = frame.copy(), np.array([[30.0, 40, 0, 0, 1]])
    box, truth = np.array([50.0, 30, 40, 60]), np.array([55.0, 35, 40, 60])
    annotated = video.annotate(frame, box, lost=True, truth=truth, particles=particles)
    np.testing.assert_array_equal(frame, copy)
    np.testing.assert_array_equal(box, [50, 30, 40, 60])
    np.testing.assert_array_equal(particles, [[30, 40, 0, 0, 1]])
    assert annotated is not frame
    assert changed(frame, annotated).any()


def test_the_box_is_drawn_along_its_outline_and_nowhere_else(frame):
    box = (50, 30, 40, 60)
    annotated = video.annotate(frame, box)
    drawn = changed(frame, annotated)
    assert not drawn[~band(box, inner=2, outer=2)].any()
    for corner in ((30, 50), (30, 89), (89, 50), (89, 89)):
        assert drawn[corner]
    assert (annotated[drawn] == VERMILION).all()


def test_a_lost_box_is_yellow_and_says_so_in_the_corner(frame):
    box = (90, 50, 40, 60)
    annotated = video.annotate(frame, box, lost=True)
    drawn = changed(frame, annotated)
    allowed = band(box, inner=2, outer=2)
    allowed[:40, :80] = True
    assert not drawn[~allowed].any()
    assert drawn[:40, :80].any()
    assert (annotated[drawn & band(box, 2, 2)] == YELLOW).all()


def test_a_missing_box_draws_nothing(frame):
    np.testing.assert_array_equal(video.annotate(frame, [np.nan] * 4), frame)
    np.testing.assert_array_equal(video.annotate(frame, [np.nan] * 4, truth=[np.nan] * 4), frame)
    np.testing.assert_array_equal(video.annotate(frame, [np.nan] * 4, particles=np.empty((0, 5))), frame)


def test_the_truth_is_a_half_transparent_blue_area(frame):
    annotated = video.annotate(frame, [np.nan] * 4, truth=(50, 30, 40, 60))
    drawn = changed(frame, annotated)
    assert not drawn[~band((50, 30, 40, 60), inner=30, outer=1)].any()
    inside = np.s_[30:90, 50:90]
    share = 0.35
    expected = share * np.array(BLUE) + (1 - share) * frame[inside].astype(float)
    assert np.abs(annotated[inside] - expected).max() <= 1


def test_the_true_area_has_the_size_of_the_true_box(frame):
    drawn = changed(frame, video.annotate(frame, [np.nan] * 4, truth=(50, 30, 40, 60)))
    y, x = np.nonzero(drawn)
    assert (x.min(), y.min(), x.max() + 1 - x.min(), y.max() + 1 - y.min()) == (50, 30, 40, 60)


def test_particles_are_orange_dots_at_their_positions(frame):
    particles = np.array([[30.2, 40.4, 9, 9, 1], [100, 80, 9, 9, 1]])
    annotated = video.annotate(frame, [np.nan] * 4, particles=particles)
    y, x = np.nonzero(changed(frame, annotated))
    distance = np.hypot(x[:, None] - [30, 100], y[:, None] - [40, 80]).min(axis=1)
    assert distance.max() <= 4
    assert len(x) >= 2 * 9
    assert tuple(annotated[40, 30]) == tuple(annotated[80, 100]) == ORANGE


@pytest.mark.parametrize(
    "box", [(-20, -20, 60, 60), (140, 100, 100, 100), (500, 500, 10, 10), (-1e4, -1e4, 3e4, 3e4)], ids=str
)
def test_what_lies_beyond_the_border_is_cut_off(frame, box):
    annotated = video.annotate(frame, box, truth=box, particles=[[box[0], box[1]]])
    assert annotated.shape == frame.shape
    if box[0] > 160:
        np.testing.assert_array_equal(annotated, frame)


def test_tracks_have_their_own_colours_and_the_held_ones_thin_boxes(frame):
    boxes = [(20, 40, 30, 50), (90, 40, 30, 50)]
    tracks = [Track(1, np.array(boxes[0], float), 1.0), Track(2, np.array(boxes[1], float), 1.0, held=True)]
    annotated = video.annotate_tracks(frame, tracks)
    assert tuple(annotated[70, 20]) == video.TRACK_COLORS[0]
    assert tuple(annotated[70, 90]) == video.TRACK_COLORS[1]
    drawn = changed(frame, annotated)
    assert drawn[70, :60].sum() > drawn[70, 60:].sum() == 2
    assert not drawn[100:].any()
    dots = video.annotate_tracks(
        frame, [Track(1, tracks[0].box, 1.0, False, np.array([[140.0, 20, 5, 5]]))], particles=True
    )
    assert changed(frame, dots)[18:23, 138:143].any()


def test_no_tracks_draw_nothing(frame):
    np.testing.assert_array_equal(video.annotate_tracks(frame, []), frame)
    beyond = Track(7, np.array([-500.0, -500, 20, 20]), 1.0)
    np.testing.assert_array_equal(video.annotate_tracks(frame, [beyond]), frame)
