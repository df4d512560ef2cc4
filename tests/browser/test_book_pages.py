"""The built book in a browser: nothing from elsewhere, nothing broken, sliders that move and clips that play."""

import itertools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = re.findall(r"(?:file|root): (\S+)", (ROOT / "_toc.yml").read_text(encoding="utf-8"))
PHONE, DESKTOP = {"width": 390, "height": 844}, {"width": 1280, "height": 900}
MOST_BYTES_OF_A_CLIP = 300_000


@pytest.fixture
def visit(chromium, site):
    """Return a function that opens a page of the book, and fails the test for any trouble that the browser reports."""
    contexts, troubles = [], []

    def listen(page, scripts):
        page.on("console", lambda said: troubles.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", lambda request: troubles.append(request.url) if leaves(request.url) else None)
        if scripts:  # else those that the browser does not fetch count as failed
            page.on("requestfailed", lambda request: troubles.append(f"{request.url[:100]} failed"))

    def leaves(url):
        return not url.startswith((site, "data:", "blob:", "about:"))

    def open_page(name, viewport=DESKTOP, **settings):
        context = chromium.new_context(viewport=viewport, **settings)
        contexts.append(context)
        page = context.new_page()
        listen(page, settings.get("java_script_enabled", True))
        page.goto(f"{site}/{name}.html", wait_until="load")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert troubles == []


@pytest.mark.parametrize("name", PAGES)
def test_a_page_shows_every_picture_and_equation_and_fetches_nothing_from_elsewhere(visit, name):
    page = visit(name)
    page.wait_for_function("() => !window.MathJax?.startup || window.MathJax.startup.promise.then(() => true)")
    assert page.locator("mjx-merror").count() == 0
    pictures = page.locator("img")
    pictures.evaluate_all("all => all.forEach(picture => picture.loading = 'eager')")
    page.wait_for_function("() => [...document.images].every(picture => picture.complete)")
    assert pictures.evaluate_all("all => all.filter(p => !p.naturalWidth).map(p => p.src.slice(0, 100))") == []
    assert page.locator("article h1").count() == 1


@pytest.mark.parametrize("name", [page for page in PAGES if page.startswith("notebooks/")])
def test_every_slider_of_a_chapter_moves_by_mouse_and_by_keyboard(visit, name):
    page = visit(name)
    figures = page.locator("figure.pftrack-explore").all()
    assert figures, "a chapter needs a slider"
    for figure in figures:
        picture = figure.locator("img")

        def shown(slider, picture=picture):
            value = slider.locator("xpath=../output").inner_text()
            assert slider.get_attribute("aria-valuetext") == value
            alt = picture.get_attribute("alt")
            assert value in alt
            return value, alt, picture.get_attribute("src")

        for slider in figure.locator("input").all():
            slider.scroll_into_view_if_needed()
            seen = [shown(slider)]
            for key in ("End", "Home", "ArrowRight"):
                slider.press(key)
                seen.append(shown(slider))
            end, home, next_ = seen[1:]
            for one, other in ((end, home), (home, next_)):
                assert one[0] != other[0]
                assert one[2] != other[2], f"{one[1]} and {other[1]} look the same"
            box = slider.bounding_box()
            page.mouse.click(box["x"] + 8, box["y"] + box["height"] / 2)
            assert shown(slider) == home
            page.mouse.click(box["x"] + box["width"] - 8, box["y"] + box["height"] / 2)
            assert shown(slider) == end
            page.mouse.click(box["x"] + 8, box["y"] + box["height"] / 2)
        assert picture.evaluate("picture => picture.decode().then(() => picture.naturalWidth)") > 100


def test_without_javascript_the_first_picture_of_a_slider_shows(visit):
    page = visit("notebooks/01_bayesian_filtering", java_script_enabled=False)
    figure = page.locator("figure.pftrack-explore").first
    figure.scroll_into_view_if_needed()
    assert figure.locator("img").bounding_box()["height"] > 100
    assert "needs JavaScript" in figure.inner_text()


TRACKING = [page for page in PAGES if re.search(r"/(0[3-9]|1\d)_(?!faster)", page)]  # 7's second page measures time


@pytest.mark.parametrize("name", ["book/index", *TRACKING])
def test_clips_play_have_a_poster_and_words_and_are_light(visit, name):
    page = visit(name)
    clips = page.locator("video").all()
    assert clips
    for clip in clips:
        clip.scroll_into_view_if_needed()
        assert clip.get_attribute("poster")
        assert len(clip.get_attribute("aria-label")) > 40
        moved = clip.evaluate(
            """async video => {
                video.muted = true;
                await video.play();
                const begin = video.currentTime;
                await new Promise(done => setTimeout(done, 700));
                return [video.currentTime !== begin, video.videoWidth];
            }"""
        )
        assert moved[0]
        assert moved[1] > 100
        weight = clip.evaluate("video => fetch(video.currentSrc).then(r => r.blob()).then(blob => blob.size)")
        assert weight < MOST_BYTES_OF_A_CLIP


@pytest.mark.parametrize("name", PAGES)
def test_a_page_fits_its_window_and_is_photographed(visit, name):
    page = visit(name)
    for viewport, scheme in itertools.product((PHONE, DESKTOP), ("light", "dark")):
        page.set_viewport_size(viewport)
        page.emulate_media(color_scheme=scheme)
        page.locator(f"html[data-theme={scheme}]").wait_for()
        assert page.evaluate("document.documentElement.scrollWidth") <= viewport["width"]
        photograph = f"{name.replace('/', '-')}-{viewport['width']}-{scheme}.png"
        page.screenshot(path=ROOT / "_build" / "screenshots" / photograph)


def test_the_first_screen_of_the_book_shows_the_tracker_at_work(visit):
    for viewport in (PHONE, DESKTOP):
        box = visit("book/index", viewport).locator("video").first.bounding_box()
        assert box["y"] + 0.6 * box["height"] < viewport["height"]
