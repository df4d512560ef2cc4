"""Sliders over pictures: which picture belongs to which position, what a browser is given, and what needs a kernel."""

import base64
import html.parser
import itertools
import json
import re
import shutil
import subprocess
import sys
from functools import partial

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

from pftrack.sliders import MOST_PICTURES, Slider, explore

NAMES = ["blue", "green", "red"]


def tint(blue=0, green=0, red=0):
    """A square whose colour is the values."""
    return np.full((16, 24, 3), (blue, green, red), dtype=np.uint8)


def colours(n_sliders):
    """Return values for one, two or three sliders, of a different length each, in no order."""
    return dict(zip(NAMES[:n_sliders], ([40, 10], [7, 200, 90], [5, 250, 60, 130]), strict=False))


def described(words="", docstring="A square.", picture=None):
    """Return a function of ``a`` with this docstring that shows a square, and says these words."""

    def draw(a):
        return (tint(20) if picture is None else picture), words

    draw.__doc__ = docstring
    return draw


def decode(picture):
    return cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)


def at_address(address):
    kind, data = address.split(";base64,")
    assert kind == "data:image/webp"
    return base64.b64decode(data, validate=True)


class Elements(html.parser.HTMLParser):
    """Every element of a piece of HTML: its tag, its attributes, the index of its parent and its own text."""

    def __init__(self, explorer):
        super().__init__()
        self.found, self.open = [], []
        self.feed(explorer if isinstance(explorer, str) else explorer._repr_html_())
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        assert len({name for name, _ in attrs}) == len(attrs)
        parent = self.open[-1] if self.open else None
        self.found.append({"tag": tag, "attributes": dict(attrs), "parent": parent, "text": ""})
        if tag not in ("img", "input"):
            self.open.append(len(self.found) - 1)

    def handle_endtag(self, tag):
        assert self.found[self.open.pop()]["tag"] == tag

    def handle_data(self, data):
        self.found[self.open[-1]]["text"] += data

    def all(self, tag):
        return [element for element in self.found if element["tag"] == tag]

    def one(self, tag):
        (element,) = self.all(tag)
        return element

    @property
    def stack(self):
        return json.loads(self.one("script")["text"])


# ---------------------------------------------------------------------------------------------------------------------
# Pictures
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_sliders", [1, 2, 3])
def test_the_stack_is_in_the_order_of_numpy(n_sliders):
    values = colours(n_sliders)
    squares = explore(tint, **values)
    shape = [len(each) for each in values.values()]
    assert len(squares.pictures) == len(squares.alts) == np.prod(shape)
    for i, (picture, alt) in enumerate(zip(squares.pictures, squares.alts, strict=True)):
        index = np.unravel_index(i, shape)
        colour = [each[k] for each, k in zip(values.values(), index, strict=True)]
        np.testing.assert_array_equal(decode(picture)[3, 5], colour + [0] * (3 - n_sliders))
        assert re.findall(r"\d+", alt) == [str(level) for level in colour]


def test_a_flat_picture_is_kept_exactly_and_a_photograph_nearly_in_a_smaller_file():
    noise = np.random.default_rng(2).integers(0, 256, size=(96, 128), dtype=np.uint8)
    clouds = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4), None, 0, 255, cv2.NORM_MINMAX)
    photograph = cv2.applyColorMap(clouds, cv2.COLORMAP_BONE)
    for picture, kind in (tint(13, 77, 201), b"VP8L"), (photograph, b"VP8 "):
        file = explore(described(picture=picture), a=[1, 2]).pictures[0]
        exact = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
        assert file[12:16] == kind  # the chunk of the WebP container: without or with losses
        assert len(file) < len(exact) / 2 if kind == b"VP8 " else file == exact
        assert np.abs(decode(file).astype(int) - picture).mean() <= (3 if kind == b"VP8 " else 0)


def noisy(size, seed=4):
    """Noise of a given size."""
    return np.random.default_rng(seed).integers(0, 256, size=(size, size, 3), dtype=np.uint8)


def plotted(height):
    """A line in a figure."""
    figure, ax = plt.subplots(figsize=(2, 1), dpi=50, facecolor="#e69f00")
    ax.plot([0, height])
    return figure


@pytest.mark.parametrize("fn", [noisy, plotted])
def test_the_same_seed_gives_the_same_bytes(fn):
    name = next(iter(fn.__code__.co_varnames))
    first, second = (explore(fn, **{name: [8, 24]}) for _ in range(2))
    assert first.pictures == second.pictures
    assert first._repr_html_() == second._repr_html_()
    assert first.pictures[0] != first.pictures[1]


