"""Figures and clips: what is drawn, and what a browser is given."""

import base64
import html.parser
import io
import json
import re

import av
import cv2
import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure

from pftrack import plots

SHADES = [(200, 30, 30), (30, 200, 30), (30, 30, 200), (128, 128, 128), (10, 10, 10)]  # BGR


def plain_frames(height=48, width=64):
    return [np.full((height, width, 3), shade, dtype=np.uint8) for shade in SHADES]


@pytest.fixture
def ax():
    figure = Figure(figsize=(3, 2), dpi=50)
    FigureCanvasAgg(figure)
    return figure.add_subplot()


def picture(ax):
    """The figure as pixels."""
    canvas = ax.figure.canvas
    canvas.draw()
    return np.array(canvas.buffer_rgba())


# ---------------------------------------------------------------------------------------------------------------------
# Clips
# ---------------------------------------------------------------------------------------------------------------------


def decode(clip):
    with av.open(io.BytesIO(clip.mp4)) as container:
        stream = container.streams.video[0]
        pictures = [frame.to_ndarray(format="bgr24") for frame in container.decode(stream)]
        return stream.codec_context, stream.average_rate, pictures


@pytest.mark.parametrize("fps", [25, 7, 12.5])
def test_a_clip_is_h264_that_browsers_play_with_every_frame_in_its_place(fps):
    clip = plots.Clip(plain_frames(), fps, "Five shades.")
    codec, rate, pictures = decode(clip)
    assert codec.name == "h264"
    assert codec.pix_fmt == "yuv420p"
    assert (codec.width, codec.height) == (64, 48)
    assert rate == pytest.approx(fps)
    assert len(pictures) == 5
    for decoded, shade in zip(pictures, SHADES, strict=True):
        np.testing.assert_allclose(decoded.mean(axis=(0, 1)), shade, atol=12)  # lossy, but the colours in order


def test_frames_may_come_from_a_generator():
    clip = plots.Clip((frame for frame in plain_frames()), 25, "Five shades.")
    assert clip.n_frames == len(decode(clip)[2]) == 5


def test_better_quality_is_nearer_to_the_pictures_and_takes_more_bytes():
    frames = [np.random.default_rng(3).integers(0, 256, size=(48, 64, 3), dtype=np.uint8)] * 3
    good, bad = (plots.Clip(frames, 25, "Noise.", quality=quality) for quality in (10, 45))
    assert len(good.mp4) > len(bad.mp4)

    def error(clip):
        return np.mean([np.abs(picture.astype(int) - frames[0]) for picture in decode(clip)[2]])

    assert error(good) < error(bad)


def test_the_poster_is_the_picture_in_the_middle():
    clip = plots.Clip(plain_frames(), 25, "Five shades.")
    poster = cv2.imdecode(np.frombuffer(clip.poster, np.uint8), cv2.IMREAD_COLOR)
    assert poster.shape == (48, 64, 3)
    np.testing.assert_allclose(poster.mean(axis=(0, 1)), SHADES[2], atol=12)


def test_the_text_of_a_clip_says_what_it_is_and_does_not_change_from_run_to_run():
    first, second = (plots.Clip(plain_frames(), 12.5, "Five shades.") for _ in range(2))
    assert repr(first) == repr(second) == "Clip: 5 frames of 64x48 at 12.5 fps. Five shades."
    assert first._repr_html_() == second._repr_html_()


def test_a_clip_of_odd_size_knows_the_size_of_its_film():
    clip = plots.Clip(plain_frames(49, 65), 25, "Five shades.")
    codec = decode(clip)[0]
    assert (codec.width, codec.height) == (64, 48)
    assert (clip.width, clip.height) == (codec.width, codec.height)


def test_a_clip_without_frames_is_rejected():
    with pytest.raises(ValueError, match="no frames"):
        plots.Clip([], 25, "Nothing.")


