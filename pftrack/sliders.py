"""Sliders that work without Python and without a network: a picture for every position, made beforehand.

A function that draws a picture for given values becomes a stack of pictures under one, two or three sliders:

    explore(draw, n_particles=[10, 25, 50])

The stack is part of the page, so that the built book and a notebook that nobody runs can be played with. Somebody who
has a kernel gets any number in between from ``.live()``, which calls the same function. Every chapter has at least one.
"""

from __future__ import annotations

import base64
import functools
import html
import inspect
import itertools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pftrack.checks import check_picture

MOST_PICTURES = 60
"""Most pictures of one stack; a page has to carry them all."""

MOST_SLIDERS = 3
"""Most sliders over one stack."""

QUALITY = 80
"""Quality of pictures that are smaller with losses than without, from 1 to 100."""

SHOW = (
    "const figure=this.closest('figure'),inputs=[...figure.querySelectorAll('input')],"
    "stack=figure.stack||(figure.stack=JSON.parse(figure.querySelector('script').textContent));"
    "let at=0;inputs.forEach((input,k)=>{at=at*stack.texts[k].length+Number(input.value);"
    "const text=stack.texts[k][input.value];"
    "input.previousElementSibling.value=text;input.setAttribute('aria-valuetext',text)});"
    "const picture=figure.querySelector('img');picture.src=stack.pictures[at];picture.alt=stack.alts[at]"
)
"""What a slider does when it is moved; it reads the stack from the figure it is in, and needs no other script."""


@dataclass(frozen=True)
class Slider:
    """One quantity that a reader can move: its values, what it is called, and where it starts.

    Parameters
    ----------
    values : sequence
        At least two different numbers, strings or truth values, in the order of the slider.
    label : str
        What the quantity is called.
    unit : str
        Written after each value.
    start : object, optional
        The value that is shown first; the first one if not given.

    Raises
    ------
    ValueError
        If there are fewer than two values, if one comes twice, or if ``start`` is not among them.

    Examples
    --------
    >>> Slider([0.5, 1, 2], "standard deviation", "px", start=1).texts
    ['0.5 px', '1 px', '2 px']
    """

    values: Sequence
    label: str
    unit: str = ""
    start: object = None

    def __post_init__(self):
        try:
            values = [each.item() if isinstance(each, np.generic) else each for each in self.values]
            different = len(set(values))
        except TypeError:
            values, different = self.values, 0
        if different < 2 or different < len(values):
            raise ValueError(f"the slider {self.label!r} needs at least two different values, got {values}")
        if self.start is not None and self.start not in values:
            raise ValueError(f"the slider {self.label!r} cannot start at {self.start!r}; its values are {values}")
        object.__setattr__(self, "values", values)

    @property
    def texts(self) -> list[str]:
        """Return each value as it is shown, with its unit."""
        return [self.text(value) for value in self.values]

    @property
    def first(self) -> int:
        """Return the index of the value that is shown first."""
        return 0 if self.start is None else self.values.index(self.start)

    def text(self, value) -> str:
        """Return a value as it is shown, fractions to six significant digits, with the unit."""
        return f"{f'{value:g}' if isinstance(value, float) else value} {self.unit}".strip()

    def control(self):
        """Return the slider of ipywidgets for any value between the smallest and the largest."""
        import ipywidgets

        kinds = {type(value) for value in self.values}
        about = {
            "description": f"{self.label}{f' ({self.unit})' if self.unit else ''}",
            "style": {"description_width": "initial"},
            "layout": {"width": "95%"},
            "continuous_update": False,
        }
        value = self.values[self.first]
        if not kinds <= {int, float}:
            options = list(zip(self.texts, self.values, strict=True))
            return ipywidgets.SelectionSlider(options=options, value=value, **about)
        low, high = min(self.values), max(self.values)
        if kinds == {int}:
            return ipywidgets.IntSlider(value, low, high, **about)
        step = (high - low) / 100
        return ipywidgets.FloatSlider(value, min=low, max=high, step=step, readout_format=".4g", **about)