def test_a_figure_keeps_its_colours_and_size_and_is_closed_but_no_other():
    other = plt.figure()
    before = plt.get_fignums()
    lines = explore(plotted, height=[1, 2, 3])
    assert plt.get_fignums() == before
    plt.close(other)
    pixels = decode(lines.pictures[0])
    assert pixels.shape == (50, 100, 3)
    np.testing.assert_allclose(pixels[1, 1], [0, 159, 230], atol=3)  # orange, in BGR order
    image = Elements(lines).one("img")["attributes"]
    assert (image["width"], image["height"]) == ("100", "50")


def test_the_size_on_the_page_is_that_of_the_picture_shown_first():
    image = Elements(explore(noisy, size=Slider([8, 24], "size", start=24))).one("img")["attributes"]
    assert (image["width"], image["height"]) == ("24", "24")


# ---------------------------------------------------------------------------------------------------------------------
# Words
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "expected"), [(None, "All; Left\n1; Right 1"), ("Mine", "Mine"), ("Is it?", "Is it?")]
)
def test_the_titles_of_a_figure_are_its_alternative_text_unless_it_is_given(words, expected):
    def draw(a):
        """Two panels."""
        figure, axes = plt.subplots(1, 2, figsize=(2, 1), dpi=50)
        figure.suptitle("All")
        axes[0].set_title(f"Left\n{a}", loc="left")
        axes[1].set_title(f"Right {a}")
        return figure if words is None else (figure, words)

    alts = explore(draw, a=[1, 2]).alts
    stop = "" if expected.endswith("?") else "."
    for value, alt in zip("12", alts, strict=True):
        assert alt == f"Two panels. A {value}: {' '.join(expected.split()).replace('1', value)}{stop}"


@pytest.mark.parametrize(
    ("docstring", "caption"),
    [
        ("One line.", "One line."),
        ("One sentence\n    over two lines.\n\n    Not this one.\n", "One sentence over two lines."),
        ("\n    It begins below.\n\n    Parameters\n    ----------\n    a : int\n    ", "It begins below."),
    ],
)
def test_the_caption_is_what_the_docstring_begins_with(docstring, caption):
    squares = explore(described(docstring=docstring), a=[1, 2])
    assert squares.caption == caption
    assert Elements(squares).one("figcaption")["text"] == caption
    assert squares.alts == [f"{caption} A 1.", f"{caption} A 2."]


@pytest.mark.parametrize(
    ("values", "unit", "texts"),
    [
        ([10, 25], "", ["10", "25"]),
        ([0.5, 1 / 3], "px", ["0.5 px", "0.333333 px"]),
        ([1.0, 2.5], "%", ["1 %", "2.5 %"]),
        (["mean", "best"], "", ["mean", "best"]),
        ([True, False], "", ["True", "False"]),
        (range(2), "", ["0", "1"]),
        (np.array([0.1, 0.25]), "s", ["0.1 s", "0.25 s"]),
        ([-1e-5, 0], "", ["-1e-05", "0"]),
    ],
)
def test_values_are_shown_with_their_unit(values, unit, texts):
    assert Slider(values, "x", unit).texts == texts
    page = Elements(explore(described(), a=Slider(values, "x", unit)))
    assert page.stack["texts"] == [texts]
    assert page.one("output")["text"] == page.one("input")["attributes"]["aria-valuetext"] == texts[0]


def test_the_text_is_the_same_in_every_run_and_holds_no_address():
    texts = {repr(explore(tint, blue=Slider([1, 2], "how blue", "%"), red=[3, 4])) for _ in range(2)}
    assert texts == {"4 pictures. A square whose colour is the values. how blue: 1 %, 2 %; red: 3, 4"}


# ---------------------------------------------------------------------------------------------------------------------
# Pages
# ---------------------------------------------------------------------------------------------------------------------

HOSTILE = ["plain", '</script><script>alert("x")</script>', "<!-- <b title='1'> & \"2\" &lt;", "Łódź, zażółć, σ² → 0"]


@pytest.mark.parametrize("n_sliders", [1, 2, 3])
def test_a_page_has_one_picture_and_for_each_slider_a_handle_and_its_value(n_sliders):
    values = colours(n_sliders)
    page = Elements(explore(tint, **values))
    assert len(page.all("img")) == len(page.all("script")) == len(page.all("noscript")) == 1
    assert "JavaScript" in page.one("noscript")["text"]
    handles = [element["attributes"] for element in page.all("input")]
    assert [(each["type"], each["min"], each["max"], each["step"], each["value"]) for each in handles] == [
        ("range", "0", str(len(each) - 1), "1", "0") for each in values.values()
    ]
    outputs = [element["text"] for element in page.all("output")]
    assert outputs == [each["aria-valuetext"] for each in handles] == [str(each[0]) for each in values.values()]
    assert [element["text"] for element in page.all("span")] == NAMES[:n_sliders]