class Elements(html.parser.HTMLParser):
    """Every element of a piece of HTML with its attributes, and the text between them."""

    def __init__(self, text):
        super().__init__()
        self.found, self.text = [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text += data


DESCRIPTIONS = ["A red box follows a walker.", "<script>alert(\"x\")</script> & '1 < 2'", "Łódź, σ² → 0"]


@pytest.mark.parametrize("description", DESCRIPTIONS)
def test_the_html_of_a_clip_holds_the_film_the_poster_and_the_description(description):
    clip = plots.Clip(plain_frames(), 25, description)
    elements = Elements(clip._repr_html_())
    assert [tag for tag, _ in elements.found] == ["figure", "video", "figcaption"]  # and no other, such as a script
    video = dict(elements.found)["video"]
    assert video["aria-label"] == description
    assert elements.text == description
    assert "controls" in video
    kind, data = video["src"].split(";base64,")
    assert kind == "data:video/mp4"
    assert base64.b64decode(data) == clip.mp4
    kind, data = video["poster"].split(";base64,")
    assert kind == "data:image/jpeg"
    assert base64.b64decode(data) == clip.poster


@pytest.mark.parametrize("description", DESCRIPTIONS)
def test_the_html_of_a_clip_fetches_nothing_and_shows_no_bare_markup(description):
    text = plots.Clip(plain_frames(), 25, description)._repr_html_()
    assert not re.search(r"https?:", text)
    for _, attributes in Elements(text).found:
        for name in ("src", "href", "poster"):
            assert attributes.get(name, "data:").startswith("data:")
    assert "<script" not in text
    json.dumps(text)  # as a notebook stores it


# ---------------------------------------------------------------------------------------------------------------------
# Figures
# ---------------------------------------------------------------------------------------------------------------------


def test_the_palette_is_that_of_okabe_and_ito():
    """As published in Color Universal Design (2008), in red, green and blue levels."""
    published = {
        "BLACK": (0, 0, 0),
        "ORANGE": (230, 159, 0),
        "SKY": (86, 180, 233),
        "GREEN": (0, 158, 115),
        "YELLOW": (240, 228, 66),
        "BLUE": (0, 114, 178),
        "VERMILION": (213, 94, 0),
        "PURPLE": (204, 121, 167),
    }
    for name, levels in published.items():
        assert tuple(round(255 * level) for level in to_rgb(getattr(plots, name))) == levels


def test_every_role_has_a_colour_of_its_own():
    assert len({plots.TRUTH, plots.ESTIMATE, plots.PARTICLES, plots.BASELINE}) == 4


def test_the_style_draws_on_an_opaque_white_ground_and_without_warnings():
    with matplotlib.rc_context():
        plots.use_style()
        plots.use_style()  # a chapter may run its first cell twice
        figure = Figure()
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        lines = [axes.plot([0, 1], [0, slope])[0] for slope in range(7)]
        pixels = picture(axes)
        saved = io.BytesIO()
        figure.savefig(saved)
    np.testing.assert_array_equal(pixels[0, 0], [255, 255, 255, 255])
    assert pixels[..., 3].min() == 255
    assert (cv2.imdecode(np.frombuffer(saved.getvalue(), np.uint8), cv2.IMREAD_UNCHANGED)[..., 3] == 255).all()
    assert len({to_hex(line.get_color()) for line in lines}) == 7


@pytest.mark.parametrize("channels", [3, 1])
def test_a_frame_is_shown_in_its_colours_with_pixel_coordinates(ax, channels):
    frame = np.random.default_rng(1).integers(0, 256, size=(24, 32, 3), dtype=np.uint8)
    if channels == 1:
        frame = frame[..., 0]
    plots.show_frame(ax, frame, "A frame")
    (image,) = ax.images
    np.testing.assert_array_equal(image.get_array(), frame[..., ::-1] if channels == 3 else frame)
    assert ax.get_xlim() == (0, 32)
    assert ax.get_ylim() == (24, 0)
    assert tuple(image.get_extent()) == (0, 32, 24, 0)
    assert ax.get_title() == "A frame"
    assert "pixels" in ax.get_xlabel()
    assert "pixels" in ax.get_ylabel()


def test_a_dim_grey_picture_stays_dim(ax):
    """Matplotlib would stretch what levels there are to all from black to white."""
    ax.set_position([0, 0, 1, 1])
    plots.show_frame(ax, np.repeat(np.uint8([[100, 120]]), 2, axis=0))
    middle_row = picture(ax)[50, :, :3]
    assert abs(middle_row[40].astype(int) - 100).max() <= 1
    assert abs(middle_row[110].astype(int) - 120).max() <= 1


def test_a_box_covers_its_pixels_of_the_frame(ax):
    """Filled with blue over black, a box leaves no black pixel inside itself and no blue one outside."""
    ax.figure.set_size_inches(4, 3)
    ax.figure.set_dpi(100)
    ax.set_position([0, 0, 1, 1])
    plots.show_frame(ax, np.zeros((30, 40, 3), dtype=np.uint8))  # ten pixels of the figure to one of the frame
    plots.draw_box(ax, [5, 10, 20, 8], fill=True, facecolor="blue", lw=0)
    blue = picture(ax)[..., 2] > 127
    rows, columns = np.flatnonzero(blue.any(axis=1)), np.flatnonzero(blue.any(axis=0))
    for found, expected in zip([rows[0], rows[-1] + 1, columns[0], columns[-1] + 1], [100, 180, 50, 250], strict=True):
        assert abs(found - expected) <= 1


def test_a_box_has_the_colour_and_the_style_asked_for(ax):
    plots.draw_box(ax, [1, 2, 3, 4])
    plots.draw_box(ax, (5, 6, 7, 8), color=plots.TRUTH, label="truth", lw=5, linestyle="--")
    first, second = ax.patches
    assert (first.get_xy(), first.get_width(), first.get_height()) == ((1, 2), 3, 4)
    assert to_hex(first.get_edgecolor()) == plots.ESTIMATE.lower()
    assert not first.get_fill()
    assert to_hex(second.get_edgecolor()) == plots.TRUTH.lower()
    assert second.get_linewidth() == 5
    assert second.get_linestyle() == "--"
    assert [text.get_text() for text in ax.legend().get_texts()] == ["truth"]


@pytest.mark.parametrize("box", [[np.nan] * 4, [1, 2, 3, np.nan], [np.nan, 2, 3, 4]])
def test_a_nan_box_draws_nothing(ax, box):
    before = picture(ax)
    plots.draw_box(ax, box, label="missing")
    np.testing.assert_array_equal(picture(ax), before)
    assert not ax.patches
    plots.draw_box(ax, [0.2, 0.2, 0.5, 0.5])
    assert not np.array_equal(picture(ax), before)  # a box that is there does show


def test_particles_are_dots_at_their_centres_with_areas_as_their_weights(ax):
    particles = np.random.default_rng(2).uniform(0, 100, size=(4, 5))
    weights = np.array([0.1, 0.2, 0.3, 0.4])
    plots.draw_particles(ax, particles, weights, label="particles")
    (dots,) = ax.collections
    np.testing.assert_array_equal(dots.get_offsets(), particles[:, :2])
    ratio = dots.get_sizes() / weights
    np.testing.assert_allclose(ratio, ratio[0])
    assert to_hex(dots.get_facecolor()[0]) == plots.PARTICLES.lower()
    assert [text.get_text() for text in ax.legend().get_texts()] == ["particles"]


def test_particles_without_weights_are_dots_of_one_size(ax):
    plots.draw_particles(ax, [[1, 2], [3, 4], [5, 6]], color=plots.TRUTH)
    plots.draw_particles(ax, [[1, 2], [3, 4], [5, 6]], np.full(3, 1 / 3))
    plain, weighted = ax.collections
    sizes = np.broadcast_to(plain.get_sizes(), 3)
    assert np.ptp(sizes) == 0
    np.testing.assert_allclose(np.broadcast_to(weighted.get_sizes(), 3), sizes)
    assert to_hex(plain.get_facecolor()[0]) == plots.TRUTH.lower()


def test_no_particle_is_too_small_to_see_nor_hides_the_picture(ax):
    weights = np.zeros(1000)
    weights[0] = 1
    plots.draw_particles(ax, np.zeros((1000, 2)), weights)
    sizes = ax.collections[0].get_sizes()
    assert sizes.min() > 0
    assert sizes[0] == sizes.max() < 100  # in points², a tenth of an inch and a bit across