class Explorer:
    """A stack of pictures under sliders, as :func:`explore` returns it.

    Attributes
    ----------
    sliders : dict of str to Slider
        The sliders, by the names of the function's arguments.
    pictures : list of bytes
        The pictures as WebP files; the last slider moves fastest.
    alts : list of str
        What each picture shows, in words: what the function's docstring begins with, the values, and the titles.
    """

    def __init__(self, fn: Callable, sliders: dict[str, Slider]):
        self.fn, self.sliders = fn, sliders
        self.caption = _caption(fn)
        settings = itertools.product(*(slider.values for slider in sliders.values()))
        drawn = [self._draw(dict(zip(sliders, values, strict=True))) for values in settings]
        self.pictures, self.alts, sizes = (list(each) for each in zip(*drawn, strict=True))
        self.width, self.height = sizes[self._first]

    @property
    def _first(self) -> int:
        """The index of the picture that is shown first."""
        shape = [len(slider.values) for slider in self.sliders.values()]
        return int(np.ravel_multi_index([slider.first for slider in self.sliders.values()], shape))

    def _draw(self, values: dict) -> tuple[bytes, str, tuple[int, int]]:
        """Return the picture for given values as a file, what it shows in words, and its width and height."""
        picture, words = _pixels(self.fn(**values))
        at = ", ".join(f"{slider.label} {slider.text(values[name])}" for name, slider in self.sliders.items())
        at = at[0].upper() + at[1:] if at[0].isascii() else at  # Σ is not σ
        alt = f"{self.caption} {at}{f': {words}' if words else ''}"
        return _webp(picture), alt if alt.endswith((".", "?", "!")) else f"{alt}.", picture.shape[1::-1]

    def __repr__(self) -> str:
        values = "; ".join(f"{slider.label}: {', '.join(slider.texts)}" for slider in self.sliders.values())
        return f"{len(self.pictures)} pictures. {self.caption} {values}"

    def _repr_html_(self) -> str:
        stack = {
            "texts": [slider.texts for slider in self.sliders.values()],
            "pictures": [_address(picture) for picture in self.pictures],
            "alts": self.alts,
        }
        first, alt = stack["pictures"][self._first], html.escape(self.alts[self._first], quote=True)
        controls = "".join(_control(slider) for slider in self.sliders.values())
        data = json.dumps(stack, ensure_ascii=False).replace("<", "\\u003c")
        return (
            f'<figure class="pftrack-explore" style="margin:1em 0;max-width:{self.width}px">'
            f'<img src="{first}" alt="{alt}" width="{self.width}" height="{self.height}" '
            f'style="width:100%;height:auto">{controls}'
            f'<script type="application/json">{data}</script><figcaption>{html.escape(self.caption)}'
            "<noscript> The slider needs JavaScript; this is the picture it begins with.</noscript></figcaption>"
            "</figure>"
        )

    def live(self):
        """Return sliders of ipywidgets that call the function for any number in between; they need a kernel.

        Returns
        -------
        ipywidgets.interactive
            The sliders, above the picture.

        Raises
        ------
        ImportError
            If ipywidgets is not installed; ``pip install "pftrack[notebook]"`` does it.
        """
        import ipywidgets
        from IPython.display import HTML, display

        def show(**values):
            picture, alt, (width, _) = self._draw(values)
            alt = html.escape(alt, quote=True)
            display(HTML(f'<img src="{_address(picture)}" alt="{alt}" style="width:100%;max-width:{width}px">'))

        return ipywidgets.interactive(show, **{name: slider.control() for name, slider in self.sliders.items()})