def test_a_page_shows_the_start_values_first():
    blue, green, red = colours(3).values()
    squares = explore(tint, blue=Slider(blue, "b", "%", start=10), green=green, red=Slider(red, "r", start=130))
    page = Elements(squares)
    image = page.one("img")["attributes"]
    np.testing.assert_array_equal(decode(at_address(image["src"]))[0, 0], [10, 7, 130])
    assert image["alt"] == "A square whose colour is the values. B 10 %, green 7, r 130."
    assert [element["attributes"]["value"] for element in page.all("input")] == ["1", "0", "3"]
    assert [element["attributes"]["aria-valuetext"] for element in page.all("input")] == ["10 %", "7", "130"]
    assert [element["text"] for element in page.all("output")] == ["10 %", "7", "130"]


def test_a_page_carries_the_whole_stack():
    squares = explore(tint, **colours(3))
    stack = Elements(squares).stack
    assert [at_address(address) for address in stack["pictures"]] == squares.pictures
    assert stack["alts"] == squares.alts
    assert stack["texts"] == [[str(value) for value in each] for each in colours(3).values()]


@pytest.mark.parametrize("text", HOSTILE)
@pytest.mark.parametrize("place", ["docstring", "words", "label", "unit", "value"])
def test_no_text_gets_out_of_its_place_on_a_page(place, text):
    given = {"docstring": "Caption.", "words": "words", "label": "label", "unit": "unit", "value": "value", place: text}
    slider = Slider([given["value"], "other"], given["label"], given["unit"])
    squares = explore(described(given["words"], given["docstring"]), a=slider)
    page, shown = Elements(squares), f"{given['value']} {given['unit']}"
    ordinary = Elements(explore(described(), a=[1, 2]))
    assert [element["tag"] for element in page.found] == [element["tag"] for element in ordinary.found]
    assert {name for element in page.found for name in element["attributes"] if name.startswith("on")} == {"oninput"}
    assert page.one("figcaption")["text"] == squares.caption == given["docstring"]
    assert page.one("span")["text"] == given["label"]
    assert page.one("output")["text"] == page.one("input")["attributes"]["aria-valuetext"] == shown
    assert page.stack["texts"] == [[shown, f"other {given['unit']}"]]
    assert page.one("img")["attributes"]["alt"] == page.stack["alts"][0] == squares.alts[0]
    label = given["label"][0].upper() + given["label"][1:]
    assert squares.alts[0].rstrip(".") == f"{given['docstring']} {label} {shown}: {given['words']}"
    assert not re.search("</script.*</script|<!--", squares._repr_html_(), re.DOTALL)


def test_a_page_fetches_nothing():
    squares = explore(tint, **colours(2))
    assert not re.search(r"//|url\(|@import|fetch|XMLHttp", re.sub(r"base64,[\w+/=]+", "", squares._repr_html_()))
    for element in Elements(squares).found:
        for name in {"src", "href", "srcset", "action", "data", "poster"} & set(element["attributes"]):
            assert element["attributes"][name].startswith("data:image/webp;base64,")