def explore(fn: Callable, **values: Slider | Sequence) -> Explorer:
    """Draw a picture for every combination of values, and let the reader move through them with sliders.

    Parameters
    ----------
    fn : callable
        Takes one keyword argument for each slider, and returns a Matplotlib figure, or a picture of shape (H, W, 3),
        uint8, in BGR order; the picture may come in a tuple with a sentence that says what it shows. Of a figure the
        titles say it. The first paragraph of the function's docstring is the caption. Whatever in it is random takes a
        seed, so that the same value shows the same picture.
    **values : Slider or sequence
        For each argument its values; a plain sequence is labelled with the argument's name.

    Returns
    -------
    Explorer
        To be displayed as the result of a cell.

    Raises
    ------
    ValueError
        If there are no values, more than three sliders or more than 60 pictures; if the function has no docstring,
        does not take these arguments, or returns no picture.

    Examples
    --------
    >>> def shade(level):
    ...     \"\"\"A square of one grey.\"\"\"
    ...     return np.full((16, 16, 3), level, dtype=np.uint8), "it is dark" if level < 128 else "it is bright"
    >>> squares = explore(shade, level=[0, 100, 200])
    >>> squares
    3 pictures. A square of one grey. level: 0, 100, 200
    >>> squares.alts[2]
    'A square of one grey. Level 200: it is bright.'
    """
    sliders = {
        name: each if isinstance(each, Slider) else Slider(each, name.replace("_", " "))
        for name, each in values.items()
    }
    if not 1 <= len(sliders) <= MOST_SLIDERS:
        raise ValueError(f"explore needs one to {MOST_SLIDERS} quantities with their values, got {len(sliders)}")
    n_pictures = math.prod(len(slider.values) for slider in sliders.values())
    if n_pictures > MOST_PICTURES:
        raise ValueError(
            f"these values make {n_pictures} pictures, more than the {MOST_PICTURES} that a page should carry; "
            "leave some out, .live() reaches those in between"
        )
    try:
        inspect.signature(fn).bind(**{name: slider.values[0] for name, slider in sliders.items()})
    except TypeError as error:
        raise ValueError(f"the function must take the arguments {', '.join(sliders)}: {error}") from None
    return Explorer(fn, sliders)


def _caption(fn: Callable) -> str:
    """Return the first paragraph of a function's docstring."""
    while isinstance(fn, functools.partial):
        fn = fn.func
    words = " ".join((inspect.getdoc(fn) or "").split("\n\n")[0].split())
    if not words:
        raise ValueError("the function needs a docstring; its first paragraph is the caption of the pictures")
    return words


def _pixels(result) -> tuple[np.ndarray, str]:
    """Return what a function drew as a BGR picture, and what it shows in words."""
    picture, words = result if isinstance(result, tuple) and len(result) == 2 else (result, "")
    if not isinstance(words, str) or not (isinstance(picture, np.ndarray) or hasattr(picture, "savefig")):
        raise ValueError(
            "the function must return a Matplotlib figure, or a picture, alone or with a sentence that says what it "
            f"shows; got {type(result).__name__}"
        )
    if isinstance(picture, np.ndarray):
        return check_picture(picture), words
    import matplotlib.pyplot as plt
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(picture)
    canvas.draw()
    pixels = cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)
    places = ("left", "center", "right")
    titles = [picture.get_suptitle(), *(ax.get_title(place) for ax in picture.axes for place in places)]
    plt.close(picture)
    return pixels, words or "; ".join(" ".join(title.split()) for title in titles if title)


def _webp(picture: np.ndarray) -> bytes:
    """Encode a picture without losses, or with them where that is smaller, as it is for photographs."""
    files = [cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, q])[1].tobytes() for q in (101, QUALITY)]
    return min(files, key=len)


def _address(picture: bytes) -> str:
    """Return a picture as an address that holds it."""
    return f"data:image/webp;base64,{base64.b64encode(picture).decode()}"


def _control(slider: Slider) -> str:
    """Return a slider as HTML: what it is called, the handle and the value."""
    label, text = (html.escape(each, quote=True) for each in (slider.label, slider.texts[slider.first]))
    return (
        '<div style="display:grid;grid-template-columns:1fr auto;gap:0 1em;margin:.3em 0">'
        f'<span>{label}</span><output style="font-variant-numeric:tabular-nums">{text}</output>'
        f'<input type="range" min="0" max="{len(slider.values) - 1}" step="1" value="{slider.first}" '
        f'aria-label="{label}" aria-valuetext="{text}" autocomplete="off" '
        'data-lm-suppress-shortcuts="true" '  # else JupyterLab takes the arrow keys
        f'style="grid-column:1/-1;width:100%;height:2.5em;margin:0" oninput="{SHOW}"></div>'
    )