# A document of the parsed elements that knows no more than the handlers need, and what they do to it.
DOCUMENT = """
const [found, moves] = JSON.parse(require('fs').readFileSync(0, 'utf8'));
class Element {
  constructor({tag, attributes, text}) {
    Object.assign(this, {tag, attributes, textContent: text, children: [], parent: null, ...attributes});
  }
  setAttribute(name, value) { this.attributes[name] = String(value); }
  closest(tag) { return this.tag === tag ? this : this.parent && this.parent.closest(tag); }
  querySelectorAll(tag) {
    return this.children.flatMap(child => [...(child.tag === tag ? [child] : []), ...child.querySelectorAll(tag)]);
  }
  querySelector(tag) { return this.querySelectorAll(tag)[0] || null; }
  beside(step) { return this.parent.children[this.parent.children.indexOf(this) + step] || null; }
  get previousElementSibling() { return this.beside(-1); }
  get nextElementSibling() { return this.beside(1); }
}
const elements = found.map(each => new Element(each));
found.forEach(({parent}, i) => {
  if (parent !== null) { elements[i].parent = elements[parent]; elements[parent].children.push(elements[i]); }
});
const figures = elements.filter(each => each.tag === 'figure');
console.log(JSON.stringify(moves.map(([which, k, position]) => {
  const input = figures[which].querySelectorAll('input')[k];
  input.value = String(position);
  new Function(input.attributes.oninput).call(input);
  return figures.map(figure => ({
    src: figure.querySelector('img').src, alt: figure.querySelector('img').alt,
    outputs: figure.querySelectorAll('output').map(each => each.value),
    spoken: figure.querySelectorAll('input').map(each => each.attributes['aria-valuetext']),
  }));
})));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node, which runs the handlers of the sliders")
def test_moving_the_handles_shows_the_picture_of_their_values_and_leaves_other_figures_alone():
    levels = [[10, 20], [30, 40, 50], [60, 70, 80, 90]]
    squares = explore(tint, **dict(zip(NAMES, levels, strict=True)))
    other = explore(noisy, size=[8, 24])
    targets = list(itertools.product(range(2), range(3), range(4)))
    np.random.default_rng(5).shuffle(targets)
    moves = [(0, k, int(position)) for target in targets for k, position in enumerate(target)]
    found = Elements(squares._repr_html_() + other._repr_html_()).found
    done = subprocess.run(
        ["node", "-e", DOCUMENT], input=json.dumps([found, [*moves, (1, 0, 1)]]), capture_output=True, text=True
    )
    assert not done.stderr
    states, positions, seen = json.loads(done.stdout), [0, 0, 0], set()
    for (_, k, position), (shown, untouched) in zip(moves, states[:-1], strict=True):
        positions[k] = position
        colour = [each[i] for each, i in zip(levels, positions, strict=True)]
        np.testing.assert_array_equal(decode(at_address(shown["src"]))[0, 0], colour)
        assert re.findall(r"\d+", shown["alt"]) == shown["outputs"] == shown["spoken"] == [str(each) for each in colour]
        assert at_address(untouched["src"]) == other.pictures[0]
        seen.add(tuple(positions))
    assert len(seen) == 24
    assert states[-1][0] == states[-2][0]
    assert at_address(states[-1][1]["src"]) == other.pictures[1]
    assert states[-1][1]["outputs"] == ["24"]


# ---------------------------------------------------------------------------------------------------------------------
# Mistakes
# ---------------------------------------------------------------------------------------------------------------------


def test_as_many_pictures_as_a_page_should_carry_are_drawn():
    assert len(explore(tint, blue=range(MOST_PICTURES)).pictures) == MOST_PICTURES == 60


def four(a, b, c, d):
    """A square."""
    return tint(a)


@pytest.mark.parametrize(
    ("fn", "values", "message"),
    [
        (tint, {}, "needs one to 3 quantities with their values, got 0"),
        (four, {name: [1, 2] for name in "abcd"}, "needs one to 3 quantities with their values, got 4"),
        (tint, {"blue": range(61)}, "make 61 pictures, more than the 60 .* leave some out"),
        (tint, {"blue": range(8), "red": range(8)}, "make 64 pictures"),
        (tint, {"blue": [1]}, r"'blue' needs at least two different values, got \[1\]"),
        (tint, {"blue": [1, 2, 1]}, r"'blue' needs at least two different values, got \[1, 2, 1\]"),
        (tint, {"blue": [1, 2], "grey_level": [1, 2]}, "must take the arguments blue, grey_level: .*'grey_level'"),
        (noisy, {"seed": [1, 2]}, "must take the arguments seed: missing a required argument: 'size'"),
        (described(docstring=None), {"a": [1, 2]}, "needs a docstring; .* caption"),
        (described(docstring=""), {"a": [1, 2]}, "needs a docstring; .* caption"),
        (described(picture="picture.png"), {"a": [1, 2]}, "must return a Matplotlib figure, .* got tuple"),
        (described(picture=np.zeros((4, 4), np.uint8)), {"a": [1, 2]}, r"got shape \(4, 4\); convert .*cvtColor"),
        (described(picture=np.zeros((4, 4, 3))), {"a": [1, 2]}, "dtype uint8 with values 0 to 255, got float64"),
    ],
)
def test_a_mistake_is_explained(fn, values, message):
    with pytest.raises(ValueError, match=message):
        explore(fn, **values)


def test_a_slider_cannot_start_at_a_value_that_it_does_not_have():
    with pytest.raises(ValueError, match=r"'noise' cannot start at 3; its values are \[1, 2\]"):
        Slider([1, 2], "noise", start=3)


def test_nothing_is_drawn_before_the_mistakes_are_found():
    drawn = []

    def draw(a):
        """A square."""
        drawn.append(a)
        return tint(a)

    with pytest.raises(ValueError):
        explore(draw, a=range(61))
    with pytest.raises(ValueError):
        explore(draw, b=[1, 2])
    assert not drawn


# ---------------------------------------------------------------------------------------------------------------------
# With a kernel
# ---------------------------------------------------------------------------------------------------------------------


def called(a, b, c):
    """A square of the levels."""
    return tint(a, int(b), {"low": 50, "high": 200}[c])


@pytest.fixture
def live(monkeypatch):
    """The sliders over ``called``, and what they display."""
    displayed = []
    monkeypatch.setattr("IPython.display.display", displayed.append)
    squares = explore(
        called,
        a=Slider([10, 50, 30], "first", "px", start=30),
        b=Slider([2.5, 50.0, 100], "b", start=50.0),
        c=["low", "high"],
    )
    return squares.live(), displayed


def test_live_sliders_are_of_the_kind_of_their_values_and_reach_from_the_least_to_the_most(live):
    a, b, c = live[0].children[:3]
    assert [type(each).__name__ for each in (a, b, c)] == ["IntSlider", "FloatSlider", "SelectionSlider"]
    assert (a.min, a.max, a.value, a.description) == (10, 50, 30, "first (px)")
    assert (b.min, b.max, b.value, b.description) == (2.5, 100, 50, "b")
    assert not any(each.continuous_update for each in (a, b, c))  # a picture may take a while
    assert 0 < b.step <= (b.max - b.min) / 20
    assert (c.options, c.value) == ((("low", "low"), ("high", "high")), "low")


def test_moving_a_live_slider_draws_values_between_with_the_same_function(live):
    (a, b, c), displayed = live[0].children[:3], live[1]
    a.value, b.value, c.value = 11, 77.25, "high"
    expected = [(30, 50, 50), (11, 50, 50), (11, 77, 50), (11, 77, 200)]  # at the start, and once for each move
    for shown, colour in zip(displayed, expected, strict=True):
        image = Elements(shown.data).one("img")["attributes"]
        np.testing.assert_array_equal(decode(at_address(image["src"]))[0, 0], colour)
    assert image["alt"] == "A square of the levels. First 11 px, b 77.25, c high."


def test_without_ipywidgets_there_are_pages_but_no_live_sliders(monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    squares = explore(tint, blue=[1, 2])
    assert len(Elements(squares).stack["pictures"]) == 2
    with pytest.raises(ImportError, match="ipywidgets"):
        squares.live()


# ---------------------------------------------------------------------------------------------------------------------
# Values, figures and functions of other kinds
# ---------------------------------------------------------------------------------------------------------------------


def test_every_handle_has_a_name_for_a_screen_reader():
    page = Elements(explore(tint, **colours(2)))
    assert [element["attributes"].get("aria-label") for element in page.all("input")] == ["blue", "green"]


@pytest.mark.parametrize(("values", "kind"), [(np.arange(3), "IntSlider"), (np.linspace(0, 1, 5), "FloatSlider")])
def test_live_sliders_reach_between_the_numbers_of_an_array(values, kind):
    assert type(Slider(values, "x").control()).__name__ == kind


def test_live_sliders_show_small_numbers():
    control = Slider([0.001, 0.004], "x").control()
    assert float(format(control.value, control.readout_format)) == 0.001


def test_live_sliders_may_mix_words_and_numbers():
    assert Slider(["none", 1, 5], "x").control().value == "none"


def test_a_figure_need_not_come_from_pyplot():
    assert decode(explore(described(picture=Figure((2, 1), 50)), a=[1, 2]).pictures[0]).shape == (50, 100, 3)


@pytest.mark.parametrize("rest", [[Figure().subplots()], ["words", "more words"]], ids=["axes", "three"])
def test_what_is_not_a_picture_with_a_sentence_is_explained(rest):
    def draw(a):
        """A square."""
        return tint(), *rest

    with pytest.raises(ValueError, match="sentence"):
        explore(draw, a=[1, 2])


def test_a_value_that_is_no_sequence_is_explained():
    with pytest.raises(ValueError, match="needs at least two different values, got 10"):
        explore(tint, blue=10)


def test_a_greek_letter_keeps_its_case():
    assert explore(described(), a=Slider([1, 2], "σ")).alts[0] == "A square. σ 1."


def test_a_partial_function_is_not_described_by_the_words_of_partial():
    try:
        caption = explore(partial(tint, red=3), blue=[1, 2]).caption
    except ValueError:  # an explanation would do
        caption = "A square whose colour is the values."
    assert caption == "A square whose colour is the values."


def test_a_docstring_of_blanks_is_none():
    with pytest.raises(ValueError, match="needs a docstring"):
        explore(described(docstring=" \n "), a=[1, 2])
